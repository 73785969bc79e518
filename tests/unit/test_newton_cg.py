"""Newton's method by conjugate gradients; and energies that are not springs, by all of Newton's methods."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from harness.scenes.effects.gas import Gas
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs
from harness.scenes.mesh.surfaces import Balloon
from solvers.core.descent import PreparedDescent
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.saddles import certified
from solvers.methods.hybrid import Hybrid
from solvers.methods.newton import Newton
from solvers.methods.newton_cg import NewtonCG, TruncatedNewton
from solvers.problem import StopRule
from tests.scenes import cloth, first_problem, random_problem, scene
from tests.unit.test_objective import with_links

OTHERS = pytest.mark.parametrize("solver", [Newton(), NewtonCG(), Hybrid()], ids=lambda s: type(s).__name__)


def test_it_never_looks_for_the_structure_of_a_hessians_factor():
    given = first_problem(cloth(8, "exact"))
    prepared = NewtonCG().prepare(given.system)
    assert isinstance(prepared, PreparedDescent)
    prepared.solve(given, StopRule(5))
    for phase in prepared.phases(given).values():
        phase()
    assert "matrix" not in vars(prepared.objective)
    assert "nnz_hessian_factor" not in prepared.facts


def test_it_converges_faster_than_linearly_near_a_minimum():
    given = first_problem(cloth(8, "exact"))
    prepared = NewtonCG().prepare(given.system)
    assert isinstance(prepared, PreparedDescent)
    step = StepObjective(prepared.objective, given)
    residuals = [prepared.metric.residual(step.gradient(p.copy())) for p in islice(prepared.iterates(given), 60)]
    start = prepared.metric.residual(step.gradient(given.current))
    near = [r / start for r in residuals if 1e-11 * start < r < 1e-3 * start]
    assert residuals[-1] <= 1e-12 * start
    # The forcing term squares the residual once it is below a tenth; five halvings of 1e-3 would be a linear method's.
    assert 1 <= len(near) <= 6


@pytest.mark.parametrize("weight", ["exact", 1e10], ids="pins {}".format)
@pytest.mark.parametrize("size", [4, 12])
def test_the_compiled_loop_makes_the_iterates_of_the_one_that_takes_any_energy(size, weight):
    given = first_problem(cloth(size, weight))
    compiled, plain = (NewtonCG().prepare(given.system) for _ in range(2))
    assert isinstance(plain, PreparedDescent)
    assert isinstance(plain.method, TruncatedNewton)
    plain.method.compiled = None
    for p, q in islice(zip(compiled.iterates(given), plain.iterates(given), strict=False), 6):
        # Sums in another order, which pins of 1e10 beside springs of 1e2 magnify.
        np.testing.assert_allclose(p, q, rtol=0, atol=1e-9)


def test_negative_curvature_at_the_very_first_is_a_local_global_step():
    """All springs compressed to a tenth: there is no direction in which the Hessian is positive."""
    given = random_problem(1, weights=(), m=60)
    given = replace(given, first_guess=0.1 * given.current, target=0.1 * given.current, force=0.0 * given.force)
    prepared = NewtonCG().prepare(given.system)
    assert isinstance(prepared, PreparedDescent)
    first = next(prepared.iterates(given)).copy()
    assert given.value(first) < given.value(given.first_guess)


@OTHERS
@pytest.mark.parametrize("reach", [0.2, 0.4], ids="links within {:g} m".format)
def test_other_energies_are_minimised_whatever_their_pattern(solver, reach):
    given = with_links(first_problem(cloth(7, "exact")), reach)
    solution = solver.prepare(given.system).solve(given, StopRule(200))
    assert solution.stopped in {"stalled", "floor"}
    step = StepObjective(Objective(given.system), given)
    assert np.abs(given.gradient(solution.positions)).max() <= 1e-9 * np.abs(given.gradient(given.current)).max()
    assert certified(step, step.placed(solution.positions))


@OTHERS
def test_gas_in_a_balloon_is_minimised(solver):
    """Not projective, infinite inside out, and its Hessian is full."""
    made = scene(
        Balloon(), Springs(stretch=50.0), Gravity(), Gas(pressure=5.0), Pins(at=("pole_top",), weight="exact"), size=4
    )
    given = first_problem(made)
    solution = solver.prepare(given.system).solve(given, StopRule(200))
    step = StepObjective(Objective(given.system), given)
    assert np.abs(given.gradient(solution.positions)).max() <= 1e-9 * np.abs(given.gradient(given.current)).max()
    assert certified(step, step.placed(solution.positions))
