"""Scenes and flat sheets of the validation, with simulation to a time or to rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.mesh.mesh import SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_topology import assemble_mesh, lump_areas, sort_unique_pairs
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.scenes.start_positions import RestStart
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.model.step_problem import Positions, Solver, StopRule

GRAVITY = 9.81
"""Acceleration of gravity [m/s^2] of the effect `gravity`."""
STEP_RULE = StopRule(5000, 1e-11)
"""Every step is solved until round-off or this reduction of the residual, so that solvers add no error of their own."""
REST_STEP, MAX_REST_FRAMES = 0.1, 400
"""Time step [s] until rest is reached, which implicit Euler damps strongly, and the maximum number of steps."""
REST_MOTION = 1e-10
"""Displacement in a step, relative to the mesh's size, below which a scene counts as at rest."""


@dataclass(frozen=True, eq=False)
class GivenMesh:
    """A mesh that is already built, as the mesh of a scene."""

    mesh: Mesh

    def build_mesh(self, size: int = 0) -> Mesh:
        """Return the mesh, whatever the size."""
        return self.mesh


def build_validation_scene(
    mesh: Mesh,
    effects: Sequence[Any],
    *,
    time_step: float,
    mass: float | None = None,
    start: RestStart | None = None,
) -> Scene:
    """Build a scene of a mesh and effects, integrated by implicit Euler.

    Args:
        mesh: the mesh.
        effects: its effects.
        time_step: time step [s].
        mass: total mass [kg]; None for that of the mesh.
        start: deviation from the rest shape.
    """
    spec = SceneSpec(
        mesh=GivenMesh(mesh),
        mass=mass,
        time_step=time_step,
        frames=1,
        effects=tuple(effects),
        start=start,
        path=Path("validation"),
    )
    return build_scene(spec, 0, log_warnings=False)


def simulate_to_time(scene: Scene, solver: Solver, num_steps: int) -> list[Positions]:
    """Return the positions (n, 3) [m] after each step.

    Args:
        scene: scene to simulate from its start.
        solver: solver, which solves each step by STEP_RULE.
        num_steps: number of steps.
    """
    steps = simulate_scene(scene, prepare(scene, solver), STEP_RULE, initial_guess="previous", frames=num_steps)
    return [step.positions.copy() for step in steps]


def simulate_to_rest(scene: Scene, solver: Solver) -> Positions:
    """Return the positions (n, 3) [m] at rest, or after the maximum number of steps.

    Args:
        scene: scene with a time step that damps its motion, such as REST_STEP.
        solver: solver, which solves each step by STEP_RULE.
    """
    limit = REST_MOTION * max(scene.mesh.bounding_box_diagonal, 1e-3)
    before = scene.mesh.rest_positions
    for step in simulate_scene(
        scene, prepare(scene, solver), STEP_RULE, initial_guess="previous", frames=MAX_REST_FRAMES
    ):
        moved, before = float(np.abs(step.positions - before).max()), step.positions.copy()
        if moved <= limit:
            break
    return before


def build_sheet(x: NDArray[np.float64], z: NDArray[np.float64], radius: float = np.inf) -> Mesh:
    """Build a flat sheet of square cells with both diagonals at y = 0.

    Args:
        x, z: coordinates [m] of its lines.
        radius: cells with a corner farther from the origin are left out.
    """
    points = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
    index = np.arange(len(points)).reshape(len(x), len(z))
    cells = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)
    odd = (np.add.outer(np.arange(len(x) - 1), np.arange(len(z) - 1)) % 2).astype(bool).ravel()
    inside = (np.hypot(*points[cells].transpose(2, 0, 1)) <= radius).all(axis=1)
    cells, odd = cells[inside], odd[inside]
    used = np.unique(cells)
    number = np.full(len(points), -1)
    number[used] = np.arange(len(used))
    a, b, c, d = number[cells].T
    split = np.where(odd[:, None, None], np.stack([[a, b, c], [a, c, d]], 1).T, np.stack([[a, b, d], [b, c, d]], 1).T)
    triangles = split.reshape(-1, 3)[:, ::-1].copy()
    rest = np.column_stack([points[used, 0], np.zeros(len(used)), points[used, 1]])
    sides = np.concatenate([np.stack(pair, 1) for pair in ((a, b), (b, c), (c, d), (d, a))])
    return assemble_mesh(
        rest_positions=rest,
        springs={
            STRETCH: sort_unique_pairs(sides),
            SHEAR: sort_unique_pairs(np.concatenate([np.stack([a, c], 1), np.stack([b, d], 1)])),
        },
        triangles=triangles,
        vertex_weights=lump_areas(rest, triangles),
        dimension=2,
        spacing=float(x[1] - x[0]),
    )
