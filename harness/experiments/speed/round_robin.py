"""Time candidates of one mesh size in round-robin order, A B C A B C.

Disturbances thus affect all candidates alike.

Each candidate is first prepared (round 0, cold), then prepared again, then timed in the sweep's number of rounds. Final
positions are compared, and only candidates that agree keep their times. A candidate that would take too long, as
predicted from its smaller sizes, is skipped with a row that states so.
"""

from __future__ import annotations

import os
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from math import exp, log
from typing import Any, NamedTuple

import numpy as np

from harness.base import machine
from harness.base.errors import RunFailed
from harness.base.worker import Tick
from harness.config.sweep import RunSpec
from harness.experiments.failure import failure
from harness.experiments.provenance import common
from harness.experiments.speed.candidates import Candidate, Reading
from harness.simulation.measure import digest
from solvers.problem import Positions

PREPARES = 3
"""Number of preparations of each candidate, including the first."""

LONG = 3.0
"""Duration above which a preparation is not repeated [s]: for a large mesh, cold caches do not matter any more."""

AGREEMENT = {"float64": 1e-9, "float32": 1e-5, "float16": 1e-2}
"""Largest difference of final positions, relative to the scene's size, by precision.

float64: round-off of 50 iterations, with stiffness ratios of 1e10 : 1. Below float64 the iterates differ by the
precision of the factor until they converge.
"""

Row = dict[str, Any]


class Past(NamedTuple):
    """Timing of a candidate at a smaller size: warm preparation [s], and one iteration [s]."""

    vertices: int
    prepare: float
    iteration: float


def measure(
    candidates: Sequence[Candidate],
    counts: Row,
    past: Mapping[str, list[Past]],
    budget: float,
    tick: Tick = lambda phase: None,
) -> list[list[Row]]:
    """Measure the candidates in turn and return the rows of each.

    Args:
        candidates: what to time.
        counts: columns that all rows share.
        past: timings at smaller sizes in ascending order, by `name` of a run.
        budget: time limit of a candidate [s].
        tick: called after each round with the phase.
    """
    rows: dict[Candidate, list[Row]] = {}
    alive: list[Candidate] = []
    with ExitStack() as cleanup:
        for candidate in candidates:
            cleanup.callback(_closed, candidate)
            rows[candidate] = []
            wanted = predicted(past.get(name(candidate.run), ()), counts["vertices"], candidate.run)
            if wanted > budget:
                said = f"would take {wanted:.0f} s by its smaller sizes; the budget of each candidate is {budget:.0f} s"
                rows[candidate].append({"phase": "run", "status": "skipped", "reason": said})
            else:
                alive.append(candidate)
        for round in range(PREPARES):
            for candidate in list(alive):
                if rows[candidate] and rows[candidate][-1]["seconds"] > LONG:
                    continue
                with _guarded(candidate, rows[candidate], alive):
                    seconds = candidate.prepare()
                    if seconds is not None:
                        rows[candidate].append(_row(Reading("prepare", seconds, {}), round))
            tick("prepare")
        for round in range(max((candidate.run.rounds for candidate in alive), default=0)):
            for candidate in list(alive):
                with _guarded(candidate, rows[candidate], alive):
                    rows[candidate] += [_row(reading, round) for reading in candidate.turn()]
            tick("turns")
        _compare(rows, alive)
        for candidate in alive:
            rows[candidate] = [candidate.columns | {"status": "ok"} | row for row in rows[candidate]]
        return [[common(candidate.run) | counts | row for row in found] for candidate, found in rows.items()]


def name(run: RunSpec) -> str:
    """Return the name of a run that is common to all mesh sizes."""
    return f"{run.scene_name} {run.solver.name} {sorted(run.solver.parameters.items())} {run.threads}"


def predicted(past: Sequence[Past], vertices: int, run: RunSpec) -> float:
    """Predict the seconds of a run from its smaller sizes; 0 without any.

    A power law passes through the last two of them.

    Args:
        past: timings at other sizes, in ascending order.
        vertices: number of vertices of the run.
        run: the run.
    """
    known = [p for p in past if p.vertices < vertices]
    if not known:
        return 0.0

    def at(field: str) -> float:
        last = getattr(known[-1], field)
        if len(known) == 1:
            return last * vertices / known[-1].vertices
        grown = log(known[-1].vertices / known[-2].vertices)
        power = max(1.0, log(last / getattr(known[-2], field)) / grown)
        return last * exp(power * log(vertices / known[-1].vertices))

    return PREPARES * at("prepare") + run.rounds * run.iterations * at("iteration")


@contextmanager
def _guarded(candidate: Candidate, rows: list[Row], alive: list[Candidate]) -> Generator[None]:
    """Run a block with the candidate's threads.

    An error becomes its only row and excludes the candidate.
    """
    try:
        with machine.pinned_threads(machine.threads(candidate.run.threads).number):
            yield
    except Exception as error:  # whatever one of them raises, the others go on
        rows[:] = [failure(error)]
        alive.remove(candidate)


def _row(reading: Reading, round: int) -> Row:
    found = {"phase": reading.phase, "seconds": reading.seconds, "round": round, "load": os.getloadavg()[0]}
    if reading.phase == "step":
        found["frame"] = 1
    return found | reading.columns


def _compare(rows: dict[Candidate, list[Row]], alive: list[Candidate]) -> None:
    """Close all candidates, exclude those whose positions differ from the first, and store digests."""
    reference: Positions | None = None
    for candidate in list(alive):
        with _guarded(candidate, rows[candidate], alive):
            p = candidate.close()
            if p is None:
                continue
            reference = p if reference is None else reference
            apart = float(np.abs(p - reference).max()) / float(np.ptp(reference, axis=0).max())
            limit = AGREEMENT[candidate.run.solver.parameters.get("precision", "float64")]
            if not apart <= limit:
                raise RunFailed(f"its positions lie {apart:.1e} of the scene's size from the others'; wanted {limit}")
            for row in rows[candidate]:
                if row["phase"] == "step":
                    row["digest"] = digest(p)


def _closed(candidate: Candidate) -> None:
    """Close a candidate that may be closed already, or does not respond any more."""
    with suppress(RunFailed, OSError):
        candidate.close()
