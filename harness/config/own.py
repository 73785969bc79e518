"""Somebody's own code in a config: named, told by its file, and tried in a process of its own before anything runs."""

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
    """Wall seconds, and GiB of memory."""

    seconds: float
    gib: float


MOST = Most(60.0, 2.0)
"""What importing and binding code of others may take before a command starts; a config may say less time, or another
memory."""

T = TypeVar("T")
Load = Callable[[OwnCode], T]


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


def tried(
    load: Load[T],
    own: Callable[[T], list[Plugin]],
    stated: Callable[[T], dict[str, Any]],
    limits: Callable[[T], Most],
) -> T:
    """What a config loads to, where code of others stays unopened. Where it has some, that was opened before in a
    process of its own, which found no mistakes, and told what solvers state.

    load: pickles; own: the code of others; stated: by solver, asked where its class is imported.
    Raises InputError, also where that process is lost.
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
    """MOST, with a config's limits."""
    return Most(min(MOST.seconds, seconds or MOST.seconds), gib or MOST.gib)


BINDING = "\0binding "
"""What a process says, with the name of a scene behind it, before it binds one."""
