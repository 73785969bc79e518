"""Every solver that takes an effect finds the same minimum with it; the others refuse it by name."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.negative_curvature import is_positive_definite
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, StopRule, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective
from springbench.solvers.registry import SOLVERS, load_target

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem, with_integrator

MINIMISERS: dict[str, Solver] = {
    name: solver
    for name, solver in ((name, load_target(target)()) for name, target in SOLVERS.items())
    if solver.is_minimiser
}
INTEGRATORS = ("implicit-euler", "bdf2", "midpoint")
TAKE_ALL = {"newton", "newton-cg", "hybrid", "lbfgs"}
PROJECTIVE = {"sparse", "numba", "anderson", "chebyshev"}
ALONG_EDGES = {"admm": {"bending", "strain limits", "air drag", "attachments"}}
CONTACT = {*PROJECTIVE, *TAKE_ALL, "vbd", "avbd"}
"""Who takes what; those not named take springs only."""
STOP = StopRule(5000, 1e-11)
NOISE = np.random.default_rng(0)


def takes(solver: str, scene: str) -> bool:
    if "contact" in scene:
        return solver in CONTACT
    if solver in ALONG_EDGES:
        return scene in ALONG_EDGES[solver]
    return solver in {*TAKE_ALL, "pncg"} or (
        solver in {*PROJECTIVE, "vbd", "avbd", "a-jacobi", "jgs2"} and "gas" not in scene
    )


@cache
def minimum(scene: str, integrator: str) -> tuple[StepProblem, Positions]:
    """The problem of a scene's step and its minimum, by Newton's method."""
    problem = build_moving_problem(EFFECT_SCENES[scene](), integrator)
    return problem, MINIMISERS["newton"].prepare(problem.system).solve(problem, StopRule(100, 1e-12)).positions


@pytest.mark.parametrize("scene", EFFECT_SCENES)
@pytest.mark.parametrize("solver", MINIMISERS)
def test_solvers_agree_at_convergence_or_refuse_by_name(solver, scene):
    for integrator in INTEGRATORS if "all" in scene and "gas" not in scene else INTEGRATORS[:1]:
        problem, expected = minimum(scene, integrator)
        if not takes(solver, scene):
            with pytest.raises(Unsupported) as refusal:
                MINIMISERS[solver].prepare(problem.system)
            known = {type(energy).__name__ for energy in problem.energies} - {"Springs"}
            assert any(name in str(refusal.value) for name in known)
        else:
            prepared = MINIMISERS[solver].prepare(problem.system)
            # By other directions than Newton's it may come to another valley, and from far it does.
            near = {"vbd": 1e-3, "avbd": 1e-3, "newton-cg": 1e-4 if scene == "contact" else 0.0}.get(solver, 0.0)
            if solver == "newton-cg" and near:
                far = prepared.solve(problem, STOP).positions
                assert_minimum(problem, far)
                assert problem.value(far) < problem.value(expected)
            if near:
                problem = replace(problem, initial_guess=expected + near * NOISE.normal(size=expected.shape))
            found = prepared.solve(problem, STOP).positions
            # Local-global converges linearly: its last step, 1e-11 of the first, is up to 1e-3 of what is left to go.
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("scene", EFFECT_SCENES)
def test_the_minimum_is_one(scene):
    assert_minimum(*minimum(scene, "implicit-euler"))


def assert_minimum(problem: StepProblem, p: Positions) -> None:
    """No force is left, and no curvature is negative."""
    forces = np.abs(problem.gradient(problem.current_positions)).max()
    assert np.abs(problem.gradient(p)).max() <= 1e-6 * forces  # the pins of 1e10 N/m and positions of 1e-16: 1e-6 N
    assert is_positive_definite(StepObjective(FixedObjective(problem.system), problem), p)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("scene", [name for name in EFFECT_SCENES if "gas" not in name])
def test_local_global_descends_with_every_projective_energy(scene, integrator):
    problem = build_moving_problem(EFFECT_SCENES[scene](), integrator)
    values, iterates = (
        [problem.value(problem.initial_guess)],
        SparseLocalGlobal().prepare(problem.system).iterates(problem),
    )
    for _ in range(40):
        p = next(iterates)
        assert problem.value(p) <= values[-1] + 1e-13 * problem.value_scale(p)  # sums of some hundred terms
        values.append(problem.value(p))
    assert values[-1] < values[0]


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("scene", EFFECT_SCENES)
def test_a_scene_runs_for_a_while_and_stays_finite(scene, integrator):
    made = with_integrator(EFFECT_SCENES[scene](), integrator)
    solver = MINIMISERS["lbfgs"]
    for step in simulate_scene(made, prepare(made, solver), StopRule(10), initial_guess="previous", frames=15):
        assert np.isfinite(step.positions).all()
        assert np.abs(step.positions).max() < 5.0  # sheets and balloons of a metre, and falls of half a second
