# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownLambdaType=false
# SciPy's and NumPy's stubs leave the types of some results unknown.
"""A submission: positions of others, with a scene's frame numbers and vertex order.

Nothing is matched silently: each decision is a sentence in `notes`. The number of the first frame is stated by the
caller or the file; otherwise it is 0 where the first positions are the scene's start, and 1 where they are not. The
vertices are in the scene's order unless rest positions, those of a file or of frame 0, show another one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.experiments.grading.position_files import PositionSequence
from springbench.harness.experiments.grading.spring_terms import compute_position_before_start
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state
from springbench.solvers.model.step_problem import Positions

AXES = tuple(permutations(range(3)))
"""Orders of the axes; the first is the usual one."""
IMPLAUSIBLE_STRETCH = 1.5
"""Median stretch of springs after a step, from which on another order of vertices is suspected."""
MATCH_FRACTION = 1e-3
"""Largest distance of two rest positions that are matched, relative to the diagonal of the bounding box."""
START_FRACTION = 1e-9
"""Largest distance of a start from the scene's, relative to that diagonal, in addition to twice the file's rounding."""
TIME_TOLERANCE = 1e-3
"""Largest difference of a stated time from that of its step, in time steps, for each step since the first frame."""
MAX_POSITION = 1e100
"""Largest coordinate [m] that counts as finite: its square can be summed."""
_SAMPLES = 4000
"""Number of coordinates from which the precision of a file is estimated."""


class StoredPrecision(NamedTuple):
    """Rounding error of stored coordinates.

    Attributes:
        absolute: error [m] of decimals.
        relative: error of digits, relative to the largest coordinate.
    """

    absolute: float
    relative: float

    def bound_error(self, *positions: Positions) -> float:
        """Bound the error [m] of a coordinate of some positions."""
        return max(self.absolute, self.relative * max(float(np.abs(p).max(initial=0.0)) for p in positions))


@dataclass(frozen=True, eq=False)
class SubmittedMotion:
    """Positions of a scene's steps.

    Attributes:
        source: the file or folder.
        positions: (k + 2, n, 3) [m]: one step before the start, the start, and after each of k steps.
        has_start: whether the submission contains the start itself; otherwise it is the scene's.
        precision: error of coordinates by the digits that are stored.
        notes: sentences on frame numbers, vertex order and precision.
        time_step: [s].
    """

    source: Path
    positions: NDArray[np.float64]
    has_start: bool
    precision: StoredPrecision
    notes: tuple[str, ...]
    time_step: float

    @property
    def num_steps(self) -> int:
        """Number of steps k."""
        return len(self.positions) - 2

    def bound_error(self, step: int) -> float:
        """Bound the error [m] of a coordinate of the three positions of a step."""
        return self.precision.bound_error(*self.positions[step - 1 : step + 2])

    def position_after(self, step: int) -> Positions:
        """Return the positions (n, 3) [m] after a step.

        Step 0 is the start, and -1 is one step before it.
        """
        return self.positions[step + 1]


class VertexMatch(NamedTuple):
    """Order of a submission's vertices and axes.

    Attributes:
        vertices: for each vertex of the scene, the number of that of the submission (n,).
        axes: for each axis of the scene, the index of that of the submission.
    """

    vertices: NDArray[np.int64]
    axes: tuple[int, ...]

    @property
    def is_usual(self) -> bool:
        """Whether nothing is permuted."""
        return self.axes == AXES[0] and bool((self.vertices == np.arange(len(self.vertices))).all())


def align_submission(
    scene: Scene, read: PositionSequence, first_frame: int | None = None, rest: Positions | None = None
) -> SubmittedMotion:
    """Give positions the frame numbers and the vertex order of a scene.

    Args:
        scene: scene that was simulated.
        read: positions as read.
        first_frame: number of the first positions, 0 for the start; None to compare them with the start.
        rest: rest positions (n, 3) [m] in the submission's order; None to compare the start, if it is there.

    Raises:
        InputError: the rest positions are not those of the scene, or frames or times are not those of its steps.
    """
    start, notes = build_initial_state(scene).motion.positions, list(read.notes)
    p, mistake = read.positions, lambda problem: InputError(InputMistake(problem, read.source))
    first_bad = next((k for k, one in enumerate(p) if not (np.abs(one) <= MAX_POSITION).all()), None)
    if first_bad is not None:
        notes.append(f"positions are not finite from stored frame {first_bad + 1} on; those before are graded")
        p = p[:first_bad]
    if not len(p):
        raise mistake("has no frame of finite positions")
    found = _match_vertices(
        start, p[0], 2.0 * estimate_precision(p[0]).bound_error(p[0]) + START_FRACTION * _measure_size(start)
    )
    stated = int(read.frames[0]) if read.frames is not None else None
    if read.frames is not None and (np.diff(read.frames) != 1).any():
        raise mistake("its frames are not consecutive; a step is graded by the two positions before it")
    if first_frame is None and stated is None:
        is_start = found is not None
        first_frame = 0 if is_start else 1
        reason = "is the scene's start" if is_start else "is not the scene's start"
        notes.append(f"frames: the first {reason}, so it is frame {first_frame} (--first-frame states it)")
    else:
        first_frame = first_frame if first_frame is not None else stated
        assert first_frame is not None
        notes.append(
            f"frames: the first is frame {first_frame}, as {'stated' if stated is None else 'the file states'}"
        )
    if first_frame not in (0, 1):
        raise mistake(f"begins with frame {first_frame}; expected 0, the start, or 1, after the first step")
    _check_times(scene, read, first_frame)
    match = _choose_match(scene, read, rest, found if first_frame == 0 else None, first_frame, notes)
    p = p[:, match.vertices]
    before, begin = compute_position_before_start(scene), [start] if first_frame else []
    precision = estimate_precision(p)
    notes.append(f"precision: coordinates are stored to about {precision.bound_error(p[0]):.0e} m")
    return SubmittedMotion(
        read.source, np.array([before, *begin, *p]), first_frame == 0, precision, tuple(notes), scene.system.time_step
    )


def estimate_precision(p: NDArray[np.float64]) -> StoredPrecision:
    """Estimate the rounding error of stored coordinates: of float32, of decimals, or of float64."""
    values = p.ravel()[:: max(1, p.size // _SAMPLES)]
    if not values.any():
        return StoredPrecision(float(np.finfo(float).tiny), 2.0**-53)
    with np.errstate(over="ignore"):
        single = bool((values.astype(np.float32) == values).all())
    relative = 2.0**-25 if single else 2.0**-53
    for decimals in range(2, 13):
        unit = 0.5 * 10.0**-decimals
        if unit < relative * float(np.abs(values).max()):
            break
        rounded = np.round(values, decimals)
        rounded = rounded.astype(np.float32).astype(float) if single else rounded
        if (np.abs(rounded - values) <= 4.0 * 2.0**-53 * np.abs(values)).all():
            return StoredPrecision(unit, relative)
    for digits in range(4, 13):
        if all(float(f"{x:.{digits - 1}e}") == x for x in values.tolist()):
            return StoredPrecision(float(np.finfo(float).tiny), 0.5 * 10.0 ** (1 - digits))
    return StoredPrecision(float(np.finfo(float).tiny), relative)


def _check_times(scene: Scene, read: PositionSequence, first_frame: int) -> None:
    """Raise InputError where the stated times are not those of the scene's steps."""
    if read.times is None:
        return
    expected = np.array([scene.compute_time(first_frame + k) for k in range(len(read.times))])
    dt = scene.system.time_step
    wrong = np.abs(read.times - expected) > TIME_TOLERANCE * dt * np.maximum(1, np.arange(len(expected)))
    if wrong.any():
        k = int(np.argmax(wrong))
        problem = f"states the time {read.times[k]:g} s for frame {first_frame + k}; the scene's is {expected[k]:g} s"
        raise InputError(
            InputMistake(f"{problem} (time_step {dt:g} s). Give the positions at the scene's steps", read.source)
        )


def _choose_match(
    scene: Scene,
    read: PositionSequence,
    rest: Positions | None,
    at_start: VertexMatch | None,
    first_frame: int,
    notes: list[str],
) -> VertexMatch:
    """Return the vertex order, and add a sentence about it."""
    n = len(scene.mesh.rest_positions)
    if rest is not None:
        expected = scene.mesh.rest_positions
        found = _match_vertices(expected, rest, MATCH_FRACTION * _measure_size(expected))
        if found is None:
            raise InputError(InputMistake(_describe_unmatched(scene.mesh.rest_positions, rest), read.source))
        notes.append(f"vertices: matched by the rest positions given; {_describe_match(found)}")
        return found
    if at_start is not None:
        how = "checked at frame 0" if at_start.is_usual else "matched by the positions of frame 0"
        notes.append(f"vertices: {how}; {_describe_match(at_start)}")
        return at_start
    if first_frame == 0:
        notes.append("vertices: taken in the scene's order, although frame 0 is not the scene's start")
    else:
        notes.append("vertices: taken in the scene's order; no rest positions are given to check it with (--rest FILE)")
    if n > 1 and (length := _measure_stretch(scene, read.positions[0])) > IMPLAUSIBLE_STRETCH:
        notes[-1] += (
            f". The springs of the first frame are {length:.2g} times as long as at rest, in the median, as in another "
            "order: give --rest FILE"
        )
    return VertexMatch(np.arange(n), AXES[0])


def _measure_stretch(scene: Scene, p: Positions) -> float:
    """Measure the median length of springs at p (n, 3) [m], over their rest lengths.

    It is 0 without springs.
    """
    springs = scene.all_springs
    i, j = springs.edges[springs.rest_length > 0.0].T
    rest = springs.rest_length[springs.rest_length > 0.0]
    return float(np.median(np.linalg.norm(p[i] - p[j], axis=1) / rest)) if len(rest) else 0.0


def _describe_match(match: VertexMatch) -> str:
    moved = int((match.vertices != np.arange(len(match.vertices))).sum())
    order = "in the scene's order" if not moved else f"{moved} of {len(match.vertices)} have other numbers in the scene"
    axes = "" if match.axes == AXES[0] else f"; its axes are {', '.join('xyz'[a] for a in match.axes)} of the scene's"
    return order + axes


def _match_vertices(expected: Positions, submitted: Positions, tolerance: float) -> VertexMatch | None:
    """Match vertices one to one by position, within a tolerance [m].

    The result is None where that is impossible. The scene's order and usual axes are preferred, then other orders, then
    other axes.
    """
    n = len(expected)
    if not np.isfinite(submitted).all():
        return None
    for axes in AXES:
        there = submitted[:, axes]
        if float(np.max(np.abs(expected - there))) <= tolerance:
            return VertexMatch(np.arange(n), axes)
        distance, vertices = cKDTree(there).query(expected)
        if float(np.max(distance)) <= tolerance and len(np.unique(vertices)) == n:
            return VertexMatch(np.asarray(vertices, np.int64), axes)
    return None


def _measure_size(p: Positions) -> float:
    """Return the diagonal [m] of the bounding box, or 1."""
    return float(np.linalg.norm(np.ptp(p, axis=0))) or 1.0


def _describe_unmatched(expected: Positions, submitted: Positions) -> str:
    distance, _ = cKDTree(submitted).query(expected)
    distance = np.asarray(distance, float)
    vertex = int(np.argmax(distance))
    return (
        "its rest positions are not the scene's, one to one: the nearest one to vertex "
        f"{vertex} of the scene is {distance[vertex]:.3g} m away; give those of the same mesh, in metres"
    )
