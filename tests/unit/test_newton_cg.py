"""Newton's method by conjugate gradients; and energies that are not springs, by all of Newton's methods."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from springbench.harness.scenes.effects.gas_effect import GasEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.solvers.iteration.descent_method import PreparedDescent
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.negative_curvature import is_positive_definite
from springbench.solvers.methods.newton.newton_cg import NewtonCG, TruncatedNewtonIteration
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem, build_test_scene
from tests.unit.test_objective import with_links

OTHERS = pytest.mark.parametrize("solver", [NewtonSolver(), NewtonCG(), HybridNewton()], ids=lambda s: type(s).__name__)


def test_it_never_analyses_the_factor_of_a_hessian():
    given = build_first_problem(build_cloth(8, "exact"))
    prepared = NewtonCG().prepare(given.system)
    assert isinstance(prepared, PreparedDescent)
    prepared.solve(given, StopRule(5))
    for phase in prepared.iteration_phases(given).values():
        phase()
    assert "matrix" not in vars(prepared.fixed_objective)
    assert "nnz_hessian_factor" not in prepared.stats


def test_it_converges_faster_than_linearly_near_a_minimum():
    given = build_first_problem(build_cloth(8, "exact"))
    prepared = NewtonCG().prepare(given.system)
    assert isinstance(prepared, PreparedDescent)
    step = StepObjective(prepared.fixed_objective, given)
    residuals = [prepared.metric.residual(step.gradient(p.copy())) for p in islice(prepared.iterates(given), 60)]
    start = prepared.metric.residual(step.gradient(given.current_positions))
    near = [r / start for r in residuals if 1e-11 * start < r < 1e-3 * start]
    assert residuals[-1] <= 1e-12 * start
    # The forcing term squares the residual once it is below a tenth; five halvings of 1e-3 would be a linear method's.
    assert 1 <= len(near) <= 6


@pytest.mark.parametrize("weight", ["exact", 1e10], ids="pins {}".format)
@pytest.mark.parametrize("size", [4, 12])
def test_the_compiled_loop_makes_the_iterates_of_the_one_that_takes_any_energy(size, weight):
    given = build_first_problem(build_cloth(size, weight))
    compiled, plain = (NewtonCG().prepare(given.system) for _ in range(2))
    assert isinstance(plain, PreparedDescent)
    assert isinstance(plain.method, TruncatedNewtonIteration)
    plain.method.compiled_cg = None
    for p, q in islice(zip(compiled.iterates(given), plain.iterates(given), strict=False), 6):
        # Sums in another order, which pins of 1e10 and springs of 1e2 magnify.
        np.testing.assert_allclose(p, q, rtol=0, atol=1e-9)


def test_negative_curvature_at_the_very_first_is_a_local_global_step():
    """All springs compressed to a tenth: there is no direction in which the Hessian is positive."""
    given = build_random_problem(1, weights=(), m=60)
    given = replace(
        given,
        initial_guess=0.1 * given.current_positions,
        inertial_target=0.1 * given.current_positions,
        external_force=0.0 * given.external_force,
    )
    prepared = NewtonCG().prepare(given.system)
    assert isinstance(prepared, PreparedDescent)
    first = next(prepared.iterates(given)).copy()
    assert given.value(first) < given.value(given.initial_guess)


@OTHERS
@pytest.mark.parametrize("reach", [0.2, 0.4], ids="links within {:g} m".format)
def test_other_energies_are_minimised_whatever_their_pattern(solver, reach):
    given = with_links(build_first_problem(build_cloth(7, "exact")), reach)
    solution = solver.prepare(given.system).solve(given, StopRule(200))
    assert solution.termination_reason in {"stalled", "roundoff"}
    step = StepObjective(FixedObjective(given.system), given)
    assert (
        np.abs(given.gradient(solution.positions)).max() <= 1e-9 * np.abs(given.gradient(given.current_positions)).max()
    )
    assert is_positive_definite(step, step.apply_exact_pins(solution.positions))


@OTHERS
def test_gas_in_a_balloon_is_minimised(solver):
    """Not projective, infinite inside out, and its Hessian is full."""
    made = build_test_scene(
        BalloonMesh(),
        SpringsEffect(stretch=50.0),
        GravityEffect(),
        GasEffect(pressure=5.0),
        PinsEffect(parts=("pole_top",), weight="exact"),
        size=4,
    )
    given = build_first_problem(made)
    solution = solver.prepare(given.system).solve(given, StopRule(200))
    step = StepObjective(FixedObjective(given.system), given)
    assert (
        np.abs(given.gradient(solution.positions)).max() <= 1e-9 * np.abs(given.gradient(given.current_positions)).max()
    )
    assert is_positive_definite(step, step.apply_exact_pins(solution.positions))
