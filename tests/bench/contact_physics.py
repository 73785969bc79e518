"""Compare contact with closed forms: Coulomb's law on a slope, creep, momentum, and refinement of the thickness.

python -m tests.bench.contact_physics [--publish results/published/contact-physics]

slide               distance that a vertex of 1 kg slides down a slope of 1:2 from rest in a second:
                    n (n + 1)/2 dt^2 g (sin - mu cos) by n steps of implicit Euler, g (sin - mu cos) t^2/2 exactly
creep speed         speed of the vertex with a friction coefficient above the slope's tangent: tan/mu times `eps_v`
momentum            two sheets collide in free space, by implicit Euler: largest change of momentum in a step,
                    relative to the sum of |m v|
angular momentum    of the same sheets: largest sum of x_(n+1) x m (v_(n+1) - v_n) in a step, which is 0 without a
                    torque, relative to the sum of |x x m v|
refinement          distance of the positions for successive thicknesses of contact, which are halved, of a sheet
                    that sinks onto a ball (`tests.contact_refinement`)
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.network_mesh import NetworkMesh
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.harness.simulation.time_loop import MotionState, SimulationStep, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import StopRule

from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.contact_refinement import THICKNESSES, simulate_fall, successive_distances
from tests.scene_builders import build_test_scene

CONFIG = Path(__file__).parents[2] / "configs" / "scenes" / "block-slide.yaml"
GRAVITY, SLOPE, NUM_STEPS, THICKNESS = 9.81, 0.5, 60, 0.005
SIN, COS = SLOPE / np.hypot(1.0, SLOPE), 1.0 / np.hypot(1.0, SLOPE)
SLIDING_FRICTION, STICKING_FRICTION = 0.4, 0.6
"""Coefficients of friction below and above the slope's tangent."""
SHEET_VELOCITY = (0.1, -2.0, 0.0)
"""Velocity of the upper sheet of a collision [m/s]."""


def simulate_vertex(friction: float) -> list[SimulationStep]:
    """Simulate a vertex on the slope from rest for a second; the x axis points down the slope."""
    down = GravityEffect(acceleration=(GRAVITY * SIN, -GRAVITY * COS, 0.0))
    plane = {"kind": "plane", "point": (0.0, -THICKNESS, 0.0)}
    ground = ContactEffect.model_validate({"obstacles": [plane], "min_distance": THICKNESS, "friction": friction})
    vertex = NetworkMesh(positions=((0.0, 0.0, 0.0),))
    scene = build_test_scene(vertex, down, ground, size=0, time_step=1.0 / NUM_STEPS)
    prepared = prepare(scene, NewtonSolver())
    return list(simulate_scene(scene, prepared, StopRule(400, 1e-10), initial_guess="previous", frames=NUM_STEPS))


def measure_collision(friction: float) -> tuple[float, float]:
    """Return the largest relative changes of momentum and of angular momentum in a step of two colliding sheets."""
    contact = SelfContactEffect(min_distance=0.02, friction=friction)
    sheets = StackMesh(layer_spacing=0.05)
    scene = build_test_scene(sheets, SpringsEffect(stretch=100.0, shear=20.0), contact, size=5)
    p, v = scene.mesh.rest_positions, np.zeros_like(scene.mesh.rest_positions)
    v[len(p) // 2 :] = SHEET_VELOCITY
    mass, state = scene.system.mass[:, None], MotionState(Motion(p, v), None, 0)
    steps = simulate_scene(
        scene,
        prepare(scene, NewtonSolver()),
        StopRule(100, 1e-11),
        initial_guess="extrapolated",
        frames=6,
        initial_state=state,
    )
    changes = list[tuple[float, float]]()
    for step in steps:
        now = step.state.motion
        changed, momentum = mass * (now.velocity - v), mass * now.velocity
        angular_change = np.cross(now.positions, changed).sum(axis=0)
        angular_momentum = np.cross(now.positions, momentum)
        changes.append(
            (
                float(np.linalg.norm(changed.sum(axis=0)) / np.linalg.norm(momentum, axis=1).sum()),
                float(np.linalg.norm(angular_change) / np.linalg.norm(angular_momentum, axis=1).sum()),
            )
        )
        v = now.velocity.copy()
    linear, angular = np.max(changes, axis=0)
    return float(linear), float(angular)


def measure_physics() -> list[dict[str, Any]]:
    """Measure all quantities: a row for each with its value, and the values of closed forms where they exist."""
    exact = 0.5 * GRAVITY * (SIN - SLIDING_FRICTION * COS)
    slide, creep = simulate_vertex(SLIDING_FRICTION)[-1], simulate_vertex(STICKING_FRICTION)[-1]
    rows: list[dict[str, Any]] = [
        {
            "quantity": "slide",
            "value": float(slide.positions[0, 0]),
            "discrete_form": exact * (NUM_STEPS + 1) / NUM_STEPS,
            "closed_form": exact,
        },
        {"quantity": "creep speed", "value": float(creep.state.motion.velocity[0, 0])},
    ]
    distances = successive_distances([simulate_fall(thickness, 100.0) for thickness in THICKNESSES])
    for friction in (0.0, 0.5):
        linear, angular = measure_collision(friction)
        rows += [
            {"quantity": "momentum", "friction": friction, "value": linear},
            {"quantity": "angular momentum", "friction": friction, "value": angular},
        ]
    return rows + [
        {"quantity": "refinement", "thickness": thickness, "value": distance}
        for thickness, distance in zip(THICKNESSES, distances, strict=False)
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), measure_physics()
    table = Table("quantity", "thickness [m]", "friction", "value", "implicit Euler", "closed form", box=SIMPLE_HEAD)
    for row in rows:
        cells = (row.get(name) for name in ("thickness", "friction", "value", "discrete_form", "closed_form"))
        table.add_row(row["quantity"], *("" if cell is None else f"{cell:.5g}" for cell in cells))
    Console(width=120).print(table)
    publish_rows(options.publish, CONFIG, rows, begin, is_timed=False)


if __name__ == "__main__":
    main()
