"""Timing columns of a run's rows, checked against another clock.

Whether phases add up to an iteration is decided by medians over the frames: of the sum of the phases' own medians, and
of an iteration of a whole solve measured next to them. They need not add up where steps are compiled as a whole, or
where a phase of some microseconds is mostly call overhead.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from harness.simulation.clock import ITERATION_SHARE
from harness.simulation.measure import ITERATION, Measured, Timing


def rows(measured: Measured) -> list[dict[str, Any]]:
    """Build the timing columns, one row for each time; raises ClocksDisagree."""
    groups: dict[tuple[str, int | None], list[Timing]] = defaultdict(list)
    for timing in measured.timings:
        groups[timing.phase, measured.pass_of(timing)].append(timing)
    adds_up, found = _adds_up(measured.timings), list[dict[str, Any]]()
    for (phase, _), timings in groups.items():
        told: list[dict[str, Any]] = [
            {"phase": phase, "frame": t.frame, "round": t.round, "seconds": t.seconds, "adds_up": adds_up.get(phase)}
            | t.device
            for t in timings
        ]
        watch = measured.watches[phase, measured.pass_of(timings[0])]
        seen = watch.columns(phase, (row["seconds"] * t.calls for row, t in zip(told, timings, strict=True)))
        found += [row | seen for row in told]
    return found


def _adds_up(timings: list[Timing]) -> dict[str, bool]:
    """Check whether all phases together take as long as an iteration; empty without phases."""
    by_frame: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for t in timings:
        if t.frame is not None and t.phase != "step":
            by_frame[t.phase][t.frame].append(t.seconds)
    medians = {
        phase: np.array([np.median(times) for _, times in sorted(frames.items())]) for phase, frames in by_frame.items()
    }
    if ITERATION not in medians:
        return {}
    iteration = medians.pop(ITERATION)
    ratio = float(np.median(sum(medians.values()) / iteration))
    return dict.fromkeys([*medians, ITERATION], bool(abs(ratio - 1.0) <= ITERATION_SHARE))


def milliseconds(measured: Measured, frames: int) -> dict[str, list[float]]:
    """Compute the median over the rounds of each phase in each frame [ms]."""
    by_phase: dict[str, list[list[float]]] = {}
    for t in measured.timings:
        if t.frame is not None:
            by_phase.setdefault(t.phase, [[] for _ in range(frames)])[t.frame - 1].append(1e3 * t.seconds)
    return {phase: [float(np.median(times)) for times in series] for phase, series in by_phase.items()}
