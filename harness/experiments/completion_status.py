"""Determine which units of an experiment are missing, with common rules and messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from springbench.harness.execution import machine_info

if TYPE_CHECKING:
    import pyarrow as pa

COMPLETED, NOT_STARTED = "done", "missing"

_MAX_LISTED_UNITS = 8
"""Largest number of units that a message lists by name."""


class CompletionStatus(NamedTuple):
    """Completion status of a unit.

    Attributes:
        status: completed, missing, or the status of a failed unit.
        is_stale: whether the rows come from other source code.
        damage_reason: what is wrong with the files; a damaged unit counts as missing.
    """

    status: str
    is_stale: bool = False
    damage_reason: str = ""


class PlannedUnit(Protocol):
    """Unit, or the specification of one, with its completion status."""

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        ...

    @property
    def completion_status(self) -> CompletionStatus:
        """Completion status of the unit."""
        ...


P = TypeVar("P", bound=PlannedUnit)


def read_completion_statuses(
    request_predicates: Mapping[Path, Callable[[Mapping[str, Any]], bool]], columns: Sequence[str], schema: pa.Schema
) -> dict[Path, CompletionStatus]:
    """Return the completion status of units, by the path of their rows.

    Args:
        request_predicates: for each path, a predicate that states whether the columns of the unit's first row match the
            request.
        columns: columns that the predicates need; `source_fingerprint` is added.
        schema: schema of the rows.

    Raises:
        InputError: a packed file is damaged.
    """
    from springbench.harness.results import (
        parquet_rows,  # imports pyarrow, which a listing without rows does not need
    )

    heads, today = (
        parquet_rows.read_first_rows(request_predicates, [*columns, "source_fingerprint"], schema),
        machine_info.hash_sources(),
    )
    found: dict[Path, CompletionStatus] = {}
    for path, is_match in request_predicates.items():
        there = heads.get(path)
        if isinstance(there, str):
            found[path] = CompletionStatus(NOT_STARTED, damage_reason=f"{path} {there}")
        elif there is None or not is_match(there):
            found[path] = CompletionStatus(NOT_STARTED)
        else:
            found[path] = CompletionStatus(COMPLETED, is_stale=there["source_fingerprint"] != today)
    return found


def select_missing_units(
    planned: Sequence[P],
    unit_noun: str,
    print_message: Callable[[str], None],
    *,
    rerun: bool = False,
    rerun_stale: bool = False,
) -> list[P]:
    """Return the units to execute, and print a summary of the others.

    Missing units are always included, and all units with `rerun`.

    Args:
        planned: all units of the experiment.
        unit_noun: plural noun for the units, for messages.
        print_message: prints a remark.
        rerun: whether to include all units.
        rerun_stale: whether to include units whose rows come from other source code.
    """

    def to_do(p: PlannedUnit) -> bool:
        return rerun or p.completion_status.status == NOT_STARTED or (rerun_stale and p.completion_status.is_stale)

    todo = [p for p in planned if to_do(p)]
    if len(todo) < len(planned):
        print_message(f"{len(planned) - len(todo)} of {len(planned)} {unit_noun} are there already")
    if older := [p.title for p in planned if p.completion_status.is_stale and not to_do(p)]:
        more = f" and {len(older) - _MAX_LISTED_UNITS} more" if len(older) > _MAX_LISTED_UNITS else ""
        print_message(f"{len(older)} of them by other code than today's: {', '.join(older[:_MAX_LISTED_UNITS])}{more}")
        print_message("--rerun-stale does these again, --rerun does all")
    for p in todo:
        if p.completion_status.damage_reason:
            print_message(f"{p.completion_status.damage_reason}; {p.title} is done again")
    return todo
