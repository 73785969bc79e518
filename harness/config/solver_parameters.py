"""Solvers of a config with all of their parameters.

The parameters are the fields of a solver's dataclass. Importing a solver also imports Numba and its kernels, which
would be most of the time of a command that has nothing to run. The valid parameters of shipped solvers are therefore
cached in the user's cache folder. The key of an entry is a hash of what a config states and of all sources of solvers,
so any change of the sources invalidates it, and checkouts with other sources have separate entries.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from contextlib import suppress
from dataclasses import MISSING, fields
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import ConfigDict, Field, create_model
from springbench.harness.atomic_files import WriteError, atomic_write, get_user_cache_dir
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.config.user_code import resolve_tag
from springbench.harness.execution.error_location import format_error, locate_error
from springbench.harness.scenes.scene_plugins import load_plugin
from springbench.harness.schema.base_model import ConfigModel
from springbench.harness.schema.config_document import ConfigDocument, ConfigKey, is_list, is_mapping
from springbench.solvers.jit import source_digest
from springbench.solvers.plugins.plugin_discovery import PluginName, load_target
from springbench.solvers.registry import SOLVER_TABLE

_CACHE_SECONDS = 30 * 86400.0
"""Lifetime of a cached entry, in seconds."""


def read_solvers(document: ConfigDocument) -> list[SolverSpec]:
    """Read the solvers listed under `solvers`, with all of their parameters.

    Mistakes are added to the document.
    """
    listed: Any = document.data.get("solvers")
    found = [
        _read_solver(document, entry, ("solvers", i))
        for i, entry in enumerate(listed if is_list(listed) else [])
        if isinstance(entry, str) or is_mapping(entry)  # the check of the whole config reports others
    ]
    return [solver for solver in found if solver]


def _read_solver(document: ConfigDocument, entry: str | dict[str, Any], at: ConfigKey) -> SolverSpec | None:
    data = {"name": entry} if isinstance(entry, str) else entry
    named = resolve_tag(document, SOLVER_TABLE, data, "name", at)
    if named is None:
        return None
    name, requested = named
    own = isinstance(name, PluginName)
    if own and not document.user_code.imports_code:
        return SolverSpec(name, requested, document.user_code.solver_metadata.get(name, {}))
    cache_path = None if own else _cache_path(name, requested)
    if cache_path is not None and (known := _read_cache(cache_path)) is not None:
        return SolverSpec(name, known)
    if own:
        _try_plugin(document, name, requested, at)
        return SolverSpec(name, requested)  # the same parameters as without an import of the code
    solver = load_target(SOLVER_TABLE[name])
    parameters = document.validate_data(build_parameter_model(name, solver), requested, at)
    if parameters is None:
        return None
    try:
        solver(**vars(parameters))
    except ValueError as error:
        document.add_mistake(str(error), at)
        return None
    found: dict[str, Any] = _select_parameters(solver, parameters)
    if cache_path is not None:
        _write_cache(cache_path, found)
    return SolverSpec(name, found)


def _try_plugin(document: ConfigDocument, name: PluginName, requested: dict[str, Any], at: ConfigKey) -> None:
    """Try to create a user's solver, and add its mistakes to the document."""
    solver = load_plugin(document, name, "solver", at)
    if solver is None:
        return
    try:
        parameters = document.validate_data(build_parameter_model(name, solver), requested, at)
        if parameters is not None:
            solver(**vars(parameters))
    except ValueError as error:
        document.add_mistake(str(error), at)
    except Exception as error:
        document.add_mistake(
            f"{name} cannot be made of these parameters: {format_error(error)} "
            f"({locate_error(error, {name.source_path})})",
            at,
        )


def build_parameter_model(name: str, solver: type) -> type[ConfigModel]:
    """Build the model of a solver's parameters from the fields of its frozen dataclass.

    For user code the fields may have any type, including types that no file can contain, such as arrays.

    Args:
        name: name of the solver.
        solver: dataclass of the solver.
    """
    hints = get_type_hints(solver, include_extras=True)
    given: dict[str, Any] = {f.name: (hints[f.name], _convert_default(f)) for f in fields(solver) if f.init}
    base = _ArbitraryTypeModel if isinstance(name, PluginName) else ConfigModel
    return create_model(name, __base__=base, __doc__=solver.__doc__, **given)


class _ArbitraryTypeModel(ConfigModel):
    model_config = ConfigDict(arbitrary_types_allowed=True)


def _convert_default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not MISSING:
        return Field(default_factory=field.default_factory)
    return ... if field.default is MISSING else field.default


def _select_parameters(solver: type, parameters: ConfigModel) -> dict[str, Any]:
    """Select the parameters for rows and hashes.

    Those that the solver omits at their default are excluded.
    """
    unstated: frozenset[str] = getattr(solver, "omitted_defaults", frozenset())
    usual = {name for name in unstated if getattr(parameters, name, None) == getattr(solver, name, None)}
    return parameters.model_dump(mode="json", exclude=usual)


def _cache_path(name: str, requested: dict[str, Any]) -> Path:
    """Return the cache path of a shipped solver with the parameters that a config states."""
    stated = f"{_hash_solver_sources()}{json.dumps(requested, sort_keys=True, default=repr)}"
    return get_user_cache_dir("parameters") / f"{name}-{hashlib.sha256(stated.encode()).hexdigest()[:16]}.json"


@cache
def _hash_solver_sources() -> str:
    return source_digest.digest_package("solvers")


def _read_cache(path: Path) -> dict[str, Any] | None:
    try:
        found: Any = json.loads(path.read_text())
    except (OSError, ValueError):  # missing or damaged: the parameters are validated again
        return None
    return found if is_mapping(found) else None


def _write_cache(path: Path, parameters: dict[str, Any]) -> None:
    """Write parameters to the cache if possible, and remove expired entries."""
    with suppress(OSError, WriteError):
        path.parent.mkdir(parents=True, exist_ok=True)
        for older in path.parent.glob("*.json"):
            if time.time() - older.stat().st_mtime > _CACHE_SECONDS:
                older.unlink(missing_ok=True)
        with atomic_write(path) as partial:
            partial.write_text(json.dumps(parameters))
