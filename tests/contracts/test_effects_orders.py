"""Each effect states the order up to which it is exact; here that is measured, effect by integrator.

With smooth effects every integrator has its order. What begins and ends within steps has order 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import isinf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, integrate_motion
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import INTEGRATORS
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.plugins.plugin_discovery import load_target

END, ROUGH_END = 0.15, 0.3
"""Seconds; what begins within steps takes longer to act."""
MEASURED_INTEGRATORS = ("implicit-euler", "midpoint", "esdirk-4")
SPRINGS = {"kind": "springs", "stretch": 20.0}
FIRST_PIN = {"kind": "pins", "parts": ["first"], "weight": "exact"}
TOP_PINS = {"kind": "pins", "parts": ["top"], "weight": "exact"}
GRAVITY = {"kind": "gravity"}
MOVING_PIN = FIRST_PIN | {"motion": {"key_frames": [{"time": 0.0}, {"time": 1.0, "offset": [0.5, 1.0, 0.0]}]}}
DOWN = (0.5, 1.0, 2.0)


CHAIN = ChainMesh()


@dataclass(frozen=True)
class Case:
    """An effect next to others on a mesh of a size, thrown with a velocity [m/s]; steps that resolve its vibrations."""

    effects: tuple[dict[str, Any], ...]
    mesh: Any = CHAIN
    size: int = 4
    velocity: tuple[float, float, float] = DOWN
    steps: int = 8


SMOOTH: dict[str, Case] = {
    "springs": Case((SPRINGS, FIRST_PIN)),
    "gravity": Case((SPRINGS, GRAVITY, FIRST_PIN)),
    "pins": Case((SPRINGS, GRAVITY, MOVING_PIN)),
    "constant-force": Case((SPRINGS, {"kind": "constant-force", "force": [0.5, -1.0, 2.0]}, FIRST_PIN)),
    "attachments": Case((SPRINGS, {"kind": "attachments", "parts": ["first"], "stiffness": 30.0})),
    "air-drag": Case((SPRINGS, GRAVITY, {"kind": "air-drag", "coefficient": 2.0}, FIRST_PIN)),
    "ether-drag": Case(
        (SPRINGS, GRAVITY, {"kind": "ether-drag", "decay_rate": 3.0}, FIRST_PIN), velocity=(0.0, 0.0, 0.0)
    ),
    "dashpots": Case((SPRINGS, GRAVITY, {"kind": "dashpots", "stretch": 0.4}, FIRST_PIN)),
    "rayleigh": Case(
        (SPRINGS, GRAVITY, {"kind": "rayleigh", "mass_coefficient": 0.5, "stiffness_coefficient": 0.02}, FIRST_PIN)
    ),
    "bending": Case((SPRINGS, {"kind": "bending", "stiffness": 0.05}, TOP_PINS), GridMesh(), 4, steps=32),
    "wind": Case(
        (SPRINGS, {"kind": "wind", "field": "assignment", "strength": 0.5}, TOP_PINS), GridMesh(), 4, steps=32
    ),
    "gas": Case(({"kind": "springs", "stretch": 40.0}, {"kind": "gas", "pressure": 100.0}), BalloonMesh(), 3, steps=48),
}
STILL = (0.0, 0.0, 0.0)
PLANE = {"kind": "plane", "point": [0, -0.05, 0]}
SURFACE = {
    "obstacles": [{"kind": "plane", "point": [0, -0.1, 0]}],
    "min_distance": 0.01,
    "dhat": 0.2,
    "barrier_stiffness": 5.0,
}
SELF = {"kind": "self-contact", "min_distance": 0.05, "dhat": 0.2, "barrier_stiffness": 1.0}
SEWN_ROWS = {
    "kind": "sewing",
    "first_row": {"parts": ["first"]},
    "second_row": {"parts": ["last"]},
    "stiffness": 40.0,
    "end_time": 0.2,
}
SOFT = SPRINGS | {"stretch": 5.0}
ROUGH: dict[str, Case] = {
    "contact": Case((SPRINGS, GRAVITY, {"kind": "contact", "obstacles": [PLANE]}, FIRST_PIN), velocity=STILL),
    "strain-limits": Case(
        (SOFT, GRAVITY, {"kind": "strain-limits", "max_stretch": 1.05, "stiffness": 40.0}, FIRST_PIN)
    ),
    "sewing": Case((SOFT, GRAVITY, SEWN_ROWS, FIRST_PIN)),
    "surface-contact": Case((SPRINGS, GRAVITY, SURFACE | {"kind": "surface-contact"}, FIRST_PIN), velocity=STILL),
    "self-contact": Case((SPRINGS, GRAVITY, SELF, FIRST_PIN), velocity=(-4.0, 0.0, 0.6)),  # a chain thrown onto itself
}
"""Those of order 1; barriers so soft that steps of a hundredth resolve them."""


def scene(case: Case, integrator: str, time_step: float) -> Scene:
    listed = tuple(load_target(EFFECT_CLASSES[effect["kind"]]).model_validate(effect) for effect in case.effects)
    given: dict[str, Any] = {"mesh": case.mesh, "effects": listed, "velocity": case.velocity, "time_step": time_step}
    return build_scene(SceneSpec(mass=1.0, frames=1, path=Path("scene.yaml"), **given), case.size, integrator)


@cache
def integrate_reference(effect: str) -> ReferenceTrajectory:
    return integrate_motion(scene(SMOOTH[effect], "esdirk-4", 0.1), [END])


def end(case: Case, integrator: str, steps: int, seconds: float = END) -> np.ndarray:
    made = scene(case, integrator, seconds / steps)
    stop = StopRule(100, 1e-13)
    *_, last = simulate_scene(made, prepare(made, NewtonSolver()), stop, initial_guess="inertial", frames=steps)
    return last.positions


def test_every_effect_states_its_maximum_order() -> None:
    stated = {name: load_target(target).max_convergence_order for name, target in EFFECT_CLASSES.items()}
    assert {name for name, order in stated.items() if isinf(order)} == set(SMOOTH)
    assert {name for name, order in stated.items() if order == 1.0} == set(ROUGH)


@pytest.mark.parametrize(
    "integrator",
    [
        pytest.param(i, marks=[pytest.mark.long] * (i not in MEASURED_INTEGRATORS))
        for i in INTEGRATORS
        if i != "substepping"
    ],
)
@pytest.mark.parametrize("effect", [pytest.param(e, marks=[pytest.mark.long] * (e == "gas")) for e in SMOOTH])
def test_integrators_have_their_order_up_to_that_of_the_effect(effect, integrator):
    order, case = INTEGRATORS[integrator].order, SMOOTH[effect]
    errors = [
        integrate_reference(effect).measure_error(0, end(case, integrator, n)) for n in (case.steps, 2 * case.steps)
    ]
    stated = min(order, load_target(EFFECT_CLASSES[effect]).max_convergence_order)
    # The next term of the error is smaller by a time step times the fastest frequency; signs may make it larger.
    assert np.log2(errors[0] / errors[1]) > stated - 0.35


@pytest.mark.parametrize("effect", ROUGH)
def test_effects_that_begin_within_steps_have_order_1(effect):
    case = ROUGH[effect]
    others = tuple(one for one in case.effects if one["kind"] != effect)
    true = end(case, "implicit-euler", 768, ROUGH_END)
    without = end(replace(case, effects=others), "implicit-euler", 96, ROUGH_END)
    errors = [np.linalg.norm(end(case, "implicit-euler", n, ROUGH_END) - true) for n in (12, 96)]
    assert np.linalg.norm(without - true) > 2.0 * errors[1], "it acts"
    # Where in a step contact begins scatters single errors; over a factor of 8 that counts for little. Those of other
    # integrators scatter more.
    assert 0.6 < np.log2(errors[0] / errors[1]) / 3.0 < 1.7
    assert load_target(EFFECT_CLASSES[effect]).max_convergence_order == 1.0
