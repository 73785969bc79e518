"""Solvers of a config with all of their parameters.

The parameters are the fields of a solver's dataclass. Importing a solver also imports Numba and its kernels, which
would be most of the time of `springbench list`. The parameters of shipped solvers are therefore cached for the user, by
the digest of all sources of solvers. Any change of the sources invalidates the entry, and checkouts with other sources
have entries of their own.
"""

from __future__ import annotations

import dataclasses
import json
import time
from contextlib import suppress
from dataclasses import MISSING, fields
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import ConfigDict, Field, create_model

from harness.base.blame import said, where
from harness.base.document import Document, Key, is_list, is_mapping
from harness.base.files import CannotWrite, replacing, users_cache
from harness.base.model import Model
from harness.config.own import chosen
from harness.config.sweep import SolverSpec
from harness.scenes.own import opened
from solvers import sources
from solvers.plugins import Plugin, load
from solvers.registry import EVERY

_KEPT_FOR = 30 * 86400.0
"""Lifetime of a cached entry, in seconds."""


def solvers_of(document: Document) -> list[SolverSpec]:
    """Read the solvers listed under `solvers`, with all of their parameters.

    Mistakes are added to the document.
    """
    listed: Any = document.data.get("solvers")
    found = [
        _solver(document, entry, ("solvers", i))
        for i, entry in enumerate(listed if is_list(listed) else [])
        if isinstance(entry, str) or is_mapping(entry)  # the check of the whole config reports others
    ]
    return [solver for solver in found if solver]


def _solver(document: Document, entry: str | dict[str, Any], at: Key) -> SolverSpec | None:
    data = {"name": entry} if isinstance(entry, str) else entry
    named = chosen(document, EVERY, data, "name", at)
    if named is None:
        return None
    name, asked = named
    own = isinstance(name, Plugin)
    if own and not document.own.opens:
        return SolverSpec(name, asked, document.own.stated.get(name, {}))
    kept = None if own or asked or not document.own.kept else _kept_file(name)
    if kept is not None and (known := _read(kept)) is not None:
        return SolverSpec(name, known)
    if own:
        _try(document, name, asked, at)
        return SolverSpec(name, asked)  # as `list` has them
    solver = load(EVERY[name])
    parameters = document.check(parameters_model(name, solver), asked, at)
    if parameters is None:
        return None
    try:
        solver(**vars(parameters))
    except ValueError as error:
        document.report(str(error), at)
    found: dict[str, Any] = _stated(solver, parameters)
    if kept is not None:
        _keep(kept, found)
    return SolverSpec(name, found)


def _try(document: Document, name: Plugin, asked: dict[str, Any], at: Key) -> None:
    """Try to create a user's solver, and add its mistakes to the document."""
    solver = opened(document, name, "solver", at)
    if solver is None:
        return
    try:
        parameters = document.check(parameters_model(name, solver), asked, at)
        if parameters is not None:
            solver(**vars(parameters))
    except ValueError as error:
        document.report(str(error), at)
    except Exception as error:
        document.report(f"{name} cannot be made of these parameters: {said(error)} ({where(error, {name.source})})", at)


def parameters_model(name: str, solver: type) -> type[Model]:
    """Build the model of a solver's parameters from the fields of its frozen dataclass.

    For user code the fields may have any type, including types that no file can contain, such as arrays.

    Args:
        name: name of the solver.
        solver: dataclass of the solver.
    """
    hints = get_type_hints(solver, include_extras=True)
    given: dict[str, Any] = {f.name: (hints[f.name], _default(f)) for f in fields(solver) if f.init}
    base = _OfAnyType if isinstance(name, Plugin) else Model
    return create_model(name, __base__=base, __doc__=solver.__doc__, **given)


class _OfAnyType(Model):
    model_config = ConfigDict(arbitrary_types_allowed=True)


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not MISSING:
        return Field(default_factory=field.default_factory)
    return ... if field.default is MISSING else field.default


def _stated(solver: type, parameters: Model) -> dict[str, Any]:
    """Select the parameters for rows and hashes.

    Those that the solver omits at their default are excluded.
    """
    unstated: frozenset[str] = getattr(solver, "unstated", frozenset())
    usual = {name for name in unstated if getattr(parameters, name, None) == getattr(solver, name, None)}
    return parameters.model_dump(mode="json", exclude=usual)


def _kept_file(name: str) -> Path:
    """Return the cache path of a shipped solver that a config names without parameters."""
    return users_cache("parameters") / f"{name}-{_of_sources()[:16]}.json"


@cache
def _of_sources() -> str:
    return sources.everything("solvers")


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found: Any = json.loads(path.read_text())
    except (OSError, ValueError):  # nothing is kept, or nothing that can be read
        return None
    return found if is_mapping(found) else None


def _keep(path: Path, parameters: dict[str, Any]) -> None:
    """Write parameters to the cache if possible, and remove expired entries."""
    with suppress(OSError, CannotWrite):
        path.parent.mkdir(parents=True, exist_ok=True)
        for older in path.parent.glob("*.json"):
            if time.time() - older.stat().st_mtime > _KEPT_FOR:
                older.unlink(missing_ok=True)
        with replacing(path) as partial:
            partial.write_text(json.dumps(parameters))
