"""What is there of an experiment and what is to be done: the same rules, and the same remarks, for all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from harness.base import machine

if TYPE_CHECKING:
    import pyarrow as pa

DONE, MISSING = "done", "missing"

_NAMED = 8
"""So many units are named where more are meant."""


class Standing(NamedTuple):
    """What is there of a unit. state: done, missing, or the status of one that failed; older: whether its rows were
    made by other code than today's; damage: what is wrong with its files, for which it is missing."""

    state: str
    older: bool = False
    damage: str = ""


class Planned(Protocol):
    """A unit, or what it will be made of, and how it stands."""

    @property
    def title(self) -> str:
        """The unit in words."""
        ...

    @property
    def standing(self) -> Standing:
        """What is there of it."""
        ...


P = TypeVar("P", bound=Planned)


def standings(
    asked: Mapping[Path, Callable[[Mapping[str, Any]], bool]], columns: Sequence[str], schema: pa.Schema
) -> dict[Path, Standing]:
    """How units stand, by the path of their rows. asked: whether these columns of a unit's first row, and `code`, are
    of what is asked for now. Raises InputError for a packed file that is damaged."""
    from harness.base import rows  # brings pyarrow along, for which those who only ask what there is need not wait

    heads, today = rows.heads(asked, [*columns, "code"], schema), machine.code_hash()
    found: dict[Path, Standing] = {}
    for path, as_asked in asked.items():
        there = heads.get(path)
        if isinstance(there, str):
            found[path] = Standing(MISSING, damage=f"{path} {there}")
        elif there is None or not as_asked(there):
            found[path] = Standing(MISSING)
        else:
            found[path] = Standing(DONE, older=there["code"] != today)
    return found


def wanted(
    planned: Sequence[P], what: str, say: Callable[[str], None], *, again: bool = False, changed: bool = False
) -> list[P]:
    """Those that are to be done: the missing ones, all with `again`, with `changed` also those made by other code.

    what: the units in a word, plural; say: prints a remark.
    """

    def to_do(p: Planned) -> bool:
        return again or p.standing.state == MISSING or (changed and p.standing.older)

    todo = [p for p in planned if to_do(p)]
    if len(todo) < len(planned):
        say(f"{len(planned) - len(todo)} of {len(planned)} {what} are there already")
    if older := [p.title for p in planned if p.standing.older and not to_do(p)]:
        more = f" and {len(older) - _NAMED} more" if len(older) > _NAMED else ""
        say(f"{len(older)} of them by other code than today's: {', '.join(older[:_NAMED])}{more}")
        say("--changed does these again, --again does all")
    for p in todo:
        if p.standing.damage:
            say(f"{p.standing.damage}; {p.title} is done again")
    return todo
