"""Execute the missing runs of a sweep, then draw the pictures that compare them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from harness.base import holding, machine, rows
from harness.base.asides import is_step
from harness.base.errors import InputError, Mistake, RunFailed
from harness.base.holding import Claims
from harness.base.progress import Display
from harness.base.workers import Limits, Lost, Workers
from harness.config.sweep import RunSpec
from harness.experiments.core import do_all, do_together, require_threads, workers_at_once
from harness.experiments.plan import NEEDED, Files, of_other_code, plan
from harness.experiments.resume import wanted
from harness.experiments.run_unit import RunUnit

if TYPE_CHECKING:
    from harness.experiments.cluster import Cluster


_FEW = 100
"""Largest number of runs for which the start-up time of the drawing code matters and the rows are small enough to send.
"""


def _away(on: str, runs: Sequence[RunSpec], say: Callable[[str], None]) -> AbstractContextManager[Cluster]:
    try:
        from harness.experiments.cluster import cluster
    except ModuleNotFoundError as error:
        raise InputError(Mistake(f"needs {error.name}: pip install 'springbench[cluster]'", key="--on")) from None
    return cluster(on, runs, say)


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
    at_once: int | None = None,
    on: str | None = None,
    meanwhile: Callable[[], object] = int,
) -> pa.Table:
    """Execute the missing runs of a sweep, draw its pictures and return all rows.

    Args:
        name: name of the sweep.
        runs: its runs.
        folder: its folder in the results.
        display: shows progress.
        say: prints a remark.
        again: whether to repeat all runs; `positions` implies it.
        changed: whether to repeat runs whose rows come from other source code.
        positions: where to store the positions of the sweep's only run.
        isolated: whether runs are executed in worker processes with limits, or in this process.
        at_once: number of worker processes; chosen by cores and memory if left out.
        on: where else to execute the runs (`harness.experiments.cluster`).
        meanwhile: called while another process draws.

    Raises:
        InputError: the options contradict each other, or the input is invalid.
        RunFailed: the drawing process was lost.
    """
    if on and (positions or not isolated):
        raise InputError("--positions and --here are of this machine; leave --on out")
    if positions and len(runs) != 1:
        raise InputError(f"--positions stores the positions of one run; this is {len(runs)} runs")
    if not on:
        require_threads({machine.threads(run.threads).number for run in runs})
    for part in ("rows", "recordings", "pictures"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    with ExitStack() as held:
        held.enter_context(holding.together(folder))
        away = held.enter_context(_away(on, runs, say)) if on else None
        machines = away.machines if away else (None,)
        claims = held.enter_context(
            closing(Claims(folder, [Files.of(r, folder, m).rows for r in runs for m in machines]))
        )
        planned = plan(runs, folder, machines)
        todo = wanted(planned, "runs", say, again=again or positions is not None, changed=changed)
        drawing: Workers | None = None
        here = isolated and not away
        if here and len(runs) <= _FEW and any(p.run.record and p.run.pictures for p in todo):
            drawing = Workers(_ready_to_draw)
            held.callback(drawing.end)
            drawing.begin()
        if todo and not away:
            import_module("harness.experiments.run")  # here, for workers that are forks of this process
            if any(p.run.judge for p in todo):
                import_module("harness.experiments.standing")
        many = min(at_once or workers_at_once(), max(1, len(todo)))
        units = [RunUnit(p.run, p.files, positions, 1 if p.run.timing == "exclusive" else many) for p in todo]
        if away:
            do_together(units, claims, partial(away.do_all, folder, display), say)
            planned = plan(runs, folder, machines)
        else:
            do_here = partial(do_all, display=display, isolated=isolated, at_once=many)
            do_together(units, claims, lambda some, another: do_here(some, another=another), say)
        from harness.report.sweep import Pictured, draw_sweep

        table = rows.read((p.files.rows for p in planned), needed=NEEDED)
        pictured = [Pictured(p.run, p.files.recording, p.files.picture) for p in planned]
        draw = partial(draw_sweep, name, pictured, folder, table, at_once=many, older=of_other_code(runs, table))
        if drawing is None:
            draw(say)
            return table
        try:
            drawing.do(draw, lambda said: say(said) if is_step(said) else None, Limits(), meanwhile)
        except Lost as lost:
            raise RunFailed(
                f"the process that draws {lost}; what was measured is kept, and the same command draws it"
            ) from None
    return table


def _ready_to_draw() -> None:
    """In the drawing process of a small sweep: load the drawing code.

    This takes 1 to 2 s, during the runs.
    """
    from harness.report.sweep import get_ready

    get_ready()


def failures(table: pa.Table) -> list[str]:
    """Return a line for each failed run: scene, size, solver, status and reason."""
    ended = table.select(["scene", "size", "solver", "status", "reason"]).to_pylist()
    failed = [row for row in ended if row["status"] != "ok"]
    lines = [f"{r['scene']} {r['size']} {r['solver']}: {r['status']}: {r['reason']}" for r in failed]
    return list(dict.fromkeys(lines))  # a run that was done to its end has a row for each step
