"""The trace of a solve: residuals and objectives by the reference evaluator, over the solver's own iterates."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest
from springbench.harness.simulation.instrumentation_pass import EnergyNorm, trace_convergence
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem, make_read_only


def test_the_norm_is_the_square_root_of_the_quadratic_form_without_pins():
    problem = build_random_problem(0)
    rng = np.random.default_rng(1)
    e = rng.normal(size=problem.inertial_target.shape)
    original = e.copy()
    Q = assemble_system_matrix(problem.system, [require_only_springs(problem.system, "the test")]).toarray()
    inner = np.where(problem.system.unpinned_mask[:, None], e, 0.0)
    assert EnergyNorm(problem.system)(e) == pytest.approx(np.sqrt(np.trace(inner.T @ Q @ inner)), rel=1e-13)
    np.testing.assert_array_equal(e, original)


def test_a_trace_has_the_objective_and_the_step_of_each_iterate():
    problem = make_read_only(build_first_problem(build_cloth(8)))
    prepared, norm = SparseLocalGlobal().prepare(problem.system), EnergyNorm(problem.system)
    curve = trace_convergence(prepared, problem, norm, 12)
    iterates = [problem.initial_guess, *(p.copy() for p in islice(prepared.iterates(problem), 12))]
    assert curve.objective == [problem.value(p) for p in iterates[1:]]
    assert curve.residuals == [norm(b - a) for a, b in pairwise(iterates)]


def test_a_solver_may_yield_the_same_array_every_time():
    problem = build_random_problem(0)
    prepared, norm = SparseLocalGlobal().prepare(problem.system), EnergyNorm(problem.system)

    class Reusing:
        description, stats = prepared.description, prepared.stats
        solve, iteration_phases = prepared.solve, prepared.iteration_phases
        residual_at = prepared.residual_at

        def iterates(self, problem):
            out = np.empty_like(problem.inertial_target)
            for p in prepared.iterates(problem):
                out[:] = p
                yield out

    assert (
        trace_convergence(Reusing(), problem, norm, 5).residuals
        == trace_convergence(prepared, problem, norm, 5).residuals
    )


def test_a_cloth_that_falls_converges():
    problem = build_first_problem(build_cloth(8))
    curve = trace_convergence(CompiledLocalGlobal().prepare(problem.system), problem, EnergyNorm(problem.system), 60)
    assert curve.residuals[-1] < 0.1 * curve.residuals[0]
    assert curve.objective[-1] < curve.objective[0]


def test_a_first_guess_off_the_pins_does_not_show_in_the_residual():
    problem = build_first_problem(build_cloth(8))
    guess = problem.initial_guess.copy()
    guess[problem.system.pins.vertices] += 5.0
    prepared, norm = CompiledLocalGlobal().prepare(problem.system), EnergyNorm(problem.system)
    far = trace_convergence(prepared, replace(problem, initial_guess=guess), norm, 1).residuals[0]
    # With the pins in it the residual would be sqrt(1e10) * 5: half a million.
    assert far < 1e3


def test_what_is_not_a_number_stays_so():
    problem = build_random_problem(0)
    assert np.isnan(EnergyNorm(problem.system)(np.full_like(problem.inertial_target, np.nan)))
