"""Properties of every solver: the contract of `springbench.solvers.model.step_problem`, for each name in the
registry."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from springbench.harness.simulation.instrumentation_pass import EnergyNorm, trace_convergence
from springbench.solvers.linalg.direct_solvers import SparseLU
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.reference_local_global import (
    DenseLocalGlobal,
    PreparedLocalGlobal,
    SparseLocalGlobal,
)
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix, energy_norm
from springbench.solvers.registry import SOLVERS, load_target

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem, make_read_only

SOLVER_VARIANTS = {
    "numba, inverse in float32": CompiledLocalGlobal("inverse", "float32"),
    "numba, cholespy": CompiledLocalGlobal("cholespy"),
    "numba, supernodal": CompiledLocalGlobal("supernodal"),
    "numba, supernodal in float32": CompiledLocalGlobal("supernodal", "float32"),
    "numba, supernodal in float16": CompiledLocalGlobal("supernodal", "float16"),
    "newton, clamp": NewtonSolver("clamp"),
    "newton, absolute": NewtonSolver("absolute"),
    "newton, trust-region": NewtonSolver("trust-region"),
    "newton, progressive": NewtonSolver("progressive"),
}
CHOICES = {name: load_target(target)() for name, target in SOLVERS.items()} | SOLVER_VARIANTS
LOCAL_GLOBAL = {
    name: solver
    for name, solver in CHOICES.items()
    if isinstance(solver, DenseLocalGlobal | SparseLocalGlobal | CompiledLocalGlobal)
}
FLOAT64 = {name: s for name, s in LOCAL_GLOBAL.items() if getattr(s, "precision", "float64") == "float64"}
MINIMISERS = {name: solver for name, solver in CHOICES.items() if solver.is_minimiser}


def over(choices):
    return pytest.mark.parametrize("solver", choices.values(), ids=list(choices))


solvers = over(CHOICES)

PROBLEMS = {
    "cloth": lambda: build_first_problem(build_cloth(10)),
    "cloth, exact pins, inertial guess": lambda: build_first_problem(build_cloth(10, "exact"), "inertial"),
    "random": lambda: build_random_problem(0),
    "random, not pinned": lambda: build_random_problem(1, weights=()),
}
problems = pytest.mark.parametrize(
    "problem", [make_read_only(make()) for make in PROBLEMS.values()], ids=list(PROBLEMS)
)


def iterates(prepared, problem: StepProblem, count: int) -> list[Positions]:
    return [p.copy() for p in islice(prepared.iterates(problem), count)]


@solvers
@problems
@pytest.mark.parametrize("count", [1, 2, 7])
def test_a_solve_ends_at_exactly_the_iterate_of_its_number(solver, problem, count):
    prepared = solver.prepare(problem.system)
    solution = prepared.solve(problem, StopRule(count))
    done = (
        1 if solver.solver_info.family in ("explicit", "linearly implicit") else count
    )  # a method that does not iterate has one iterate, again and again
    assert solution.num_iterations == done or solution.termination_reason == "stalled"
    np.testing.assert_array_equal(solution.positions, iterates(prepared, problem, count)[-1])


@solvers
@problems
def test_a_solve_that_a_tolerance_ends_does_so_at_exactly_an_iterate(solver, problem):
    prepared = solver.prepare(problem.system)
    solution = prepared.solve(problem, StopRule(200, 1e-2))
    assert 0 < solution.num_iterations <= 200
    np.testing.assert_array_equal(solution.positions, iterates(prepared, problem, solution.num_iterations)[-1])


@solvers
@problems
def test_solves_that_interleave_do_not_disturb_each_other(solver, problem):
    prepared = solver.prepare(problem.system)
    other = replace(problem, initial_guess=problem.initial_guess + 1.0, external_force=2.0 * problem.external_force)
    alone = iterates(prepared, problem, 6), iterates(prepared, other, 6)
    together = zip(prepared.iterates(problem), prepared.iterates(other), strict=False)
    for (p, q), a, b in zip(islice(together, 6), *alone, strict=True):
        np.testing.assert_array_equal(p, a)
        np.testing.assert_array_equal(q, b)
        prepared.solve(other, StopRule(3, 1e-3))


@solvers
@problems
def test_two_preparations_of_a_system_give_the_same_bits(solver, problem):
    one, two = (iterates(solver.prepare(problem.system), problem, 5)[-1] for _ in range(2))
    np.testing.assert_array_equal(one, two)


@solvers
@problems
def test_a_solution_belongs_to_its_caller(solver, problem):
    prepared = solver.prepare(problem.system)
    positions = prepared.solve(problem, StopRule(3)).positions
    original = positions.copy()
    prepared.solve(replace(problem, initial_guess=problem.initial_guess + 1.0), StopRule(4))
    np.testing.assert_array_equal(positions, original)
    assert positions.flags.c_contiguous
    assert positions.dtype == np.float64
    given = (
        problem.inertial_target,
        problem.external_force,
        problem.pin_targets,
        problem.current_positions,
        problem.initial_guess,
    )
    assert not any(np.shares_memory(positions, array) for array in given)


@solvers
@problems
def test_phases_may_run_at_any_time_and_leave_the_solver_as_it_was(solver, problem):
    prepared = solver.prepare(problem.system)
    before = iterates(prepared, problem, 3)
    phases = prepared.iteration_phases(problem)
    for phase in (*phases.values(), *reversed(phases.values())):
        phase()
    for p, expected in zip(iterates(prepared, problem, 3), before, strict=True):
        np.testing.assert_array_equal(p, expected)


@over(LOCAL_GLOBAL)
def test_local_global_has_a_local_and_a_global_phase(solver):
    problem = build_random_problem(0)
    assert set(solver.prepare(problem.system).iteration_phases(problem)) == {"local", "global"}


@solvers
@problems
def test_each_phase_does_what_it_returns(solver, problem):
    """What it returned is erased, and is there again when it is done once more."""
    for call in solver.prepare(problem.system).iteration_phases(problem).values():
        first = call()
        assert first is not None
        if isinstance(first, np.ndarray):
            original = first.copy()
            first.fill(np.nan)
            again = np.asarray(call())
            written = ~np.isnan(again)
            assert written.sum() >= 3 * len(problem.system.free_vertices)
            np.testing.assert_array_equal(again[written], original[written])


@over(FLOAT64)
@problems
def test_a_global_phase_solves_for_its_right_hand_side(solver, problem):
    """Q times what the global phase gives is the right-hand side that each backend states."""
    prepared = solver.prepare(problem.system)
    system, free = problem.system, problem.system.free_vertices
    phases = prepared.iteration_phases(problem)
    phases["local"]()
    given = np.asarray(phases["global"]())
    if isinstance(prepared, PreparedLocalGlobal):
        expected = next(prepared.iterates(problem))
    else:  # where blocks take turns at both, the global step is timed with the constant part of the right-hand side
        y = system.inertia_diagonal[:, None] * problem.inertial_target + problem.external_force
        expected, solved = np.zeros_like(y), np.empty((len(free), 3))
        Q = assemble_system_matrix(system, [energy for energy in system.energies if isinstance(energy, Springs)])
        SparseLU(Q[free][:, free]).solve(y[free], solved)
        expected[free] = solved
    # Two factors of one matrix: round-off times its condition, 1e10 at penalty pins.
    np.testing.assert_allclose(given[free], expected[free], rtol=1e-5, atol=1e-7)


@solvers
@problems
def test_exactly_pinned_vertices_are_on_their_targets_in_every_iterate(solver, problem):
    pins = problem.system.pins
    for p in iterates(solver.prepare(problem.system), problem, 4):
        np.testing.assert_array_equal(p[pins.vertices[pins.exact_mask]], problem.pin_targets[pins.exact_mask])


def stationarity(problem: StepProblem, p: Positions) -> float:
    """|Q^-1 grad g(p)|_Q [J^(1/2)] over the unpinned vertices, by SciPy."""
    system, free = problem.system, problem.system.free_vertices
    Q = assemble_system_matrix(system, [energy for energy in system.energies if isinstance(energy, Springs)])
    e, solved = np.zeros_like(p), np.empty((len(free), 3))
    SparseLU(Q[free][:, free]).solve(problem.gradient(p)[free], solved)
    e[free] = solved
    e[system.pins.vertices] = 0.0
    return energy_norm(Q, e)


@over(MINIMISERS)
@problems
@pytest.mark.parametrize("count", [1, 4])
def test_the_reported_residual_is_that_of_the_iterate_it_names(solver, problem, count):
    prepared = solver.prepare(problem.system)
    path = [problem.initial_guess.copy(), *iterates(prepared, problem, count)]
    pins = problem.system.pins
    path[0][pins.vertices[pins.exact_mask]] = problem.pin_targets[pins.exact_mask]
    solution = prepared.solve(problem, StopRule(count))
    scale = stationarity(problem, problem.current_positions)
    # Two ways to add the same terms and two factors, which may be rounded: half of the digits of what the solve began
    # with, or of a correction's.
    relative = 1e-2 if "float16" in str(solver) else 1e-6
    named = path[-1] if solution.residual_iterate == "returned" else path[-2]
    returned = prepared.residual_at(problem, solution.positions)
    for found, at in (solution.residual, named), (returned, path[-1]):
        assert found == pytest.approx(stationarity(problem, at), rel=relative, abs=1e-8 * scale)
    np.testing.assert_array_equal(solution.positions, path[-1])


@over({name: solver for name, solver in CHOICES.items() if not solver.is_minimiser})
def test_a_method_that_does_not_minimise_names_no_residual(solver):
    problem = build_random_problem(0)
    prepared = solver.prepare(problem.system)
    solution = prepared.solve(problem, StopRule(3, 1e-3))
    assert (solution.residual_iterate, solution.termination_reason) == ("none", "max-iter")
    assert np.isnan(
        [solution.residual, solution.initial_residual, prepared.residual_at(problem, solution.positions)]
    ).all()


@over(LOCAL_GLOBAL)
@problems
def test_the_reported_residual_is_the_length_of_the_last_step_in_the_norm_of_the_matrix(solver, problem):
    prepared = solver.prepare(problem.system)
    solution = prepared.solve(problem, StopRule(9, 1e-14))
    curve = trace_convergence(prepared, problem, EnergyNorm(problem.system), 9)
    # Two ways to add the same terms; what is left of the sum after cancellation is good to half the digits.
    assert solution.residual == pytest.approx(curve.residuals[-1], rel=1e-7)
    assert curve.objective[-1] == problem.value(solution.positions)


@solvers
def test_the_stats_are_whole_numbers_by_name(solver):
    facts = solver.prepare(build_random_problem(0).system).stats
    assert not solver.is_minimiser or facts["nnz_system"] > 0
    assert all(float(value).is_integer() for value in facts.values())
