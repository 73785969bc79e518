"""Scenes with contact for the tests: sheets and bodies against one obstacle of each kind."""

from __future__ import annotations

from typing import Any

import numpy as np
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import SimulationStep, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, Solver, StopRule

from tests.scene_builders import build_test_scene

CONTACT_THICKNESS, TIME_STEP = 0.01, 1 / 30
TILTING_MOTION = {"key_frames": [{"time": 0, "angle": 20}], "axis": (0, 0, 1)}
OBSTACLE_SPECS: dict[str, dict[str, Any]] = {
    "plane": {"kind": "plane", "point": (0, -0.25, 0), "normal": (0.2, 1, 0.1)},
    "sphere": {"kind": "sphere", "center": (0.05, -0.6, 0), "radius": 0.3},
    "capsule": {"kind": "capsule", "end_points": ((-0.7, -0.5, 0.1), (0.6, -0.4, 0)), "radius": 0.1},
    "plate": {"kind": "box", "low": (-0.8, -0.305, -0.8), "high": (0.8, -0.295, 0.8)},  # as thin as the cloth is thick
    "tilted box": {"kind": "box", "low": (-0.4, -0.7, -0.5), "high": (0.3, -0.35, 0.4), "motion": TILTING_MOTION},
}
"""Below a level sheet of a metre at y = 0."""

DESCENT_STOP = StopRule(40, 1e-9)


def build_contact(*obstacles: dict[str, Any], friction: float = 0.0, **more: Any) -> ContactEffect:
    given = {"obstacles": obstacles, "min_distance": CONTACT_THICKNESS, "friction": friction}
    return ContactEffect.model_validate(given | more)


def build_sheet(
    *effects: SceneEffect,
    size: int = 6,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    time_step: float = TIME_STEP,
) -> Scene:
    """A free level sheet that falls."""
    springs = SpringsEffect(stretch=300.0, shear=60.0)
    return build_test_scene(
        GridMesh(), springs, GravityEffect(), *effects, size=size, velocity=velocity, time_step=time_step
    )


def build_sliding_block(slope: float, friction: float, *, time_step: float = 1 / 60) -> Scene:
    """A block of 10 kg on a slope of this tangent, whose frame is the scene's: gravity leans instead."""
    angle = np.arctan(slope)
    down = (9.81 * float(np.sin(angle)), -9.81 * float(np.cos(angle)), 0.0)
    ground = build_contact({"kind": "plane", "point": (0, -CONTACT_THICKNESS, 0)}, friction=friction)
    effects = SpringsEffect(stretch=2e4), GravityEffect(acceleration=down), ground
    return build_test_scene(BlockMesh(), *effects, size=3, mass=10.0, time_step=time_step)


def collect_steps(
    scene: Scene, frames: int, *, solver: Solver | None = None, stop: StopRule = DESCENT_STOP
) -> list[SimulationStep]:
    return list(
        simulate_scene(scene, prepare(scene, solver or NewtonSolver()), stop, initial_guess="previous", frames=frames)
    )


def penetration_depth(scene: Scene, p: Positions, time: float) -> float:
    """How much nearer than the thickness the nearest vertex is [m], negative where there is room."""
    (energy,) = (e for e in scene.system.energies if type(e).__name__ == "HalfSpaceContact")
    obstacles = energy.obstacles  # pyright: ignore[reportAttributeAccessIssue]
    return max(CONTACT_THICKNESS - float(one.signed_distance(p, time).min()) for one in obstacles)
