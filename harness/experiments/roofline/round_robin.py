"""Time candidates of one mesh size in round-robin order, A B C A B C.

Disturbances thus affect all candidates alike. Each candidate is first prepared (round 0, cold), then prepared again,
then timed in the sweep's number of rounds. Final positions are compared, and only candidates that agree get times. A
candidate that would take too long, as predicted from its smaller sizes, is skipped with a row that states so.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from math import exp, log
from typing import Any, NamedTuple

import numpy as np
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.execution.worker_process import ProgressCallback
from springbench.harness.experiments.failure_columns import build_failure_columns
from springbench.harness.experiments.provenance import build_run_columns
from springbench.harness.experiments.roofline.benchmark_candidates import BenchmarkCandidate, CandidateTiming
from springbench.harness.simulation.timing_pass import hash_positions
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.platform_calls import read_load_average

NUM_PREPARATIONS = 3
"""Number of preparations of each candidate, including the first."""

MAX_REPEATED_SECONDS = 3.0
"""Duration above which a preparation is not repeated [s]: for a large mesh, cold caches do not matter any more."""

POSITION_RTOL = {"float64": 1e-9, "float32": 1e-5, "float16": 1e-2}
"""Largest difference of final positions, relative to the scene's size, by precision.

float64: round-off of 50 iterations, with stiffness ratios of 1e10 : 1. Below float64 the iterates differ by the
precision of the factor until they converge.
"""

ResultRow = dict[str, Any]


class PastTiming(NamedTuple):
    """Timing of a candidate at a smaller size: warm preparation [s], and one iteration [s]."""

    num_vertices: int
    prepare_seconds: float
    iteration_seconds: float


def measure_round_robin(
    candidates: Sequence[BenchmarkCandidate],
    counts: ResultRow,
    past_timings: Mapping[str, list[PastTiming]],
    budget: float,
    tick: ProgressCallback = lambda phase: None,
) -> list[list[ResultRow]]:
    """Measure the candidates in turn and return the rows of each.

    Args:
        candidates: what to time.
        counts: columns that all rows share.
        past_timings: timings at smaller sizes in ascending order, by `format_candidate_name` of a run.
        budget: time limit of a candidate [s].
        tick: called after each round with the phase.
    """
    rows: dict[BenchmarkCandidate, list[ResultRow]] = {}
    alive: list[BenchmarkCandidate] = []
    with ExitStack() as cleanup:
        for candidate in candidates:
            cleanup.callback(_release_quietly, candidate)
            rows[candidate] = []
            expected = predict_seconds(
                past_timings.get(format_candidate_name(candidate.run), ()), counts["vertices"], candidate.run
            )
            if expected > budget:
                reason = (
                    f"would take {expected:.0f} s by its smaller sizes; the budget of each candidate is {budget:.0f} s"
                )
                rows[candidate].append({"phase": "run", "status": "skipped", "reason": reason})
            else:
                alive.append(candidate)
        for round in range(NUM_PREPARATIONS):
            for candidate in list(alive):
                if rows[candidate] and rows[candidate][-1]["seconds"] > MAX_REPEATED_SECONDS:
                    continue
                with _catch_failure(candidate, rows[candidate], alive):
                    seconds = candidate.prepare()
                    if seconds is not None:
                        rows[candidate].append(_build_row(CandidateTiming("prepare", seconds, {}), round))
            tick("prepare")
        for round in range(max((candidate.run.rounds for candidate in alive), default=0)):
            for candidate in list(alive):
                with _catch_failure(candidate, rows[candidate], alive):
                    rows[candidate] += [_build_row(reading, round) for reading in candidate.time_phases()]
            tick("rounds")
        _compare_positions(rows, alive)
        for candidate in alive:
            rows[candidate] = [candidate.columns | {"status": "ok"} | row for row in rows[candidate]]
        return [[build_run_columns(candidate.run) | counts | row for row in found] for candidate, found in rows.items()]


def format_candidate_name(run: RunSpec) -> str:
    """Return the name of a run that is common to all mesh sizes."""
    return f"{run.scene_name} {run.solver.name} {sorted(run.solver.parameters.items())} {run.threads}"


def predict_seconds(past_timings: Sequence[PastTiming], vertices: int, run: RunSpec) -> float:
    """Predict the seconds of a run from its smaller sizes; 0 without any.

    The last of them is extrapolated by a power law, whose exponent follows from the last two and is at least 1.

    Args:
        past_timings: timings at other sizes, in ascending order.
        vertices: number of vertices of the run.
        run: the run.
    """
    known = [p for p in past_timings if p.num_vertices < vertices]
    if not known:
        return 0.0

    def extrapolate(field: str) -> float:
        last = getattr(known[-1], field)
        if len(known) == 1:
            return last * vertices / known[-1].num_vertices
        grown = log(known[-1].num_vertices / known[-2].num_vertices)
        power = max(1.0, log(last / getattr(known[-2], field)) / grown)
        return last * exp(power * log(vertices / known[-1].num_vertices))

    return NUM_PREPARATIONS * extrapolate("prepare_seconds") + run.rounds * run.max_iterations * extrapolate(
        "iteration_seconds"
    )


@contextmanager
def _catch_failure(
    candidate: BenchmarkCandidate, rows: list[ResultRow], alive: list[BenchmarkCandidate]
) -> Generator[None]:
    """Run a block with the candidate's threads.

    An error becomes its only row and excludes the candidate.
    """
    try:
        with machine_info.limit_threads(machine_info.choose_threads(candidate.run.threads).count):
            yield
    except Exception as error:  # a candidate may raise any exception; the others continue
        rows[:] = [build_failure_columns(error)]
        alive.remove(candidate)


def _build_row(reading: CandidateTiming, round: int) -> ResultRow:
    found = {
        "phase": reading.phase,
        "seconds": reading.call_seconds,
        "round": round,
        "load_average": read_load_average(),
    }
    if reading.phase == "step":
        found["frame"] = 1
    return found | reading.columns


def _compare_positions(rows: dict[BenchmarkCandidate, list[ResultRow]], alive: list[BenchmarkCandidate]) -> None:
    """Close all candidates, exclude those whose positions differ from the first, and store digests."""
    reference: Positions | None = None
    for candidate in list(alive):
        with _catch_failure(candidate, rows[candidate], alive):
            p = candidate.close()
            if p is None:
                continue
            reference = p if reference is None else reference
            apart = float(np.abs(p - reference).max()) / float(np.ptp(reference, axis=0).max())
            limit = POSITION_RTOL[candidate.run.solver.parameters.get("precision", "float64")]
            if not apart <= limit:
                raise RunFailed(
                    f"positions differ from the others' by {apart:.1e} of the scene's size; expected at most {limit}"
                )
            for row in rows[candidate]:
                if row["phase"] == "step":
                    row["positions_digest"] = hash_positions(p)


def _release_quietly(candidate: BenchmarkCandidate) -> None:
    """Close a candidate that may be closed already, or does not respond any more."""
    with suppress(RunFailed, OSError):
        candidate.close()
