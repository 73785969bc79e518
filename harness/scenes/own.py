"""Effects and meshes from plug-ins: named by a scene, and imported where they are used.

A scene is passed around with `OwnEffect` and `OwnMesh`, which hold only name and parameters.
`SceneSpec.opened` replaces them, in a process that may crash. Results of the plug-in code are checked, and its
errors name it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeGuard

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, SkipValidation

from harness.base.blame import said, where
from harness.base.document import Document, Key
from harness.base.errors import InputError, Mistake, SpringbenchError
from harness.base.model import Model
from harness.scenes.effects.base import Contribution, Effect, Pin, Steady
from harness.scenes.mesh import generator
from harness.scenes.mesh.base import BEND, SHEAR, STRETCH, Mesh
from solvers import integrators
from solvers.plugins import Plugin, load

ABOUT = "\0importing "
"""Message of a process, with the name of the plug-in, before it imports third-party code."""


def opened(document: Document, plugin: Plugin, what: str, at: Key) -> Any:
    """Load a plug-in of one of WANTED, which runs its code; None after a recorded mistake."""
    wanted, fits = WANTED[what]
    document.own.tell(f"{ABOUT}{plugin}")
    try:
        with staying():
            made = load(plugin.target)
        problem = "" if fits(made) else f"is no {what}; wanted {wanted}"
        if lacks := sorted(getattr(made, "__abstractmethods__", ())):
            problem = problem or f"has no method `{'`, `'.join(lacks)}`, which its base wants; write it"
    except AttributeError as error:
        missing = error.name == plugin.target.rpartition(":")[2] and error.obj is not None
        problem = f"cannot be loaded: {f'{plugin.module} has no {error.name}' if missing else _said(error, plugin)}"
    except Exception as error:  # it is somebody's code, and may fail in any way
        problem = f"cannot be loaded: {_said(error, plugin)}"
    else:
        if not problem:
            return made
    document.report(f"{plugin} {problem}", at)
    return None


def checked(document: Document, plugin: Plugin, what: str, parameters: dict[str, Any], at: Key) -> Any:
    """Build an effect or a mesh from a plug-in class and its parameters.

    The class is imported. Return None after recorded mistakes.
    """
    model = opened(document, plugin, what, (*at, "kind"))
    if model is None:
        return None
    try:
        return document.check(model, document.with_paths(model, parameters, at), at)
    except Exception as error:  # a validator may be somebody's too
        document.report(f"{plugin} cannot be made of these parameters: {_said(error, plugin)}", at)
        return None


def _said(error: BaseException, plugin: Plugin) -> str:
    return f"{said(error)} ({where(error, {plugin.source})})"


def _is_model(base: type[Model], method: str) -> Callable[[Any], bool]:
    return lambda made: isinstance(made, type) and issubclass(made, base) and callable(getattr(made, method, None))


def _is_sound(made: integrators.AnyIntegrator) -> bool:
    if not isinstance(made, integrators.Integrator):
        return True
    numbers: tuple[Any, ...] = made.factor, made.when, made.ahead, made.order
    known = all(isinstance(one, float | int) and math.isfinite(one) for one in numbers)
    return known and made.factor > 0.0 and callable(made.predict)


WANTED: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "solver": (
        "a frozen dataclass with a method `prepare`",
        lambda made: isinstance(made, type) and is_dataclass(made) and callable(getattr(made, "prepare", None)),
    ),
    "effect": (
        "a subclass of harness.base.model.Model with a method `bind` and a `kind`",
        lambda made: _is_model(Model, "bind")(made) and hasattr(made, "model_fields") and "kind" in made.model_fields,
    ),
    "mesh": ("a subclass of harness.scenes.mesh.generator.Generator", _is_model(generator.Generator, "generate")),
    "report": ("a function of rows and a folder", callable),
    "integrator": (
        "an object of solvers.integrators.Integrator, of finite numbers, its `factor` above 0",
        lambda made: isinstance(made, integrators.AnyIntegrator) and _is_sound(made),
    ),
}
"""Kinds of plug-ins: description and check."""


@dataclass(frozen=True, slots=True)
class OwnEffect:
    """An effect by name and parameters; `folder` is that of the file that names it."""

    kind: Plugin
    parameters: Mapping[str, Any]
    folder: str

    def opened(self) -> Effect:
        """Load the effect; raise InputError on failure."""
        return _opened(self, "effect")

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Build the effect's contribution; raise InputError on failure."""
        return self.opened().bind(mesh, mass, time_step)


class OwnMesh(generator.Generator):
    """A mesh by name and parameters; `folder` is that of the file that names it."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    kind: SkipValidation[Plugin]
    parameters: dict[str, Any]
    folder: str
    COUNTS: ClassVar[str] = "as its code says"
    SPRINGS: ClassVar[int] = 1

    def opened(self) -> generator.Generator:
        """Load the mesh; raise InputError on failure."""
        return _opened(self, "mesh")

    def count(self, size: int) -> int:
        """Return the size, as the number of vertices is unknown."""
        return size

    def generate(self, size: int) -> Mesh:
        """Generate the mesh of a size; raise InputError on failure."""
        return self.opened().build(size)


def _opened(part: OwnEffect | OwnMesh, what: str) -> Any:
    document = Document(Path(part.folder) / "scene.yaml", {})
    made = checked(document, part.kind, what, dict(part.parameters), ())
    if made is None:
        raise InputError([Mistake(mistake.problem, key=mistake.key) for mistake in document.mistakes])
    return made


@contextmanager
def staying() -> Generator[None]:
    """Restore the working directory on exit."""
    here = os.getcwd()
    try:
        yield
    finally:
        with suppress(OSError):
            os.chdir(here)


@contextmanager
def blaming(plugin: Plugin, does: str) -> Generator[None]:
    """Turn exceptions of a plug-in, except the project's own, into InputError with its name and line."""
    try:
        with staying():
            yield
    except (SpringbenchError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{plugin}: `{does}` raised {_said(error, plugin)}") from error


def bound(plugin: Plugin, effect: Effect, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
    """Build the contribution of a plug-in effect and check it.

    Args:
        plugin: the plug-in.
        effect: its effect.
        mesh: the mesh.
        mass: vertex masses (n,) [kg].
        time_step: dt [s].

    Raises:
        InputError: if the plug-in fails, or its contribution is invalid.
    """
    before = [array.tobytes() for array in _arrays(mesh, mass)]
    with blaming(plugin, "bind"):
        made: Any = effect.bind(mesh, mass, time_step)
    if [array.tobytes() for array in _arrays(mesh, mass)] != before:
        raise InputError(f"{plugin}: `bind` wrote to the mesh or the masses, which it was given; change copies")
    if not isinstance(made, Contribution):
        wanted = "wanted a harness.scenes.effects.base.Contribution"
        raise InputError(f"{plugin}: `bind` returned {_in_words(made)}; {wanted}")
    with blaming(plugin, "bind"):
        for field in fields(made):
            _require(isinstance(getattr(made, field.name), tuple), f"`{field.name}` should be a tuple")
        for energy in made.energies:
            methods = [name for name in ("value", "add_gradient", "hessian") if not callable(getattr(energy, name, 0))]
            _require(not methods, f"the energy {type(energy).__name__} has no method `{', '.join(methods)}`")
        for pin in made.pins:
            _require_pin(pin, len(mesh.rest))
        _require(all(map(callable, made.filters)), "`filters` should be functions of velocities")
        _require(all(map(callable, made.forces)), "`forces` should be functions of positions, velocities and time")
        for force in made.forces:
            if isinstance(force, Steady):
                _require_array(force.force, mesh.rest.shape, "a steady force")
    n = len(mesh.rest)
    forces = tuple(f if isinstance(f, Steady) else _Checked(f, plugin, "force [N]", n) for f in made.forces)
    return replace(made, forces=forces, filters=tuple(_Checked(f, plugin, "velocity [m/s]", n) for f in made.filters))


@dataclass(frozen=True, slots=True, eq=False)
class _Checked:
    """A force or filter of a plug-in with checked results."""

    function: Callable[..., Any]
    plugin: Plugin
    what: str
    vertices: int

    def __call__(self, *arguments: Any) -> Any:
        with blaming(self.plugin, self.what.partition(" ")[0]):
            found: Any = self.function(*(one.copy() if _is_array(one) else one for one in arguments))
            wanted = self.vertices, 3
            if not _is_array(found) or found.shape != wanted:
                raise ValueError(f"gave {_in_words(found)}; wanted a {self.what} of shape {wanted}")
        return found


def _is_array(value: object) -> TypeGuard[NDArray[Any]]:
    return isinstance(value, np.ndarray)


def _require(holds: bool, problem: str) -> None:
    if not holds:
        raise ValueError(problem)


def _require_array(array: Any, shape: tuple[int | None, ...], what: str, *, integers: bool = False) -> None:
    wanted = f"{what} should be an array of {'integers' if integers else 'float64'} of shape "
    wanted += f"({', '.join('any' if n is None else str(n) for n in shape)})"
    if (
        not _is_array(array)
        or array.ndim != len(shape)
        or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True))
        or not (array.dtype.kind == "i" if integers else array.dtype == np.float64)
    ):
        raise ValueError(f"{wanted}, not {_in_words(array)}")
    if not integers and not np.isfinite(array).all():
        raise ValueError(f"{what} has values that are not finite, the first at {np.argwhere(~np.isfinite(array))[0]}")


def _require_indices(array: Any, shape: tuple[int | None, ...], what: str, count: int) -> None:
    _require_array(array, shape, what, integers=True)
    if array.size and (array.min() < 0 or array.max() >= count):
        wrong = int(array[(array < 0) | (array >= count)][0])
        raise ValueError(f"{what} names {wrong}; there are {count}, counted from 0")


def _require_pin(pin: Any, count: int) -> None:
    _require(isinstance(pin, Pin), f"`pins` holds {_in_words(pin)}; wanted harness.scenes.effects.base.Pin")
    _require_indices(pin.vertices, (None,), "`vertices` of a pin", count)
    _require_array(pin.targets, (len(pin.vertices), 3), "`targets` of a pin")
    weight = pin.weight
    _require(isinstance(weight, float | int) and weight > 0.0, f"`weight` of a pin is {weight!r}; it should be above 0")


def sound(plugin: Plugin, mesh: Any) -> Mesh:
    """Check a mesh from a plug-in; raise InputError if it is invalid."""
    with blaming(plugin, "generate"):
        _require(isinstance(mesh, Mesh), f"returned {_in_words(mesh)}; wanted a harness.scenes.mesh.base.Mesh")
        _require_array(mesh.rest, (None, 3), "`rest`")
        n, m = len(mesh.rest), len(mesh.springs)
        _require(n > 0, "`rest` has no vertices")
        _require_indices(mesh.springs, (None, 2), "`springs`", n)
        _require_indices(mesh.triangles, (None, 3), "`triangles`", n)
        _require_array(mesh.shares, (n,), "`shares`")
        _require(bool((mesh.shares >= 0.0).all()), "`shares` has values below 0")
        _require(math.isclose(float(mesh.shares.sum()), 1.0, rel_tol=1e-6), "`shares` should sum to 1")
        if unknown := mesh.families.keys() - {STRETCH, SHEAR, BEND}:
            raise ValueError(f"`families` has {sorted(map(str, unknown))[0]!r}; wanted {STRETCH}, {SHEAR} and {BEND}")
        for name, members in mesh.families.items():
            _require_indices(members, (None,), f"`families[{name!r}]`", m)
        listed = np.concatenate([*mesh.families.values(), np.empty(0, np.int64)])
        _require(np.array_equal(np.sort(listed), np.arange(m)), "`families` should have each spring once")
        for name, members in mesh.parts.items():
            _require_indices(members, (None,), f"`parts[{name!r}]`", n)
        if mesh.mass is not None:
            _require_array(mesh.mass, (n,), "`mass`")
            _require(bool((mesh.mass >= 0.0).all()), "`mass` has values below 0")
        for name, values in mesh.attributes.items():
            _require_array(values, (n,), f"`attributes[{name!r}]`")
        _require(mesh.dimension in (1, 2, 3), f"`dimension` is {mesh.dimension!r}; wanted 1, 2 or 3")
        spacing: Any = mesh.spacing
        _require(isinstance(spacing, float | int) and 0.0 < spacing < math.inf, f"`spacing` is {spacing!r} m")
        if (same := mesh.springs[:, 0] == mesh.springs[:, 1]).any():
            raise ValueError(f"spring {np.flatnonzero(same)[0]} joins vertex {mesh.springs[same][0, 0]} to itself")
    return mesh


def _arrays(mesh: Mesh, mass: NDArray[np.float64]) -> list[NDArray[Any]]:
    held = [mesh.rest, mesh.springs, mesh.triangles, mesh.shares, mass]
    return [*held, *mesh.families.values(), *mesh.parts.values(), *mesh.attributes.values()]


def _in_words(value: Any) -> str:
    if _is_array(value):
        return f"{value.dtype} of shape {value.shape}"
    return "None" if value is None else f"a {type(value).__name__}"
