"""Clearance of moving obstacles: from pinned points along their motion, and between planes.

Points that move no faster than L relative to an obstacle and are at a distance d from it at time t stay outside of it
until t + d/L. A motion is therefore checked in steps of that length (conservative advancement, Mirtich 1996,
"Impulse-based Dynamic Simulation of Rigid Body Systems", section 2.3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.solvers.contact.half_space.half_space_potential import ConvexObstacle
from springbench.solvers.model.step_problem import Positions

_MIN_STEP_FRACTION_PER_KEY, _MIN_STEP_FRACTION_TOTAL = 512, 4096
"""Maximum numbers of steps between two key times, and in total; shorter overlaps in time are missed."""
_ROTATING_PLANE_SAMPLES = 64
"""Total number of sample times for rotating planes."""


def merge_key_times(*motions: KeyFrameMotion | None) -> list[float]:
    """Return the sorted key times [s] of the motions, including the start."""
    return sorted({0.0, *(time for motion in motions if motion for time in motion.key_times)})


def find_first_violation(
    obstacle: ConvexObstacle,
    obstacle_motion: KeyFrameMotion | None,
    points: Positions,
    point_motion: KeyFrameMotion | None,
    min_distance: float,
) -> tuple[float, NDArray[np.float64]] | None:
    """Find the first time at which points violate the minimum distance from an obstacle.

    Args:
        obstacle: the obstacle.
        obstacle_motion: its motion, None if it is at rest.
        points: declared positions (q, 3) [m].
        point_motion: their motion, None if they are at rest.
        min_distance: minimum distance [m].

    Returns:
        The time [s] and all distances (q,) [m] at that time; None if there is no such time.
    """
    times = merge_key_times(obstacle_motion, point_motion)
    shortest = (times[-1] - times[0]) / _MIN_STEP_FRACTION_TOTAL

    def place(time: float) -> Positions:
        return point_motion.transform_points(points, time) if point_motion else points

    def measure_distance(time: float) -> NDArray[np.float64]:
        return obstacle.signed_distance(place(time), time)

    for begin, end in pairwise(times):
        speed = point_motion.bound_speed(begin, end, points) if point_motion else 0.0
        if obstacle_motion:
            speed += obstacle_motion.bound_speed(begin, end, place(begin), slack=speed * (end - begin))
        time = begin
        while time < end:
            distance = measure_distance(time)
            least = float(distance.min(initial=np.inf))
            if least < min_distance:
                return time, distance
            time += max(
                (least - min_distance) / speed if speed else np.inf,
                (end - begin) / _MIN_STEP_FRACTION_PER_KEY,
                shortest,
            )
    distance = measure_distance(times[-1])
    return (times[-1], distance) if distance.min(initial=np.inf) < min_distance else None


def compute_largest_gap_radius(planes: Sequence[ConvexObstacle], time: float) -> float:
    """Return the radius [m] of the largest ball between half-spaces, at most 1.

    Args:
        planes: obstacles that occupy half-spaces, at least one.
        time: simulated time [s], at which moving planes are placed.

    Returns:
        The radius; negative if no point lies outside of all half-spaces.
    """
    frames = [plane.frame(time) for plane in planes]
    normals, offsets = np.array([f[2] for f in frames]), np.array([f[2] @ f[0] for f in frames])
    from scipy.optimize import linprog  # takes a quarter of a second to import

    # maximise r with n.x - r >= d for all planes; relative to the planes' own points, to preserve digits
    middle = np.mean([f[0] for f in frames], axis=0)
    unknowns = np.column_stack([-normals, np.ones(len(frames))])
    found = linprog([0, 0, 0, -1], unknowns, normals @ middle - offsets, bounds=[(None, None)] * 3 + [(None, 1)])
    return float(found.x[3]) if found.x is not None else -np.inf


def find_sample_times(motions: Sequence[KeyFrameMotion | None]) -> Iterator[float]:
    """Yield sample times [s] of motions: their key times, and intermediate times if they rotate."""
    times = merge_key_times(*motions)
    straight = all(motion.is_piecewise_linear for motion in motions if motion)
    between = 1 if straight else max(1, _ROTATING_PLANE_SAMPLES // max(1, len(times) - 1))
    for begin, end in pairwise(times):
        yield from np.linspace(begin, end, between, endpoint=False).tolist()
    yield times[-1]
