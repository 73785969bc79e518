"""Contact against closed forms: Coulomb's law on a slope, creep below its angle, and refinement of the thickness.

    python -m tests.bench.contact_physics [--publish results/published/contact-physics]

A vertex of 1 kg at rest on a slope of 1:2 slides for a second, or sticks. n steps of implicit Euler lead
n (n + 1)/2 dt^2 g (sin - mu cos) down the slope, the exact motion g (sin - mu cos) t^2/2. What sticks creeps at
tan/mu times `eps_v`. The thickness of contact is halved for a sheet that
sinks onto a ball (`tests.contact_refinement`).
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
from springbench.harness.scenes.mesh.network_mesh import NetworkMesh
from springbench.harness.simulation.time_loop import SimulationStep, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import StopRule

from tests.bench.scripted_study import describe_moment, publish_rows
from tests.contact_refinement import THICKNESSES, simulate_fall, successive_distances
from tests.scene_builders import build_test_scene

CONFIG = Path(__file__).parents[2] / "configs" / "scenes" / "block-slide.yaml"
GRAVITY, SLOPE, NUM_STEPS, THICKNESS = 9.81, 0.5, 60, 0.005
SIN, COS = SLOPE / np.hypot(1.0, SLOPE), 1.0 / np.hypot(1.0, SLOPE)
SLIPS, STICKS = 0.4, 0.6
"""Coefficients of friction on either side of the slope's tangent."""


def simulate_vertex(friction: float) -> list[SimulationStep]:
    """Simulate a vertex at rest on the slope for a second; the x axis points down the slope."""
    down = GravityEffect(acceleration=(GRAVITY * SIN, -GRAVITY * COS, 0.0))
    plane = {"kind": "plane", "point": (0.0, -THICKNESS, 0.0)}
    ground = ContactEffect.model_validate({"obstacles": [plane], "min_distance": THICKNESS, "friction": friction})
    vertex = NetworkMesh(positions=((0.0, 0.0, 0.0),))
    scene = build_test_scene(vertex, down, ground, size=0, time_step=1.0 / NUM_STEPS)
    prepared = prepare(scene, NewtonSolver())
    return list(simulate_scene(scene, prepared, StopRule(400, 1e-10), initial_guess="previous", frames=NUM_STEPS))


def measure_physics() -> list[dict[str, Any]]:
    """Return a row for each quantity: its value, and that of the closed form where there is one."""
    exact = 0.5 * GRAVITY * (SIN - SLIPS * COS)
    slide, creep = simulate_vertex(SLIPS)[-1], simulate_vertex(STICKS)[-1]
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
    return rows + [
        {"quantity": "refinement", "thickness": thickness, "value": distance}
        for thickness, distance in zip(THICKNESSES, distances, strict=False)
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_moment(), measure_physics()
    table = Table("quantity", "thickness [m]", "value", "implicit Euler", "closed form", box=SIMPLE_HEAD)
    for row in rows:
        cells = (row.get(name) for name in ("thickness", "value", "discrete_form", "closed_form"))
        table.add_row(row["quantity"], *("" if cell is None else f"{cell:.5g}" for cell in cells))
    Console(width=120).print(table)
    publish_rows(options.publish, CONFIG, "python -m tests.bench.contact_physics", rows, begin, is_timed=False)


if __name__ == "__main__":
    main()
