"""Sweeps: does the runs that are missing, and only those, then draws what compares them.

A run is complete when its rows, its recording and its picture are in place. Rows are written after the recording,
and a picture is drawn from the recording alone, so what a kill leaves undone is told from the files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from harness.base import machine, rows
from harness.base.errors import InputError
from harness.base.progress import Display
from harness.base.workers import Limits, Lost, Tick
from harness.config.sweep import RunSpec
from harness.experiments.code import code, parts
from harness.experiments.core import do_all, require_threads
from harness.experiments.run import Files, common, execute
from harness.record.sound import whole_messages
from harness.report.sweep import Pictured, draw_sweep
from solvers.plugins import Plugin

DONE, MISSING = "done", "missing"
NEEDED = ("run_id", "scene", "size", "solver", "status", "code")
"""Columns without which a row tells nothing of a run."""

_LIMITED = ("failed", "time-limit", "killed")
"""How a run may end for its limits."""

_NAMED = 8
"""So many runs are named where more are meant."""


@dataclass(frozen=True, slots=True)
class Planned:
    """A run of a sweep, its files, and its state: done, missing, or the status of a run that failed.

    older: whether its rows were made by other code than today's; damage: what is wrong with its rows or its recording,
    for which it is missing.
    """

    run: RunSpec
    files: Files
    state: str
    older: bool
    damage: str = ""

    @property
    def title(self) -> str:
        """The run in words."""
        return _title(self.run)


def _title(run: RunSpec) -> str:
    return f"{run.scene_name}{f' {run.size}' if run.size else ''} {run.solver.name}"


@dataclass(frozen=True, slots=True)
class RunUnit:
    """A run as a unit of a sweep (`harness.experiments.core.Unit`). positions: where to store those of its steps."""

    run: RunSpec
    files: Files
    positions: Path | None = None

    @property
    def title(self) -> str:
        """The run in words."""
        return _title(self.run)

    @property
    def ticks(self) -> int:
        """The steps of the pass that warms up, of the timed ones and of the second pass."""
        return self.run.frames * (self.run.rounds + 2)

    @property
    def work(self) -> float:
        """A rough measure of the run's effort, for the time left."""
        return (self.run.size or 32) ** 2 * self.ticks * self.run.iterations

    @property
    def limits(self) -> Limits:
        """What the sweep says."""
        return Limits(self.run.time_limit, self.run.memory_limit)

    def do(self, tick: Tick) -> str:
        """See Unit."""
        return _outcome(execute(self.run, self.files, tick, positions=self.positions))

    def lost(self, lost: Lost) -> str:
        """See Unit."""
        return _outcome(_abandoned(self.run, self.files, lost.status, str(lost)))


def plan(runs: Iterable[RunSpec], folder: Path) -> list[Planned]:
    """Each run with its files and what is there already."""
    codes: dict[frozenset[type | Plugin], str] = {}
    planned = []
    for run in runs:
        files = Files.of(run, folder)
        state, older, damage = MISSING, False, ""
        if files.rows.exists():
            there = rows.first(files.rows, needed=NEEDED)
            if isinstance(there, str):
                damage = f"{files.rows} {there}"
            else:
                state = DONE if there["status"] == "ok" else there["status"]
                limits = there["time_limit"], there["memory_limit"]
                if state in _LIMITED and limits != (run.time_limit, run.memory_limit):
                    state = MISSING  # who failed within other limits has said nothing of these
                if (made_of := parts(run)) not in codes:
                    codes[made_of] = code(made_of)
                older = there["code"] != codes[made_of]
            if state == DONE and run.record:
                damage = _unfit(files.recording)
                state = MISSING if damage or not files.recording.exists() else DONE
        planned.append(Planned(run, files, state, older, damage))
    return planned


def _abandoned(run: RunSpec, files: Files, status: str, reason: str) -> list[dict[str, Any]]:
    """The rows of a run whose process gave no answer, written; what it left half written is removed."""
    for earlier in (files.recording, files.picture):
        earlier.unlink(missing_ok=True)
        for partial in earlier.parent.glob(".*partial*"):
            partial.unlink()
    found = [common(run) | {"code": code(parts(run))} | {"phase": "run", "status": status, "reason": reason}]
    rows.write(files.rows, found)
    return found


def _unfit(recording: Path) -> str:
    """What keeps a recording from being one, without reading all of it; nothing does where there is none."""
    if not recording.exists():
        return ""
    whole = recording.is_file() and whole_messages(recording)[0]
    return "" if whole else f"{recording} is cut before its end"


def run_sweep(
    name: str,
    runs: Sequence[RunSpec],
    folder: Path,
    display: Display,
    say: Callable[[str], None],
    *,
    again: bool = False,
    changed: bool = False,
    positions: Path | None = None,
    isolated: bool = True,
) -> pa.Table:
    """Do what is missing of a sweep, all of it with `again` or `positions`, with `changed` also what was done by other
    code than today's, and return all its rows.

    say: prints a remark; positions: where to store the positions of the sweep's only run; isolated: whether runs are
    done in a process that may die, within their limits, or in this one. Raises InputError.
    """
    if positions and len(runs) != 1:
        raise InputError(f"--positions stores the positions of one run; this is {len(runs)} runs")
    require_threads({machine.threads(run.threads).number for run in runs})
    for part in ("rows", "recordings", "pictures"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    with rows.alone(folder):
        planned = plan(runs, folder)
        todo = [p for p in planned if p.state == MISSING or again or positions or (changed and p.older)]
        if len(todo) < len(planned):
            say(f"{len(planned) - len(todo)} of {len(planned)} runs are there already")
        _say_older([p for p in planned if p.older and p not in todo], say)
        for p in todo:
            if p.damage:
                say(f"{p.damage}; its run is done again")
        do_all([RunUnit(p.run, p.files, positions) for p in todo], display, isolated=isolated)
        table = rows.read((p.files.rows for p in planned), needed=NEEDED)
        pictured = [Pictured(p.run, p.files.recording, p.files.picture) for p in planned]
        draw_sweep(name, pictured, folder, table, say)
    return table


def _say_older(older: list[Planned], say: Callable[[str], None]) -> None:
    """Say which runs that are shown were done by other code."""
    if older:
        more = f" and {len(older) - _NAMED} more" if len(older) > _NAMED else ""
        say(f"{len(older)} of them by other code than today's: {', '.join(p.title for p in older[:_NAMED])}{more}")
        say("--changed does these again, --again does all")


def of_other_code(runs: Iterable[RunSpec], table: pa.Table) -> set[str]:
    """The ids of those runs whose rows in the table were made by other code than today's."""
    here, made = machine.describe().id, dict(zip(*(table[c].to_pylist() for c in ("run_id", "code")), strict=True))
    return {name for run in runs if made.get(name := run.run_id(here)) != code(parts(run))}


def _outcome(found: list[dict[str, Any]]) -> str:
    if found[0]["status"] != "ok":
        return f"{found[0]['status']}: {found[0]['reason']}"
    best = min(row["seconds"] for row in found if row["phase"] == "step")
    return f"{1e3 * best:.3g} ms a step"


def failures(table: pa.Table) -> list[str]:
    """Scene, size, solver, status and reason of the runs that failed."""
    failed = [row for row in table.to_pylist() if row["status"] != "ok"]
    return [f"{r['scene']} {r['size']} {r['solver']}: {r['status']}: {r['reason']}" for r in failed]
