"""User code in a config: resolution, fingerprints and a trial load.

It is identified by its file, and tried in a worker process before anything runs.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from harness.base.document import UNOPENED, Document, Key, OwnCode, is_mapping
from harness.base.errors import InputError
from harness.scenes.own import ABOUT
from solvers.plugins import Plugin, Refused, Table

if TYPE_CHECKING:  # for configs that name code of others
    from harness.base.worker import Tick


class Most(NamedTuple):
    """Limits of loading user code: wall time [s] and memory [GiB]."""

    seconds: float
    gib: float


MOST = Most(60.0, 2.0)
"""Limits for importing and binding user code before a command starts. A config may set a shorter time, or another
amount of memory.
"""

T = TypeVar("T")
Load = Callable[[OwnCode], T]


def chosen(document: Document, table: Table, data: Any, tag: str, at: Key) -> tuple[str, dict[str, Any]] | None:
    """Split a mapping into the name under its tag and its other keys.

    User code becomes a Plugin.

    Args:
        document: config, which collects mistakes.
        table: known names.
        data: value that should be a mapping.
        tag: key that selects the name, such as `kind`.
        at: location of the data in the document.
    Returns: (name, other keys), or None after a mistake was added.
    """
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
    """Return parameters of user code as in the file, with digests next to file names."""
    return {key: _with_digest(document, value) for key, value in data.items()}


def _with_digest(document: Document, value: Any) -> Any:
    path = document.path.parent / value if isinstance(value, str) and value else None
    return [value, hashlib.sha256(path.read_bytes()).hexdigest()] if path and path.is_file() else value


def tried(
    load: Load[T],
    own: Callable[[T], list[Plugin]],
    stated: Callable[[T], dict[str, Any]],
    limits: Callable[[T], Most],
) -> T:
    """Load a config without importing its user code, after a trial in a worker process.

    The trial imports and binds the user code, finds mistakes, and reads the metadata of solvers. It is omitted for a
    config without user code.

    Args:
        load: loads the config with a given policy; it must pickle.
        own: lists the user code of a loaded config.
        stated: reads metadata by solver, where the classes are imported.
        limits: limits of the trial for a loaded config.
    Returns: the loaded config.
    Raises:
        InputError: for a mistake, or if the worker process fails.
    """
    found = load(UNOPENED)
    names = list(dict.fromkeys(own(found)))
    if not names:
        return found
    return load(OwnCode(opens=False, stated=_elsewhere(partial(_open, load, stated), limits(found), names)))


def _open(load: Load[T], stated: Callable[[T], dict[str, Any]], tick: Tick) -> dict[str, Any]:
    return stated(load(OwnCode(tell=tick)))


def _elsewhere(piece: Callable[[Tick], Any], limits: Most, names: list[Plugin]) -> Any:
    from harness.base.workers import Limits, Lost, Workers

    does = "loading"

    def hear(said: str) -> None:
        nonlocal does
        does = said.removeprefix("\0") if said.startswith((ABOUT, BINDING)) else does

    workers = Workers()
    try:
        return workers.do(piece, hear, Limits(*limits))
    except Lost as lost:
        reason = str(lost).replace(", before its first step", "")
        behind = "" if any(name in does for name in names) else f" with {', '.join(names)}"
        raise InputError(f"{does}{behind} {reason}") from None
    finally:
        workers.end()


def within(seconds: float | None, gib: float | None) -> Most:
    """Build the load limits from a config's time [s] and memory [GiB].

    The time is bounded by the default.
    """
    return Most(min(MOST.seconds, seconds or MOST.seconds), gib or MOST.gib)


BINDING = "\0binding "
"""Prefix of the progress event, followed by the name of a scene, before a scene is bound."""
