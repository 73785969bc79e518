"""What Anderson, Chebyshev and L-BFGS share: the compiled step, the same without compilation, and the safeguard."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice, pairwise

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array
from springbench.solvers.iteration.iterative_solver import compute_max_coordinate
from springbench.solvers.kernels.iteration_loop import iteration_limit
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.quasi_newton.anderson import Anderson
from springbench.solvers.methods.quasi_newton.chebyshev import Chebyshev
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.methods.quasi_newton.windowed_acceleration import PreparedAccelerated
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, StopRule

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem

METHODS: tuple[type[Anderson | Chebyshev | Lbfgs], ...] = (Anderson, Chebyshev, Lbfgs)
methods = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.__name__)


def massless(seed: int) -> StepProblem:
    """A random network in which one vertex has no mass: springs alone determine it."""
    problem = build_random_problem(seed)
    mass = problem.system.mass.copy()
    mass[5] = 0.0
    return replace(problem, system=replace(problem.system, mass=mass))


PROBLEMS = {
    "cloth": lambda: build_first_problem(build_cloth(8)),
    "cloth, exact pins": lambda: build_first_problem(build_cloth(8, "exact")),
    "stiff cloth": lambda: build_first_problem(build_cloth(8, "exact", stretch=1e4)),
    "random": lambda: build_random_problem(0, weights=(1e4, np.inf, 1e2)),
    "random, not pinned": lambda: build_random_problem(1, weights=()),
    "random, massless": lambda: massless(0),
}
problems = pytest.mark.parametrize("name", PROBLEMS)


def iterates(solver: Solver, problem: StepProblem, count: int) -> list[Positions]:
    return [p.copy() for p in islice(solver.prepare(problem.system).iterates(problem), count)]


@methods
@problems
@pytest.mark.parametrize("start", ["guess", "one point", "far away"])
def test_the_objective_never_rises(method, name, start):
    problem = PROBLEMS[name]()
    far = 1e3 * np.random.default_rng(0).normal(size=problem.inertial_target.shape)
    guess = {"guess": problem.initial_guess, "one point": 0.0 * far, "far away": far}[start]
    path = iterates(method(), replace(problem, initial_guess=guess), 300)
    for before, after in pairwise(path):
        # Four units in the last place of the terms: what the reference itself loses in adding them.
        assert problem.value(after) <= problem.value(before) + 4 * np.finfo(float).eps * problem.value_scale(before)


@methods
@problems
@pytest.mark.parametrize(
    ("linear", "precision"), [("auto", "float64"), ("supernodal", "float16"), ("cholespy", "float64")]
)
def test_the_solution_is_a_stationary_point(method, name, linear, precision):
    problem = PROBLEMS[name]()
    solution = (
        method(linear_solver=linear, precision=precision).prepare(problem.system).solve(problem, StopRule(4000, 1e-9))
    )
    assert solution.termination_reason in ("converged", "roundoff")
    free = problem.system.unpinned_mask
    begun = np.abs(problem.gradient(problem.current_positions)[free]).max()
    # The residual fell to 1e-9; the gradient is Q times the correction, and may be larger by Q's condition.
    assert np.abs(problem.gradient(solution.positions)[free]).max() <= 1e-6 * begun


@methods
@problems
def test_a_step_compiled_as_a_whole_is_the_step_with_calls_in_between(method, name):
    problem = PROBLEMS[name]()
    compiled, called = (iterates(method(linear_solver=linear), problem, 12) for linear in ("supernodal", "cholespy"))
    for p, q in zip(compiled, called, strict=True):
        # Two factors by the condition of Q, and windows that make a dozen times as much of it in a dozen iterations.
        assert np.abs(p - q).max() <= 1e-7 * np.abs(q).max()


@methods
@problems
@pytest.mark.parametrize("linear", ["supernodal", "cholespy"])
def test_a_run_returns_its_gradient_and_the_decrease_of_the_objective(method, name, linear):
    problem = PROBLEMS[name]()
    prepared = method(linear_solver=linear).prepare(problem.system)
    run = prepared.init_state(problem, problem.initial_guess)
    run.run_iterations(iteration_limit(0))
    # Of a gradient some units in the last place of stiffness times position: at a pin of its weight times that.
    pins, exact = problem.system.pins, problem.system.pins.exact_mask
    stiffness = np.full(len(problem.inertial_target), prepared.local_global.unpinned_trace)
    stiffness[pins.vertices[~exact]] += pins.weight[~exact]
    start, size = problem.value(run.positions), problem.value_scale(run.positions)
    for _ in range(2):
        run.run_iterations(iteration_limit(6))
        # A dozen differences, each of which may be round-off of the terms, here or where the run started.
        size = max(size, problem.value_scale(run.positions))
        assert abs(start - problem.value(run.positions) - run.objective_decrease) <= 12 * 4 * np.finfo(float).eps * size
        expected = problem.gradient(run.positions)
        expected[pins.vertices[exact]] = 0.0
        assert (np.abs(run.gradient() - expected) <= 1e-15 * stiffness[:, None] * compute_max_coordinate(problem)).all()


@methods
def test_fewer_iterations_reach_an_accuracy_than_of_local_global(method):
    problem = build_first_problem(build_cloth(12, "exact"))
    lowest = problem.value(iterates(Lbfgs(), problem, 1500)[-1])
    begun = problem.value(problem.current_positions)

    def count_iterations(solver: Solver) -> int:
        for count, p in enumerate(solver.prepare(problem.system).iterates(problem), 1):
            if problem.value(p) - lowest <= 1e-4 * (begun - lowest):
                return count
        raise AssertionError("iterates end")

    assert 3 * count_iterations(method()) < count_iterations(CompiledLocalGlobal())  # measured: 6 to 10 times fewer


@methods
@pytest.mark.parametrize("linear", ["supernodal", "cholespy"])
def test_at_a_minimum_iterates_stay_where_they_are(method, linear):
    problem = build_random_problem(2)
    prepared = method(linear_solver=linear).prepare(problem.system)
    end = prepared.solve(problem, StopRule(4000, 1e-13)).positions
    again = replace(problem, initial_guess=end, current_positions=end)
    solution = prepared.solve(again, StopRule(50))
    assert np.abs(solution.positions - end).max() <= 1e-9  # what round-off in the gradient moves, by the condition of Q
    assert np.isfinite(solution.residual)


@methods
def test_a_scene_at_rest_stays_so(method):
    problem = build_random_problem(3, weights=())
    rest = problem.current_positions
    resting = replace(problem, inertial_target=rest, external_force=0.0 * rest, initial_guess=rest)
    solution = method().prepare(problem.system).solve(resting, StopRule(20, 1e-3))
    np.testing.assert_allclose(solution.positions, rest, atol=1e-12)  # of a network of size one


@methods
@pytest.mark.parametrize("linear", ["supernodal", "cholespy"])
def test_a_guess_that_is_no_number_ends_as_stalled(method, linear):
    problem = build_random_problem(0)
    guess = problem.initial_guess.copy()
    guess[4] = np.nan
    solution = (
        method(linear_solver=linear)
        .prepare(problem.system)
        .solve(replace(problem, initial_guess=guess), StopRule(20, 1e-3))
    )
    assert solution.termination_reason == "stalled"
    assert solution.num_iterations == 0


@methods
def test_no_iteration_is_the_first_guess(method):
    problem = build_random_problem(2)
    solution = method().prepare(problem.system).solve(problem, StopRule(0))
    free = problem.system.free_vertices
    np.testing.assert_array_equal(solution.positions[free], problem.initial_guess[free])
    assert solution.num_iterations == 0


@methods
def test_all_vertices_may_be_pinned_exactly(method):
    problem = build_random_problem(3, n=4, m=8, weights=(np.inf,) * 4)
    found = method().prepare(problem.system).solve(problem, StopRule(3)).positions
    np.testing.assert_array_equal(found, problem.pin_targets)


@methods
def test_memory_that_is_used_again_changes_nothing(method):
    problem = build_first_problem(build_cloth(8))
    prepared = method().prepare(problem.system)
    assert isinstance(prepared, PreparedAccelerated)
    first = prepared.solve(problem, StopRule(40, 1e-9))
    prepared.solve(
        replace(problem, initial_guess=10.0 * problem.initial_guess, external_force=-problem.external_force),
        StopRule(33),
    )
    again = prepared.solve(problem, StopRule(40, 1e-9))
    np.testing.assert_array_equal(first.positions, again.positions)
    assert (first.num_iterations, first.residual) == (again.num_iterations, again.residual)


@dataclass(frozen=True)
class Barrier:
    """An energy that is not projective: -stiffness sum of log(y + 2), infinite below y = -2 [m]."""

    stiffness: float

    def value(self, p: Positions) -> float:
        height = p[:, 1] + 2.0
        return np.inf if height.min() <= 0.0 else -self.stiffness * float(np.log(height).sum())

    def add_gradient(self, p: Positions, out: Positions) -> None:
        out[:, 1] -= self.stiffness / (p[:, 1] + 2.0)

    def hessian(self, p: Positions) -> csr_array:
        diagonal = np.zeros_like(p)
        diagonal[:, 1] = self.stiffness / (p[:, 1] + 2.0) ** 2
        return csr_array(diags_array(diagonal.ravel()))


def test_lbfgs_minimises_energies_that_are_not_projective_and_never_steps_over_a_barrier():
    problem = build_first_problem(build_cloth(6, "exact"))
    system = replace(problem.system, energies=(*problem.system.energies, Barrier(10.0)))
    pushed = replace(problem, system=system, external_force=300.0 * problem.external_force)
    path = iterates(Lbfgs(), pushed, 200)
    values = [pushed.value(p) for p in path]
    assert np.isfinite(values).all()
    assert all(
        b <= a + 4 * np.finfo(float).eps * pushed.value_scale(p)
        for a, b, p in zip(values, values[1:], path, strict=False)
    )
    assert path[-1][:, 1].min() < -1.5  # the barrier supports the cloth, which without it would fall to -2.8
    begun = np.abs(pushed.gradient(pushed.current_positions)).max()
    assert np.abs(pushed.gradient(path[-1])).max() <= 1e-6 * begun
