"""The speed report: the runs of a sweep, side by side with the yardstick and the machine's limits, size by size.

An ordinary sweep says what runs; here all runs of a size are timed in turns, each from the same first step of its
scene. Rows are written when a size is complete; sizes whose rows are there are not done again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from harness.base import machine, rows
from harness.config.load import Sweep
from harness.config.sweep import RunSpec, SolverSpec
from harness.experiments.plan import Files
from harness.experiments.speed import yardstick
from harness.experiments.speed.candidates import Candidate, MachineCandidate, SolverCandidate, YardstickCandidate
from harness.experiments.speed.rest import precision, rest_of
from harness.experiments.speed.turns import Past, measure, name
from harness.report.speed.figures import MACHINE, YARDSTICK
from harness.scenes.bind import build
from harness.simulation.step import problem, start
from solvers.problem import Prepared

TEMPORARIES = {"default": "", "cheap": yardstick.CHEAP_TEMPORARIES}
"""How the yardstick's memory is set up: as it comes, or so that temporaries cost least."""


def run_speed(
    sweep: Sweep, folder: Path, say: Callable[[str], None], *, again: bool = False, budget: float = 210.0
) -> pa.Table:
    """Do the sizes of a sweep that are missing (all with `again`) and return all rows.

    budget: seconds that a candidate may take at a size, as its smaller sizes predict; say: prints a remark.
    Raises InputError.
    """
    runs = [replace(run, threads=machine.threads(run.threads).number) for run in sweep.runs()]
    for threads in {machine.threads(run.threads).number for run in runs}:
        with machine.pinned_threads(threads):  # refuses what this machine cannot do before anything starts
            pass
    (folder / "rows").mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    past: dict[str, list[Past]] = {}
    with rows.alone(folder):
        for group in _groups(runs):
            members = [*group, *_beside(group)]
            paths = [Files.of(run, folder).rows for run in members]
            kept = not again and all(isinstance(rows.first(path), dict) for path in paths)
            if kept and (older := rows.of_other_code(paths, machine.code_hash())):
                say(f"{group[0].scene_name} {group[0].size}: {older}")
            if not kept:
                say(f"{group[0].scene_name} {group[0].size}: {len(members)} candidates take turns")
                for path, found in zip(paths, _measured(members, folder, past, budget), strict=True):
                    rows.write(path, found)
            for run, path in zip(members, paths, strict=True):
                past.setdefault(name(run), []).extend(_past(rows.read([path]).to_pylist()))
            files += paths
        return rows.read(files)


def _groups(runs: Sequence[RunSpec]) -> list[list[RunSpec]]:
    """The runs of each scene and size, smaller sizes first."""
    groups: dict[tuple[str, int], list[RunSpec]] = {}
    for run in sorted(runs, key=lambda run: run.size):
        groups.setdefault((run.scene_name, run.size), []).append(run)
    return list(groups.values())


def _beside(group: Sequence[RunSpec]) -> list[RunSpec]:
    """What is timed beside the runs of a size: the yardstick on one thread, the machine on as many as they use."""
    first = group[0]
    eigen = [
        replace(first, threads=1, solver=SolverSpec(YARDSTICK, {"temporaries": setting})) for setting in TEMPORARIES
    ]
    threads = sorted({run.threads for run in group})
    return eigen + [replace(first, threads=t, solver=SolverSpec(MACHINE, {})) for t in threads]


def _measured(
    runs: Sequence[RunSpec], folder: Path, past: dict[str, list[Past]], budget: float
) -> list[list[dict[str, Any]]]:
    """The rows of each run of one scene and size."""
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
    return measure([candidate(run) for run in runs], counts, past, budget)


def _past(found: Sequence[dict[str, Any]]) -> list[Past]:
    """What the rows of a run tell about larger sizes; nothing where it failed or has no steps."""
    prepare = [row["seconds"] for row in found if row["phase"] == "prepare"]
    iteration = [row["seconds"] / row["iterations"] for row in found if row["phase"] == "step"]
    if not (prepare and iteration):
        return []
    return [Past(found[0]["vertices"], min(prepare), min(iteration))]
