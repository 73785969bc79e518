"""The interface between a run and its recordings, and between recordings and pictures."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from harness.scenes.mesh.base import Mesh
from solvers.problem import Positions

if TYPE_CHECKING:
    from harness.scenes.shapes import AnySurface


LAYOUT = 2
"""Of entities and columns: recordings of another one are not read."""


SELF_CONTACT = "self_contact"
"""The property of a recording that states whether an effect keeps the mesh from passing through itself."""

SAMPLES = 8
"""Frames before the last that are read back: a recording wrong in half of its frames passes once in 256 runs."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One simulated step, as recorded: frame 0 is the start, before any step.

    index; time [s]; positions (n, 3) [m]; energies [J] by name; residual [J^(1/2)]; iterations; forces (n, 3) [N] by
    name, to be seen as arrows; intersections: of the mesh with itself, None where nobody looked.
    """

    index: int
    time: float
    positions: Positions
    energies: Mapping[str, float]
    residual: float
    iterations: int
    forces: Mapping[str, Positions] = field(default_factory=dict[str, Positions])
    intersections: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RecordingInfo:
    """What does not change in a recording.

    title: scene, size and solver in words; run_id; mesh; springs (m, 2) and their rest_lengths (m,) [m]: those of
    the scene, which may be fewer than the mesh's; pinned: vertices (q,); time_step [s];
    strain_range: the strain at the ends of the colour scale (0.1 is 10 %);
    properties: everything else about the run and its machine, flat (scene, size, solver, iterations, cpu, ...);
    iterates: whether the frames are iterates of one solve, by their numbers, instead of steps of a run;
    obstacles: what is seen beside the mesh.
    """

    title: str
    run_id: str
    mesh: Mesh
    springs: NDArray[np.int64]
    rest_lengths: NDArray[np.float64]
    pinned: NDArray[np.int64]
    time_step: float
    strain_range: float
    properties: Mapping[str, str | int | float | bool]
    iterates: bool = False
    obstacles: Sequence[AnySurface] = ()


class Recorder(Protocol):
    """Takes the frames of one run, in order, and ends with a complete file or none."""

    def frame(self, frame: Frame) -> None:
        """Record one frame."""
        ...

    def convergence(self, frame: int, residuals: Sequence[float], objective: Sequence[float]) -> None:
        """Record the residual [J^(1/2)] and the objective [J] of each iteration within one frame."""
        ...

    def close(self, milliseconds: Mapping[str, Sequence[float]]) -> Path:
        """Write the milliseconds of each phase by frame (from the timed pass; index 0 is frame 1), finish
        the file under its final name and return that."""
        ...

    def abandon(self) -> None:
        """Stop without leaving a file under the final name."""
        ...


class FrameSamples:
    """Copies of the positions of some random frames of a run, and of its last one."""

    def __init__(self, last: int) -> None:
        before = range(1, last)
        self.frames = {*random.sample(before, min(SAMPLES, len(before))), last}
        self.positions: dict[int, Positions] = {}

    def add(self, frame: int, p: Positions) -> None:
        """Copy the positions (n, 3) [m] after a step, if its frame is one of those."""
        if frame in self.frames:
            self.positions[frame] = p.copy()


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """A recording read back: what pictures are drawn from.

    frames: indices (k,); times (k,) [s]; positions (k, n, 3) float32 [m], relative to `origin`; triangles (f, 3);
    springs (m, 2); rest_lengths (m,) [m]; pinned (q,); strain_range; scalars: entity name -> (frames, values);
    properties and title as recorded; origin (3,) [m], zero unless the mesh is far from zero.
    """

    title: str
    run_id: str
    frames: NDArray[np.int64]
    times: NDArray[np.float64]
    positions: NDArray[np.float32]
    triangles: NDArray[np.int64]
    springs: NDArray[np.int64]
    rest_lengths: NDArray[np.float64]
    pinned: NDArray[np.int64]
    strain_range: float
    scalars: Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]]
    properties: Mapping[str, str | int | float | bool]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def absolute_positions(self, frame: int) -> Positions:
        """Return the positions (n, 3) [m] of a recorded frame, counted from 0, with the origin added."""
        return self.positions[frame] + self.origin
