"""Define the gate on idle contact: steps with distant obstacles compared with steps without contact."""

from __future__ import annotations

from pathlib import Path

from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import simulate_scene

from tests.bench.gates import STOP, Gate, Work, get_last_positions, prepare_solver

FAR = ContactEffect.model_validate(
    {
        "obstacles": [{"kind": "plane", "point": (0, -5, 0)}, {"kind": "sphere", "center": (0, -4, 0), "radius": 0.5}],
        "friction": 0.5,
    }
)


def build_fall(*effects: ContactEffect, size: int, frames: int) -> Work:
    """Build work that computes steps of a sheet by the compiled backend, and returns the last positions (n, 3) [m]."""
    all_effects = SpringsEffect(stretch=1000.0), GravityEffect(), PinsEffect(parts=("top_corners",)), *effects
    spec = SceneSpec(
        mesh=GridMesh(), mass=1.0, time_step=1 / 30, frames=1, effects=all_effects, path=Path("sheet.yaml")
    )
    scene = build_scene(spec, size)
    prepared = prepare_solver("numba", scene)
    return lambda: get_last_positions(
        step.solution for step in simulate_scene(scene, prepared, STOP, initial_guess="previous", frames=frames)
    )


CONTACT = (
    Gate(
        name="idle-contact-against-none-64",
        candidate=lambda: build_fall(FAR, size=64, frames=10),
        baseline=lambda: build_fall(size=64, frames=10),
        limit=1.05,
        goal=1.02,
        why="a target: distant obstacles require one test of a bounding box, at most 2 % of a step; measured 1.01 to "
        "1.02 on an idle core, and medians of 1.01 under load; the rest is a margin for variation between processes",
        guards=("test_idle_contact_allocates_no_array_more",),
        short=True,
    ),
)
