"""Somebody's own code in a config: named, told by its file, and opened where something is to run."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import NDArray

from harness.base.document import Document, Key, is_mapping
from harness.base.model import Model
from harness.scenes.effects.base import Contribution
from harness.scenes.mesh.base import Mesh
from harness.scenes.mesh.generator import Generator
from solvers import integrators
from solvers.plugins import Plugin, Refused, Table, load


def chosen(document: Document, table: Table, data: Any, tag: str, at: Key) -> tuple[str, dict[str, Any]] | None:
    """Split the mapping `data` into the name under its key `tag`, a Plugin where it is somebody's own code, and its
    other keys; None after a mistake was noted."""
    if is_mapping(data) and isinstance(data.get(tag), str):
        try:
            name = table.named(data[tag], document.path.parent)
        except Refused as error:
            document.report(str(error), (*at, tag))
            return None
        if isinstance(name, Plugin):
            return name, {key: value for key, value in data.items() if key != tag}
    return document.choose(data, table, tag, at)


def given(document: Document, data: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of own code as they stand in the file, and beside the names of files their digests."""
    return {key: _with_digest(document, value) for key, value in data.items()}


def _with_digest(document: Document, value: Any) -> Any:
    path = document.path.parent / value if isinstance(value, str) and value else None
    return [value, hashlib.sha256(path.read_bytes()).hexdigest()] if path and path.is_file() else value


def opened(document: Document, plugin: Plugin, what: str, at: Key) -> Any:
    """What a plug-in leads to, one of WANTED; its code runs now. None after a mistake was noted."""
    wanted, fits = WANTED[what]
    try:
        made = load(plugin.target)
    except Exception as error:  # it is somebody's code, and may fail in any way
        document.report(f"{plugin} cannot be loaded: {type(error).__name__}: {error}", at)
        return None
    if not fits(made):
        document.report(f"{plugin} is no {what}; wanted {wanted}", at)
        return None
    return made


def _is_model(base: type[Model], method: str) -> Callable[[Any], bool]:
    return lambda made: isinstance(made, type) and issubclass(made, base) and callable(getattr(made, method, None))


WANTED: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "solver": (
        "a frozen dataclass with a method `prepare`",
        lambda made: isinstance(made, type) and is_dataclass(made) and callable(getattr(made, "prepare", None)),
    ),
    "effect": (
        "a subclass of harness.base.model.Model with a method `bind` and a `kind`",
        lambda made: _is_model(Model, "bind")(made) and hasattr(made, "model_fields") and "kind" in made.model_fields,
    ),
    "mesh": ("a subclass of harness.scenes.mesh.generator.Generator", _is_model(Generator, "generate")),
    "report": ("a function of rows and a folder", callable),
    "integrator": (
        "an object of solvers.integrators.Integrator",
        lambda made: isinstance(made, integrators.AnyIntegrator),
    ),
}
"""What own code may be: in words, and by a test."""


@dataclass(frozen=True, slots=True)
class UnopenedEffect:
    """An effect that is known by its name alone."""

    kind: str

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Never asked for."""
        return _unopened(self.kind)


class UnopenedMesh(Generator):
    """A mesh that is known by its name alone."""

    kind: str
    COUNTS: ClassVar[str] = "as its code says"
    SPRINGS: ClassVar[int] = 1

    def count(self, size: int) -> int:
        """Unknown; taken for the size."""
        return size

    def generate(self, size: int) -> Mesh:
        """Never asked for."""
        return _unopened(self.kind)


def _unopened(kind: str) -> NoReturn:
    raise RuntimeError(f"{kind} was not opened")
