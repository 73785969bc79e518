"""Timing columns of a run's rows, checked against another clock.

Whether phases add up to an iteration is decided by medians over the frames: of the sum of the phases' own medians, and
of an iteration of a whole solve measured next to them. They need not add up where steps are compiled as a whole, or
where a phase of some microseconds is mostly call overhead.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from springbench.harness.simulation.stopwatch import PHASE_SUM_RTOL
from springbench.harness.simulation.timing_pass import ITERATION_PHASE, RunMeasurement, TimingSample


def build_timing_rows(measured: RunMeasurement) -> list[dict[str, Any]]:
    """Build the timing columns, one row for each time; raises ClockMismatch."""
    groups: dict[tuple[str, int | None], list[TimingSample]] = defaultdict(list)
    for timing in measured.timings:
        groups[timing.phase, measured.get_round(timing)].append(timing)
    adds_up, found = _check_phase_sums(measured.timings), list[dict[str, Any]]()
    for (phase, _), timings in groups.items():
        rows: list[dict[str, Any]] = [
            {
                "phase": phase,
                "frame": t.frame,
                "round": t.round,
                "seconds": t.seconds,
                "phases_consistent": adds_up.get(phase),
            }
            | t.device_columns
            for t in timings
        ]
        watch = measured.watches[phase, measured.get_round(timings[0])]
        seen = watch.build_columns(phase, (row["seconds"] * t.num_calls for row, t in zip(rows, timings, strict=True)))
        found += [row | seen for row in rows]
    return found


def _check_phase_sums(timings: list[TimingSample]) -> dict[str, bool]:
    """Check whether all phases together take as long as an iteration; empty without phases."""
    by_frame: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for t in timings:
        if t.frame is not None and t.phase != "step":
            by_frame[t.phase][t.frame].append(t.seconds)
    medians = {
        phase: np.array([np.median(times) for _, times in sorted(frames.items())]) for phase, frames in by_frame.items()
    }
    if ITERATION_PHASE not in medians:
        return {}
    iteration = medians.pop(ITERATION_PHASE)
    ratio = float(np.median(sum(medians.values()) / iteration))
    return dict.fromkeys([*medians, ITERATION_PHASE], bool(abs(ratio - 1.0) <= PHASE_SUM_RTOL))


def compute_milliseconds(measured: RunMeasurement, frames: int) -> dict[str, list[float]]:
    """Compute the median over the rounds of each phase in each frame [ms]."""
    by_phase: dict[str, list[list[float]]] = {}
    for t in measured.timings:
        if t.frame is not None:
            by_phase.setdefault(t.phase, [[] for _ in range(frames)])[t.frame - 1].append(1e3 * t.seconds)
    return {phase: [float(np.median(times)) for times in series] for phase, series in by_phase.items()}
