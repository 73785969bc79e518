"""Whether moving obstacles leave room: for what is pinned, on all of its way, and for anything at all between planes.

Points that move no faster than L, seen from an obstacle, and lie at a distance d from it at t, are outside of it until
t + d/L: so a way is gone along in steps of that length (conservative advancement, Mirtich 1996, "Impulse-based Dynamic
Simulation of Rigid Body Systems", section 2.3).
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
"""The shortest steps, as parts of the way between two key times and of the whole: what is thinner is not seen."""
_TURNS = 64
"""How often planes that turn are looked at in all."""


def key_times(*motions: KeyedMotion | None) -> list[float]:
    """The start, and the times [s] at which any of these motions has a key."""
    return sorted({0.0, *(time for motion in motions if motion for time in motion.times)})


def nearest(
    obstacle: Obstacle, taken: KeyedMotion | None, targets: Positions, motion: KeyedMotion | None, limit: float
) -> tuple[float, NDArray[np.float64]] | None:
    """The first time [s] at which points declared at `targets` (q, 3) [m] are nearer than `limit` [m] to an obstacle,
    and all their distances (q,) [m] then; None where they never are.

    taken and motion: how the obstacle and the points move, None for those that rest.
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
    """The radius [m] of the largest ball between half-spaces, at most 1; less than zero where there is none."""
    frames = [plane.frame(time) for plane in planes]
    normals, offsets = np.array([f[2] for f in frames]), np.array([f[2] @ f[0] for f in frames])
    # n.x - r >= d for all of them, r as large as can be; about the planes' own points, so that digits are kept
    middle = np.mean([f[0] for f in frames], axis=0)
    unknowns = np.column_stack([-normals, np.ones(len(frames))])
    found = linprog([0, 0, 0, -1], unknowns, normals @ middle - offsets, bounds=[(None, None)] * 3 + [(None, 1)])
    return float(found.x[3]) if found.x is not None else -np.inf


def looks(motions: Sequence[KeyedMotion | None]) -> Iterator[float]:
    """The times [s] at which to look at what these motions move: their keys, and between those where they turn."""
    times = key_times(*motions)
    straight = all(motion.straight for motion in motions if motion)
    between = 1 if straight else max(1, _TURNS // max(1, len(times) - 1))
    for begin, end in pairwise(times):
        yield from np.linspace(begin, end, between, endpoint=False).tolist()
    yield times[-1]
