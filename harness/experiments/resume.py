"""Determine which units of an experiment are missing, with common rules and messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from harness.base import machine

if TYPE_CHECKING:
    import pyarrow as pa

DONE, MISSING = "done", "missing"

_NAMED = 8
"""Largest number of units that a message lists by name."""


class Standing(NamedTuple):
    """Completion status of a unit.

    Attributes:
        state: completed, missing, or the status of a failed unit.
        older: whether the rows come from other source code.
        damage: what is wrong with the files; a damaged unit counts as missing.
    """

    state: str
    older: bool = False
    damage: str = ""


class Planned(Protocol):
    """Unit, or the specification of one, with its completion status."""

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        ...

    @property
    def standing(self) -> Standing:
        """Completion status of the unit."""
        ...


P = TypeVar("P", bound=Planned)


def standings(
    asked: Mapping[Path, Callable[[Mapping[str, Any]], bool]], columns: Sequence[str], schema: pa.Schema
) -> dict[Path, Standing]:
    """Return the completion status of units, by the path of their rows.

    Args:
        asked: for each path, a predicate on the columns of the unit's first row; whether they match the
            request.
        columns: columns that the predicates need; `code` is added.
        schema: schema of the rows.

    Raises:
        InputError: a packed file is damaged.
    """
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
    """Return the units to execute, and print a summary of the others.

    Missing units are always included, and all units with `again`.

    Args:
        planned: all units of the experiment.
        what: plural noun for the units, for messages.
        say: prints a remark.
        again: whether to include all units.
        changed: whether to include units whose rows come from other source code.
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
