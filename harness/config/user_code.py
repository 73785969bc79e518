"""User code in a config: resolution, fingerprints and a trial load.

It is identified by its file, and tried in a worker process before anything runs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from springbench.harness.errors import InputError
from springbench.harness.scenes.scene_plugins import IMPORT_NOTICE
from springbench.harness.schema.config_document import (
    SKIP_USER_CODE,
    ConfigDocument,
    ConfigKey,
    UserCodePolicy,
    is_mapping,
)
from springbench.solvers.plugins.plugin_discovery import InvalidPluginName, PluginName, PluginTable

if TYPE_CHECKING:  # for configs that name code of others
    from springbench.harness.execution.worker_process import ProgressCallback


class LoadLimits(NamedTuple):
    """Limits of loading user code: wall time [s] and memory [GiB]."""

    seconds: float
    memory_gib: float


DEFAULT_LOAD_LIMITS = LoadLimits(60.0, 2.0)
"""Limits for importing and binding user code before a command starts.

A config may set a shorter time, or another amount of memory.
"""

T = TypeVar("T")
ConfigLoader = Callable[[UserCodePolicy], T]


def resolve_tag(
    document: ConfigDocument, table: PluginTable, data: Any, tag: str, at: ConfigKey
) -> tuple[str, dict[str, Any]] | None:
    """Split a mapping into the name under its tag and its other keys.

    The name of user code is returned as a `PluginName`.

    Args:
        document: config, which collects mistakes.
        table: known names.
        data: value that should be a mapping.
        tag: key that selects the name, such as `kind`.
        at: location of the data in the document.

    Returns:
        (name, other keys), or None after a mistake was added.
    """
    if is_mapping(data) and isinstance(data.get(tag), str):
        try:
            name = table.resolve_name(data[tag], document.path.parent)
        except InvalidPluginName as error:
            document.add_mistake(str(error), (*at, tag))
            return None
        if isinstance(name, PluginName):
            return name, {key: value for key, value in data.items() if key != tag}
    return document.split_by_tag(data, table, tag, at)


def fingerprint_parameters(document: ConfigDocument, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters of user code as in the file, with digests next to file names.

    Args:
        document: config, to whose folder file names are relative.
        data: parameters of the user code.

    Returns:
        The parameters, in which the name of an existing file is replaced by [name, SHA-256 of the content].
    """
    return {key: _add_digest(document, value) for key, value in data.items()}


def _add_digest(document: ConfigDocument, value: Any) -> Any:
    path = document.path.parent / value if isinstance(value, str) and value else None
    return [value, hashlib.sha256(path.read_bytes()).hexdigest()] if path and path.is_file() else value


def load_in_sandbox(
    load: ConfigLoader[T],
    find_plugins: Callable[[T], list[PluginName]],
    read_metadata: Callable[[T], dict[str, Any]],
    limits: Callable[[T], LoadLimits],
) -> T:
    """Load a config without importing its user code, after a trial in a worker process.

    The trial imports and binds the user code, finds mistakes, and reads the metadata of solvers. It is omitted for a
    config without user code.

    Args:
        load: loads the config with a given policy; it must pickle.
        find_plugins: lists the user code of a loaded config.
        read_metadata: reads metadata by solver, where the classes are imported.
        limits: limits of the trial for a loaded config.

    Returns:
        The loaded config.

    Raises:
        InputError: for a mistake, or if the worker process fails.
    """
    found = load(SKIP_USER_CODE)
    names = list(dict.fromkeys(find_plugins(found)))
    if not names:
        return found
    return load(
        UserCodePolicy(
            imports_code=False,
            solver_metadata=_run_in_worker(partial(_load_plugins, load, read_metadata), limits(found), names),
        )
    )


def _load_plugins(
    load: ConfigLoader[T], stated: Callable[[T], dict[str, Any]], tick: ProgressCallback
) -> dict[str, Any]:
    return stated(load(UserCodePolicy(on_import=tick)))


def _run_in_worker(task: Callable[[ProgressCallback], Any], limits: LoadLimits, names: list[PluginName]) -> Any:
    from springbench.harness.execution.isolated_worker import IsolatedWorker, TaskFailure, TaskLimits

    does = "loading"

    def record_stage(message: str) -> None:
        nonlocal does
        does = message.removeprefix("\0") if message.startswith((IMPORT_NOTICE, BINDING_PREFIX)) else does

    worker = IsolatedWorker()
    try:
        return worker.run_task(task, record_stage, TaskLimits(*limits))
    except TaskFailure as lost:
        reason = str(lost).replace(", before its first step", "")  # the worker's messages are about runs
        behind = "" if any(name in does for name in names) else f" with {', '.join(names)}"
        raise InputError(f"{does}{behind} {reason}") from None
    finally:
        worker.stop_worker()


def build_load_limits(seconds: float | None, memory_gib: float | None) -> LoadLimits:
    """Build the limits for loading user code from those of a config's runs.

    Args:
        seconds: time limit of a run [s], bounded by the default; the default if None.
        memory_gib: memory limit [GiB]; the default if None.
    """
    return LoadLimits(
        min(DEFAULT_LOAD_LIMITS.seconds, seconds or DEFAULT_LOAD_LIMITS.seconds),
        memory_gib or DEFAULT_LOAD_LIMITS.memory_gib,
    )


BINDING_PREFIX = "\0binding "
"""Prefix of the progress event, followed by the name of a scene, before a scene is bound."""
