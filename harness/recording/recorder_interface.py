"""Interface between a run and its recordings, and between recordings and pictures."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.solvers.model.step_problem import Positions

if TYPE_CHECKING:
    from springbench.harness.scenes.effects.effect_interface import SceneEffect
    from springbench.harness.scenes.surface_obstacles import AnySurface


LAYOUT_VERSION = 3
"""Version of the layout of entities and columns; recordings of another version are rejected."""


INTERSECTION_FREE_PROPERTY = "prevents_self_intersection"
"""Property of a recording that states whether an effect prevents self-intersection of the mesh."""

NUM_SAMPLES = 8
"""Number of sampled frames before the last: a recording with half of its frames wrong passes once in 256 runs."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedFrame:
    """One simulated step, as recorded; frame 0 is the initial state.

    Attributes:
        index: frame number.
        time: simulated time [s].
        positions: vertex positions (n, 3) [m].
        energies: energies [J] by name.
        residual: residual norm [J^(1/2)].
        num_iterations: number of solver iterations of the step.
        forces: forces (n, 3) [N] by name, drawn as arrows.
        num_intersections: number of edge-triangle intersections of the mesh with itself and with obstacles; None where
            they were not counted.
    """

    index: int
    time: float
    positions: Positions
    energies: Mapping[str, float]
    residual: float
    num_iterations: int
    forces: Mapping[str, Positions] = field(default_factory=dict[str, Positions])
    num_intersections: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RecordingInfo:
    """Properties of a recording that are constant over its frames.

    Attributes:
        title: scene, size and solver in words.
        run_id: identifier of the run.
        mesh: mesh of the scene.
        springs: vertex pairs (m, 2) of the scene's springs, which may be fewer than those of the mesh.
        rest_lengths: rest lengths of the springs (m,) [m].
        pinned_vertices: indices of the pinned vertices (q,).
        time_step: step size [s].
        strain_range: strain at the ends of the colour scale (0.1 is 10 %).
        has_self_contact: whether an effect prevents self-intersection of the mesh; pictures of surfaces state it.
        properties: flat metadata of the run and its machine (scene, size, solver, iterations, cpu, ...).
        is_solve: whether the frames are the numbered iterates of one solve, instead of the steps of a run.
        obstacles: obstacles drawn with the mesh.
    """

    title: str
    run_id: str
    mesh: Mesh
    springs: NDArray[np.int64]
    rest_lengths: NDArray[np.float64]
    pinned_vertices: NDArray[np.int64]
    time_step: float
    strain_range: float
    has_self_contact: bool
    properties: Mapping[str, str | int | float | bool]
    is_solve: bool = False
    obstacles: Sequence[AnySurface] = ()


class RunRecorder(Protocol):
    """Writer of the frames of one run, in order, to one complete file or none."""

    def record_frame(self, frame: RecordedFrame) -> None:
        """Record one frame."""
        ...

    def record_convergence(self, frame: int, residuals: Sequence[float], objective: Sequence[float]) -> None:
        """Record the convergence within one frame.

        Args:
            frame: frame index.
            residuals: residual [J^(1/2)] of each iteration.
            objective: objective [J] of each iteration.
        """
        ...

    def finish_recording(self, milliseconds: Mapping[str, Sequence[float]]) -> Path:
        """Write the phase times, finish the file and return its final path.

        Args:
            milliseconds: wall time [ms] of each phase by frame, from the timed pass; index 0 is frame 1.
        """
        ...

    def abandon_recording(self) -> None:
        """Stop and leave no file under the final name."""
        ...


class FrameSamples:
    """Copies of the positions of random frames of a run and of its last frame."""

    def __init__(self, last: int) -> None:
        before = range(1, last)
        self.frames = {*random.sample(before, min(NUM_SAMPLES, len(before))), last}
        self.positions: dict[int, Positions] = {}

    def add_frame(self, frame: int, p: Positions) -> None:
        """Copy the positions after a step if its frame is sampled.

        Args:
            frame: number of the frame, from 1.
            p: positions (n, 3) [m], which the caller may overwrite.
        """
        if frame in self.frames:
            self.positions[frame] = p.copy()


@dataclass(frozen=True, slots=True, eq=False)
class RecordingReplay:
    """Contents of a recording that has been read back, from which pictures are drawn.

    Attributes:
        title: title as recorded.
        run_id: identifier of the run.
        frames: frame indices (k,).
        times: simulated times (k,) [s].
        positions: positions (k, n, 3) float32 [m], relative to `origin`.
        triangles: vertex indices (f, 3).
        springs: vertex pairs (m, 2).
        rest_lengths: rest lengths of the springs (m,) [m].
        pinned_vertices: indices of the pinned vertices (q,).
        strain_range: strain at the ends of the colour scale.
        scalars: (frames, values) by entity name.
        properties: metadata as recorded.
        origin: origin of the positions (3,) [m], zero unless the mesh is far from zero.
    """

    title: str
    run_id: str
    frames: NDArray[np.int64]
    times: NDArray[np.float64]
    positions: NDArray[np.float32]
    triangles: NDArray[np.int64]
    springs: NDArray[np.int64]
    rest_lengths: NDArray[np.float64]
    pinned_vertices: NDArray[np.int64]
    strain_range: float
    scalars: Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]]
    properties: Mapping[str, str | int | float | bool]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def absolute_positions(self, frame: int) -> Positions:
        """Return the positions (n, 3) [m] of a recorded frame in absolute coordinates.

        `frame` is the index among the recorded frames, counted from 0. The origin is added to the stored positions.
        """
        return self.positions[frame] + self.origin


OBSTACLES_PROPERTY = "obstacles"
"""Property of a recording that declares its obstacles in JSON, in the format of scene files."""


def list_obstacles(effects: Iterable[SceneEffect]) -> tuple[AnySurface, ...]:
    """Return the obstacles of a scene's effects, to be drawn with the mesh."""
    return tuple(one for effect in effects for one in getattr(effect, "obstacles", ()))


def build_obstacles_property(obstacles: Sequence[AnySurface]) -> dict[str, str]:
    """Return the property that declares these obstacles; empty where there are none."""
    return (
        {OBSTACLES_PROPERTY: f"[{', '.join(one.model_dump_json(exclude_none=True) for one in obstacles)}]"}
        if obstacles
        else {}
    )
