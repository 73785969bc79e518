"""How contact converges as its thickness shrinks and as its barrier stiffens: `python -m tests.contact_refinement`.

A sheet of 1 m that is pinned at its corners sinks onto a ball; range and thickness are the same. Printed is how far
vertices are from where half the thickness, or sixteen times the stiffness, has them, as the root of the mean of
squares: the first is of order 1 (halved), the second of order 1/2 (a quarter), since a barrier rises by the third power
of what is gone of its range.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.primitive_obstacles import SphereObstacle
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, StopRule

from tests.scene_builders import build_test_scene

THICKNESSES = tuple(0.04 / 2**k for k in range(6))
STIFFNESSES = tuple(1e2 * 16**k for k in range(6))
SHEET_SIZE, FRAME_COUNT = 7, 20
BALL_OBSTACLE = SphereObstacle(center=(0.0, -0.36, 0.0), radius=0.3)


def simulate_fall(thickness: float, stiffness: float) -> Positions:
    """Where the sheet is after 0.7 s, (n, 3) [m]."""
    own = SelfContactEffect(min_distance=thickness, barrier_stiffness=stiffness)
    ball = SurfaceContactEffect(min_distance=thickness, barrier_stiffness=stiffness, obstacles=(BALL_OBSTACLE,))
    effects = (
        SpringsEffect(stretch=100.0, shear=20.0),
        GravityEffect(),
        EtherDragEffect(decay_rate=5.0),
        PinsEffect(parts=("corners",)),
        own,
        ball,
    )
    made = build_test_scene(GridMesh(), *effects, size=SHEET_SIZE)
    rule = StopRule(200, 1e-7)
    *_, last = simulate_scene(made, prepare(made, NewtonSolver()), rule, initial_guess="previous", frames=FRAME_COUNT)
    return last.positions


def successive_distances(positions: list[Positions]) -> list[float]:
    """How far each is from the next [m]."""
    return [float(np.sqrt(np.mean(np.sum((b - a) ** 2, axis=1)))) for a, b in pairwise(positions)]


def main() -> None:
    """Print both tables."""
    for name, values, found in (
        ("thickness [m]", THICKNESSES, [simulate_fall(t, 100.0) for t in THICKNESSES]),
        ("stiffness [N/m]", STIFFNESSES, [simulate_fall(0.02, k) for k in STIFFNESSES]),
    ):
        far = successive_distances(found)
        print(f"{name:>16}  to the next [mm]  shrinks by")
        for k, (value, one) in enumerate(zip(values, far, strict=False)):
            print(f"{value:16.4g}  {1e3 * one:16.3f}  {far[k - 1] / one if k else np.nan:10.2f}")


if __name__ == "__main__":
    main()
