"""What is there of a sweep and what is missing, told from the files of its runs; it simulates and draws nothing.

A run is complete when its rows, its recording and its picture are in place. Rows are written after the recording,
and a picture is drawn from the recording alone, so what a kill leaves undone is told from the files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.base import machine, shelf
from harness.config.sweep import RunSpec
from harness.experiments.code import code, parts
from harness.experiments.resume import DONE, MISSING, Standing
from harness.record.sound import whole_messages

if TYPE_CHECKING:
    import pyarrow as pa

NEEDED = ("run_id", "scene", "size", "solver", "status", "code")
"""Columns without which a row tells nothing of a run."""

_TOLD = ("status", "code", "time_limit", "memory_limit")
"""Columns that tell how a run stands."""

_LIMITED = ("failed", "time-limit", "killed")
"""How a run may end for its limits."""


@dataclass(frozen=True, slots=True)
class Files:
    """Where a run leaves its files."""

    rows: Path
    recording: Path
    picture: Path

    @classmethod
    def of(cls, run: RunSpec, folder: Path, on: str | None = None) -> Files:
        """The files of a run in the folder of its sweep, done on the machine of an id, this one if left out."""
        label = run.label(on or machine.describe().id)
        return cls(
            folder / "rows" / f"{label}.parquet",
            folder / "recordings" / f"{label}.rrd",
            folder / "pictures" / f"{label}.png",
        )

    def absolute(self) -> Files:
        """The same files, whatever the working folder becomes."""
        return Files(self.rows.absolute(), self.recording.absolute(), self.picture.absolute())


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """A run of a sweep, its files, and what is there of it (`harness.experiments.resume.Planned`)."""

    run: RunSpec
    files: Files
    standing: Standing

    @property
    def title(self) -> str:
        """The run in words."""
        return self.run.title


def plan(runs: Iterable[RunSpec], folder: Path, machines: Sequence[str | None] = (None,)) -> list[PlannedRun]:
    """Each run with its files and what is there already; machines: the ids of those on which it may have been done."""
    code_of = _codes()
    planned: list[PlannedRun] = []
    here = machine.describe().id
    placed = [(run, [Files.of(run, folder, on or here) for on in machines]) for run in runs]
    heads = _heads([files.rows for _, some in placed for files in some])
    for run, some in placed:
        files = next((files for files in some if files.rows in heads), some[0])
        state, older, damage = MISSING, False, ""
        there = heads.get(files.rows)
        if isinstance(there, str):
            damage = f"{files.rows} {there}"
        elif there is not None:
            state = DONE if there["status"] == "ok" else there["status"]
            limits = there["time_limit"], there["memory_limit"]
            if state in _LIMITED and limits != (run.time_limit, run.memory_limit):
                state = MISSING  # who failed within other limits has said nothing of these
            older = there["code"] != code_of(run)
        if state == DONE and run.record:
            damage = _unfit(files.recording)
            state = MISSING if damage or not files.recording.exists() else DONE
        planned.append(PlannedRun(run, files, Standing(state, older, damage)))
    return planned


def _heads(paths: Sequence[Path]) -> dict[Path, dict[str, Any] | str]:
    if not any(map(shelf.there, paths)):
        return {}
    from harness.base import rows  # brings pyarrow along

    return rows.heads(paths, _TOLD, needed=NEEDED)


def _unfit(recording: Path) -> str:
    """What keeps a recording from being one, without reading all of it; nothing does where there is none."""
    if not recording.exists():
        return ""
    whole = recording.is_file() and whole_messages(recording)[0]
    return "" if whole else f"{recording} is cut before its end"


def _codes() -> Callable[[RunSpec], str]:
    """The digest of the code of runs, which is found once for all that are put together from the same parts."""
    of_parts = cache(code)
    return lambda run: of_parts(parts(run))


def of_other_code(runs: Iterable[RunSpec], table: pa.Table) -> set[str]:
    """The ids of those runs whose rows in the table were made by other code than today's."""
    code_of = _codes()
    here, made = machine.describe().id, dict(zip(*(table[c].to_pylist() for c in ("run_id", "code")), strict=True))
    return {name for run in runs if made.get(name := run.run_id(here)) != code_of(run)}
