"""The times of a run as the columns of its rows, each set against those of another clock before it is believed.

Whether phases add up to an iteration is told by the medians over the frames: of the sum of the phases' own medians,
and of an iteration of a whole solve next to them. Where steps are compiled as a whole they need not, and a phase of
some microseconds is mostly the call.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from harness.simulation.clock import ITERATION_SHARE
from harness.simulation.measure import ITERATION, Measured, Timing


def rows(measured: Measured) -> list[dict[str, Any]]:
    """The columns that tell of times, a row for each of them. Raises ClocksDisagree."""
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
    """By phase, whether all of them take as long as an iteration; nothing where there are none."""
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
    """The median over the rounds of each phase in each frame [ms]."""
    by_phase: dict[str, list[list[float]]] = {}
    for t in measured.timings:
        if t.frame is not None:
            by_phase.setdefault(t.phase, [[] for _ in range(frames)])[t.frame - 1].append(1e3 * t.seconds)
    return {phase: [float(np.median(times)) for times in series] for phase, series in by_phase.items()}
