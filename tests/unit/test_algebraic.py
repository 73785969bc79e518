"""`tolerance: auto`: what solves leave undone stays below the steps' own error, and they do little more than that."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, integrate_motion
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.auto_tolerance import AutoTolerance, StopCriterion, build_stop_rule
from springbench.harness.simulation.time_loop import SimulationStep, prepare, simulate_scene
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.integrators import INTEGRATORS
from springbench.solvers.model.step_problem import StopRule, Unsupported

END = 0.3
EFFECTS = (SpringsEffect(stretch=20.0), GravityEffect(), PinsEffect(parts=("first",), weight="exact"))


def scene(integrator: str, steps: int) -> Scene:
    """A chain that is thrown."""
    given = {"mesh": ChainMesh(), "effects": EFFECTS, "velocity": (0.5, 1.0, 2.0), "time_step": END / steps}
    return build_scene(SceneSpec(mass=1.0, frames=1, path=Path("scene.yaml"), **given), 6, integrator)


def run(integrator: str, steps: int, stop: StopCriterion) -> list[SimulationStep]:
    made = scene(integrator, steps)
    return list(simulate_scene(made, prepare(made, Lbfgs()), stop, initial_guess="inertial", frames=steps))


@pytest.fixture(scope="module")
def reference_motion() -> ReferenceTrajectory:
    return integrate_motion(scene("esdirk-4", 4), [END])


@pytest.mark.parametrize("steps", [24, 96])
@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "midpoint", "newmark", "sdirk-3", "esdirk-4"])
def test_solves_add_little_to_the_error_of_the_step_with_few_iterations(integrator, steps, reference_motion):
    auto, converged = run(integrator, steps, AutoTolerance(200)), run(integrator, steps, StopRule(200, 1e-12))
    own = reference_motion.measure_error(0, converged[-1].positions)
    away = np.linalg.norm(auto[-1].positions - converged[-1].positions) / reference_motion.displacement[0]
    assert away <= 0.5 * own  # a tenth a step, whose signs may agree where those of the steps' own errors do not
    past = slice(6, None)
    most = 0.8 if INTEGRATORS[integrator].order < 4 else 1.0  # an error of 7e-9 requires all but the last digits
    assert sum(step.num_iterations for step in auto[past]) <= most * sum(
        step.num_iterations for step in converged[past]
    )
    assert all(solution.residual <= step.stop_rule.atol for step in auto[past] for _, solution in step.stages)


def test_the_bound_falls_with_the_integrators_order():
    for integrator, order in (("implicit-euler", 1), ("midpoint", 2), ("sdirk-3", 3)):
        bounds = [
            np.median([step.stop_rule.atol for step in run(integrator, steps, AutoTolerance(200))[6:]])
            for steps in (48, 96)
        ]
        # |e_v| falls by the order and one; that of order 3 is not yet asymptotic
        np.testing.assert_allclose(np.log2(bounds[0] / bounds[1]), order + 1, atol=0.6)


def test_a_scene_at_rest_is_solved_at_once():
    given = {"mesh": ChainMesh(), "effects": EFFECTS[::2], "time_step": 0.1}
    still = build_scene(SceneSpec(mass=1.0, frames=1, path=Path("scene.yaml"), **given), 6, "implicit-euler")
    steps = list(simulate_scene(still, prepare(still, Lbfgs()), AutoTolerance(50), initial_guess="previous", frames=6))
    assert max(step.num_iterations for step in steps) <= 1


def test_steps_of_two_lengths_are_refused():
    made = scene("implicit-euler", 24)
    uneven = replace(made, alternate_scene=scene("implicit-euler", 48))
    with pytest.raises(Unsupported, match="alternates two"):
        next(simulate_scene(uneven, prepare(made, Lbfgs()), AutoTolerance(50), initial_guess="previous", frames=2))


def test_a_stated_tolerance_is_the_rule_of_every_step():
    assert build_stop_rule(7, 1e-3) == StopRule(7, 1e-3)
    assert build_stop_rule(7, None) == StopRule(7)
    assert build_stop_rule(7, "auto") == AutoTolerance(7)
