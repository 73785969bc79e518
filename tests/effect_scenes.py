"""Scenes with one effect each, in motion, for the tests of effects and of the solvers that take them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.attachments_effect import AttachmentsEffect
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.gas_effect import GasEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.rayleigh_effect import RayleighEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.strain_limits_effect import StrainLimitsEffect
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, build_problem
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model import integrators
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, StopRule

from tests.scene_builders import build_test_scene

KEYED_MOTION = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=1.0, offset=(0.1, 0.2, 0.0), angle=90.0)))

BENDING_EFFECT = BendingEffect(stiffness=0.5)
STRAIN_LIMIT_EFFECT = StrainLimitsEffect(max_stretch=1.02, min_stretch=0.98, stiffness=500.0)
DASHPOT_EFFECT = DashpotsEffect(stretch=2.0)
RAYLEIGH_EFFECT = RayleighEffect(mass_coefficient=0.5, stiffness_coefficient=0.02)
AIR_DRAG_EFFECT = AirDragEffect(coefficient=2.0)
ATTACHMENT_EFFECT = AttachmentsEffect(parts=("bottom",), stiffness=50.0, motion=KEYED_MOTION)
GAS_EFFECT = GasEffect(pressure=200.0)
FLOOR_CONTACT = ContactEffect.model_validate(
    {"obstacles": [{"kind": "plane", "point": (0, -0.02, 0)}], "friction": 0.3}
)
"""So little below the level cloth that in `stepped` some of its vertices arrive."""


def build_effect_cloth(*effects: SceneEffect) -> Scene:
    pins = PinsEffect(parts=("top_corners",), motion=KEYED_MOTION)
    return build_test_scene(
        GridMesh(), SpringsEffect(stretch=300.0, shear=60.0), GravityEffect(), pins, *effects, size=6
    )


def build_balloon(*effects: SceneEffect) -> Scene:
    return build_test_scene(
        BalloonMesh(), SpringsEffect(stretch=100.0), GravityEffect(), PinsEffect(parts=("pole_top",)), *effects, size=2
    )


EFFECT_SCENES: dict[str, Callable[[], Scene]] = {
    "bending": lambda: build_effect_cloth(BENDING_EFFECT),
    "strain limits": lambda: build_effect_cloth(STRAIN_LIMIT_EFFECT),
    "dashpots": lambda: build_effect_cloth(DASHPOT_EFFECT),
    "rayleigh": lambda: build_effect_cloth(RAYLEIGH_EFFECT, BENDING_EFFECT),
    "air drag": lambda: build_effect_cloth(AIR_DRAG_EFFECT),
    "attachments": lambda: build_effect_cloth(ATTACHMENT_EFFECT),
    "all that are projective": lambda: build_effect_cloth(
        BENDING_EFFECT, STRAIN_LIMIT_EFFECT, DASHPOT_EFFECT, RAYLEIGH_EFFECT, AIR_DRAG_EFFECT, ATTACHMENT_EFFECT
    ),
    "contact": lambda: build_effect_cloth(FLOOR_CONTACT),
    "gas": lambda: build_balloon(GAS_EFFECT),
    "gas and all others": lambda: build_balloon(
        GAS_EFFECT, BENDING_EFFECT, STRAIN_LIMIT_EFFECT, DASHPOT_EFFECT, RAYLEIGH_EFFECT, AIR_DRAG_EFFECT
    ),
}
"""Scenes by what is in them besides springs, gravity and moving pins."""


def build_moving_problem(scene: Scene, integrator: str = "implicit-euler") -> StepProblem:
    """A step of the scene from positions that are a little stretched and disturbed, and from velocities."""
    rng, rest = np.random.default_rng(0), scene.mesh.rest_positions
    now, before = (
        integrators.Motion(stretch * rest + 0.01 * rng.normal(size=rest.shape), 0.3 * rng.normal(size=rest.shape))
        for stretch in (1.05, 1.04)
    )
    return build_problem(with_integrator(scene, integrator), MotionState(now, before, 3), "previous")


def with_integrator(scene: Scene, name: str) -> Scene:
    """The same scene with an integrator by name."""
    method = integrators.INTEGRATORS[name]
    return replace(scene, integrator=method, system=replace(scene.system, inertia_factor=method.inertia_factor))


def compute_rest_shape(
    scene: Scene, solver: Solver | None = None, *, iterations: int = 200, rtol: float = 1e-9
) -> Positions:
    """Where a scene comes to rest, (n, 3) [m]: one step so long that inertia (M/dt^2) and damping weigh nothing."""
    long = replace(scene, system=replace(scene.system, time_step=1e3))
    stated = build_problem(
        long,
        MotionState(integrators.Motion(scene.mesh.rest_positions, np.zeros_like(scene.mesh.rest_positions)), None, 0),
        "previous",
    )
    solution = (solver or NewtonSolver()).prepare(long.system).solve(stated, StopRule(iterations, rtol))
    assert solution.termination_reason != "max-iter", "the static solve has not converged"
    return solution.positions
