"""Clearance of moving obstacles: of pinned points along their motion, and between planes.

Points that move no faster than L relative to an obstacle and are at a distance d from it at time t stay outside of it
until t + d/L. A motion is therefore checked in steps of that length (conservative advancement, Mirtich 1996,
"Impulse-based Dynamic Simulation of Rigid Body Systems", section 2.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from harness.scenes.motion import KeyedMotion
from solvers.contact.energy import Obstacle
from solvers.problem import Positions

_PARTS, _ALL = 512, 4096
"""Shortest steps relative to the interval between two key times, and to the whole; thinner overlaps are missed."""
_TURNS = 64
"""Total number of sample times for rotating planes."""


def key_times(*motions: KeyedMotion | None) -> list[float]:
    """Return the sorted key times [s] of the motions, including the start."""
    return sorted({0.0, *(time for motion in motions if motion for time in motion.times)})


def nearest(
    obstacle: Obstacle, taken: KeyedMotion | None, targets: Positions, motion: KeyedMotion | None, limit: float
) -> tuple[float, NDArray[np.float64]] | None:
    """Find the first time at which points are closer to an obstacle than a minimum distance.

    Args:
        obstacle: the obstacle.
        taken: its motion, None if it is at rest.
        targets: declared positions (q, 3) [m].
        motion: their motion, None if they are at rest.
        limit: [m].

    Returns:
        The time [s] and all distances (q,) [m] at that time, None if there is no such time.
    """
    times = key_times(taken, motion)
    shortest = (times[-1] - times[0]) / _ALL

    def place(time: float) -> Positions:
        return motion.moved(targets, time) if motion else targets

    def look(time: float) -> NDArray[np.float64]:
        return obstacle.distance(place(time), time)

    for begin, end in pairwise(times):
        speed = motion.speed(begin, end, targets) if motion else 0.0
        if taken:
            speed += taken.speed(begin, end, place(begin), slack=speed * (end - begin))
        time = begin
        while time < end:
            distance = look(time)
            least = float(distance.min(initial=np.inf))
            if least < limit:
                return time, distance
            time += max((least - limit) / speed if speed else np.inf, (end - begin) / _PARTS, shortest)
    distance = look(times[-1])
    return (times[-1], distance) if distance.min(initial=np.inf) < limit else None


def gap(planes: Sequence[Obstacle], time: float) -> float:
    """Return the radius [m] of the largest ball between half-spaces, at most 1; negative if they overlap."""
    frames = [plane.frame(time) for plane in planes]
    normals, offsets = np.array([f[2] for f in frames]), np.array([f[2] @ f[0] for f in frames])
    # maximise r with n.x - r >= d for all planes; relative to the planes' own points, to preserve digits
    middle = np.mean([f[0] for f in frames], axis=0)
    unknowns = np.column_stack([-normals, np.ones(len(frames))])
    found = linprog([0, 0, 0, -1], unknowns, normals @ middle - offsets, bounds=[(None, None)] * 3 + [(None, 1)])
    return float(found.x[3]) if found.x is not None else -np.inf


def looks(motions: Sequence[KeyedMotion | None]) -> Iterator[float]:
    """Yield sample times [s] of motions: their key times, and intermediate times if they rotate."""
    times = key_times(*motions)
    straight = all(motion.straight for motion in motions if motion)
    between = 1 if straight else max(1, _TURNS // max(1, len(times) - 1))
    for begin, end in pairwise(times):
        yield from np.linspace(begin, end, between, endpoint=False).tolist()
    yield times[-1]
