"""Speed report: a sweep's runs, the C++ baseline and the roofline, by size.

An ordinary sweep specifies the runs. All runs of a size are one unit here. They are timed interleaved in one process,
each from the same first step of its scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import pyarrow as pa

from harness.base import holding, machine, rows
from harness.base.columns import SCHEMA
from harness.base.progress import Display, Effort
from harness.base.workers import Limits, Lost, Tick
from harness.config.load import Sweep
from harness.config.sweep import RunSpec, SolverSpec
from harness.experiments.core import do_all, require_threads
from harness.experiments.plan import Files
from harness.experiments.provenance import common
from harness.experiments.resume import MISSING, Standing, standings, wanted
from harness.experiments.speed import yardstick
from harness.experiments.speed.candidates import Candidate, MachineCandidate, SolverCandidate, YardstickCandidate
from harness.experiments.speed.rest import precision, rest_of
from harness.experiments.speed.round_robin import PREPARES, Past, measure, name
from harness.report.speed.figures import MACHINE, YARDSTICK
from harness.scenes.bind import build
from harness.simulation.step import problem, start
from solvers.problem import Prepared

TEMPORARIES = {"default": "", "cheap": yardstick.CHEAP_TEMPORARIES}
"""Memory settings of the C++ baseline: the defaults, or those that make temporaries cheapest."""


PATIENCE = 3600.0
"""Wall time of a size in addition to four times the budget of each candidate, for compiling, preparing, checking [s].
"""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Runs of one scene and size with their baselines (`harness.experiments.core.Unit`).

    Attributes:
        members: the runs, and those of the baselines.
        folder: folder of the results.
        smaller: name and file of rows of each candidate of a smaller size, smallest first.
        budget: time limit of a candidate, as predicted from its smaller sizes [s].
    """

    members: tuple[RunSpec, ...]
    folder: Path
    smaller: tuple[tuple[str, Path], ...]
    budget: float

    @property
    def files(self) -> list[Path]:
        """Files of the rows of each candidate."""
        return [Files.of(run, self.folder).rows for run in self.members]

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        first = self.members[0]
        return f"{first.scene_name} {first.size}: {len(self.members)} candidates take turns"

    @property
    def ticks(self) -> int:
        """Number of rounds of preparation and of timing."""
        return PREPARES + max(run.rounds for run in self.members)

    @property
    def effort(self) -> Effort:
        """Estimated cost, proportional to the number of vertices."""
        return Effort(amount=float(self.members[0].size or 32) ** 2)

    @property
    def limits(self) -> Limits:
        """Wall-time limit, from the budget of all candidates."""
        return Limits(PATIENCE + 4.0 * self.budget * len(self.members))

    @property
    def standing(self) -> Standing:
        """Completion status: completed if the rows of all candidates exist."""
        found = list(standings(dict.fromkeys(self.files, lambda row: True), (), SCHEMA).values())
        missing = next((one for one in found if one.state == MISSING), None)
        return missing or found[0]._replace(older=any(one.older for one in found))

    def do(self, tick: Tick) -> str:
        """Time all candidates, write their rows and return the outcome as text."""
        past: dict[str, list[Past]] = {}
        for candidate, path in self.smaller:
            past.setdefault(candidate, []).extend(_past(rows.read([path]).to_pylist()))
        return self._written(_measured(self.members, self.folder, past, self.budget, tick))

    def lost(self, lost: Lost) -> str:
        """Write a row for each candidate of a lost unit, and return a message."""
        why = {"phase": "run", "status": lost.status, "reason": str(lost)}
        return self._written([[common(run) | why] for run in self.members])

    def _written(self, measured: Sequence[list[dict[str, Any]]]) -> str:
        for path, found in zip(self.files, measured, strict=True):
            rows.write(path, found)
        bad = [found[0]["solver"] for found in measured if found[0]["status"] not in ("ok", "skipped", "unsupported")]
        return f"{', '.join(dict.fromkeys(bad))} failed" if bad else "ok"


def run_speed(
    sweep: Sweep,
    folder: Path,
    display: Display,
    say: Callable[[str], None],
    *,
    again: bool = False,
    changed: bool = False,
    budget: float = 210.0,
    isolated: bool = True,
) -> pa.Table:
    """Execute the missing sizes of a sweep and return all rows.

    Args:
        sweep: the sweep.
        folder: folder of the results.
        display: shows progress.
        say: prints a remark.
        again: whether to repeat all sizes.
        changed: whether to repeat sizes measured by other source code.
        budget: time limit of a candidate at a size, as predicted from its smaller sizes [s].
        isolated: see `harness.experiments.core.do_all`.

    Raises:
        InputError: an option is invalid.
    """
    runs = [run.but(threads=machine.threads(run.threads).number) for run in sweep.runs()]
    require_threads({machine.threads(run.threads).number for run in runs})
    (folder / "rows").mkdir(parents=True, exist_ok=True)
    with holding.alone(folder):
        planned: list[Comparison] = []
        smaller: list[tuple[str, Path]] = []
        for group in _groups(runs):
            planned.append(Comparison((*group, *_beside(group)), folder, tuple(smaller), budget))
            smaller += zip(map(name, planned[-1].members), planned[-1].files, strict=True)
        do_all(wanted(planned, "sizes", say, again=again, changed=changed), display, isolated=isolated)
        return rows.read(path for size in planned for path in size.files)


def _groups(runs: Sequence[RunSpec]) -> list[list[RunSpec]]:
    """Group the runs by scene and size, smaller sizes first."""
    groups: dict[tuple[str, int], list[RunSpec]] = {}
    for run in sorted(runs, key=lambda run: run.size):
        groups.setdefault((run.scene_name, run.size), []).append(run)
    return list(groups.values())


def _beside(group: Sequence[RunSpec]) -> list[RunSpec]:
    """Build the baseline runs of a size.

    These are the C++ baseline on one thread, and the machine on as many threads as the runs use.
    """
    first = group[0]
    eigen = [first.but(threads=1, solver=SolverSpec(YARDSTICK, {"temporaries": setting})) for setting in TEMPORARIES]
    threads = sorted({run.threads for run in group})
    return eigen + [first.but(threads=t, solver=SolverSpec(MACHINE, {})) for t in threads]


def _measured(
    runs: Sequence[RunSpec], folder: Path, past: dict[str, list[Past]], budget: float, tick: Tick
) -> list[list[dict[str, Any]]]:
    """Measure all runs of one scene and size, and return the rows of each."""
    scene = build(runs[0].scene, runs[0].size)
    stated = problem(scene, start(scene), runs[0].first_guess)
    program = partial(yardstick.build, folder / "build")
    prepared: dict[str, Prepared] = {}
    rest = rest_of(stated) if any(precision(run) != "float64" for run in runs) else None

    def candidate(run: RunSpec) -> Candidate:
        if run.solver.name == MACHINE:
            return MachineCandidate(run)
        if run.solver.name == YARDSTICK:
            return YardstickCandidate(run, scene, stated, program, TEMPORARIES[run.solver.parameters["temporaries"]])
        return SolverCandidate(run, scene, stated, prepared, rest)

    counts = {"vertices": len(scene.mesh.rest), "springs": len(scene.springs.edges)}
    return measure([candidate(run) for run in runs], counts, past, budget, tick)


def _past(found: Sequence[dict[str, Any]]) -> list[Past]:
    """Return the timing that predicts larger sizes from a run's rows.

    The result is empty if it failed or has no steps.
    """
    prepare = [row["seconds"] for row in found if row["phase"] == "prepare"]
    iteration = [row["seconds"] / row["iterations"] for row in found if row["phase"] == "step"]
    if not (prepare and iteration):
        return []
    return [Past(found[0]["vertices"], median(prepare), median(iteration))]
