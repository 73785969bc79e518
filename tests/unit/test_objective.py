"""The fast objective against the reference, `StepProblem`, and the springs' own Hessian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array
from springbench.harness.execution.machine_info import limit_threads
from springbench.solvers.linalg.cholesky import block_cholesky
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, StepProblem
from springbench.solvers.objective import hessian_pattern
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective
from springbench.solvers.registry import SOLVERS, load_target

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem

SUMS = 1e-12
"""Two orders of adding some hundred terms, relative to the largest."""


@dataclass(frozen=True)
class Links:
    """k/2 (reach - distance)^2 between all pairs of vertices that are nearer: its pattern changes with p."""

    reach: float
    stiffness: float = 50.0

    def _pairs(self, p: Positions):
        """The pairs i, j, their unit directions and how much nearer than the reach they are."""
        i, j = np.triu_indices(len(p), 1)
        v = p[i] - p[j]
        length = np.linalg.norm(v, axis=1)
        near = length < self.reach
        return i[near], j[near], v[near] / length[near, None], self.reach - length[near]

    def value(self, p: Positions) -> float:
        return 0.5 * self.stiffness * float((self._pairs(p)[3] ** 2).sum())

    def add_gradient(self, p: Positions, out: Positions) -> None:
        i, j, n, overlap = self._pairs(p)
        force = self.stiffness * overlap[:, None] * n
        np.add.at(out, i, -force)
        np.add.at(out, j, force)

    def hessian(self, p: Positions) -> csr_array:
        i, j, n, overlap = self._pairs(p)
        nn = n[:, :, None] * n[:, None, :]
        across = (overlap / (self.reach - overlap))[:, None, None]
        blocks = self.stiffness * (nn - across * (np.eye(3) - nn))
        H = np.zeros((len(p), len(p), 3, 3))
        for rows, columns, sign in ((i, i, 1.0), (j, j, 1.0), (i, j, -1.0), (j, i, -1.0)):
            np.add.at(H, (rows, columns), sign * blocks)
        return csr_array(H.transpose(0, 2, 1, 3).reshape(3 * len(p), -1))


def with_links(problem: StepProblem, reach: float) -> StepProblem:
    system = replace(problem.system, energies=(*problem.system.energies, Links(reach)))
    return replace(problem, system=system)


@pytest.mark.parametrize("solver", ["newton", "newton-cg", "hybrid", "lbfgs"])
def test_a_solver_states_which_energies_take_the_slow_path(solver):
    problem, made = build_random_problem(2), load_target(SOLVERS[solver])()
    assert "Python" not in made.prepare(problem.system).description
    choice = made.prepare(with_links(problem, 0.5).system).description
    assert "Python" in choice
    assert "Links" in choice


PROBLEMS = {
    "random": build_random_problem(0),
    "random, not pinned": build_random_problem(1, weights=()),
    "random, all exact": build_random_problem(2, weights=(np.inf,) * 12),
    "cloth": build_first_problem(build_cloth(7)),
    "cloth, exact pins": build_first_problem(build_cloth(7, "exact")),
    "links that springs have": with_links(build_first_problem(build_cloth(7, "exact")), 0.2),
    "links that springs lack": with_links(build_first_problem(build_cloth(7, "exact")), 0.4),
    "random with links": with_links(build_random_problem(3), 2.0),
}
problems = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=list(PROBLEMS))


def build_step(problem: StepProblem) -> tuple[StepObjective, Positions, Positions]:
    """The step, and two points of it."""
    step = StepObjective(FixedObjective(problem.system), problem)
    rng = np.random.default_rng(0)
    p, q = (
        step.apply_exact_pins(problem.initial_guess + 0.1 * rng.normal(size=problem.inertial_target.shape))
        for _ in range(2)
    )
    return step, p, q


def exact_hessian(problem: StepProblem, p: Positions) -> csr_array:
    """(3f, 3f), from the energies' own Hessians."""
    s = problem.system
    _, vertices, weight = s.penalty_pins
    diagonal = np.repeat(s.inertia_diagonal + np.bincount(vertices, weight, minlength=s.num_vertices), 3)
    H = csr_array(diags_array(diagonal))
    for energy in problem.energies:
        H = csr_array(H + energy.hessian(p))
    free = (3 * s.free_vertices[:, None] + np.arange(3)).ravel()
    return csr_array(H[free][:, free])


@problems
def test_the_gradient_is_that_of_the_reference_evaluator(problem):
    step, p, _ = build_step(problem)
    expected = problem.gradient(p)
    np.testing.assert_allclose(step.gradient(p), expected, rtol=0, atol=SUMS * np.abs(expected).max(initial=1e4))


@problems
def test_the_objective_change_is_the_difference_of_the_reference_values(problem):
    step, p, q = build_step(problem)
    expected = problem.value(q) - problem.value(p)
    assert step.objective_change(p, q)[0] == pytest.approx(expected, rel=1e-9, abs=SUMS * problem.value_scale(p))


def test_the_objective_change_is_accurate_where_the_difference_of_values_has_no_digits():
    """A step of 1e-9 along the gradient: the rise is the slope, to as many digits as it is short."""
    problem = build_first_problem(build_cloth(7, "exact", stretch=1e6))
    step, p, _ = build_step(problem)
    direction = step.gradient(p)
    q = p - 1e-9 / np.abs(direction).max() * direction
    slope = float((step.gradient(p) * (q - p)).sum())
    curvature = float(((q - p) * step.hessian(p).matvec(q - p)).sum())
    assert abs(0.5 * curvature) < 1e-3 * abs(slope)
    # The step itself is rounded to 1e-7 of its length, but the same way in both.
    assert step.objective_change(p, q)[0] == pytest.approx(slope + 0.5 * curvature, rel=1e-9)


@problems
def test_a_product_with_the_hessian_is_that_of_the_energies(problem):
    step, p, _ = build_step(problem)
    free = problem.system.free_vertices
    x = np.zeros_like(p)
    x[free] = np.random.default_rng(1).normal(size=(len(free), 3))
    H = exact_hessian(problem, p)
    found = step.hessian(p).matvec(x)
    expected = np.zeros_like(p)
    expected[free] = (H @ x[free].ravel()).reshape(-1, 3)
    np.testing.assert_allclose(found, expected, rtol=0, atol=SUMS * np.abs(expected).max(initial=1.0))


@problems
def test_a_solve_undoes_a_product(problem):
    step, p, _ = build_step(problem)
    free = problem.system.free_vertices
    hessian = step.hessian(p)
    shift = 1.1 * float(abs(exact_hessian(problem, p)).sum(axis=1).max()) if len(free) else 0.0
    assert hessian.factorise(shift=shift)
    x = np.zeros_like(p)
    x[free] = np.random.default_rng(1).normal(size=(len(free), 3))
    found = hessian.solve(hessian.matvec(x) + shift * x)
    np.testing.assert_allclose(found, x, rtol=0, atol=1e-9)  # a condition of less than 1e5


@problems
def test_the_hessian_has_a_factor_just_where_its_eigenvalues_are_positive(problem):
    step, p, _ = build_step(problem)
    dense = exact_hessian(problem, p).toarray()
    smallest = float(np.linalg.eigvalsh(dense)[0]) if len(dense) else 1.0
    hessian = step.hessian(p)
    assert hessian.factorise() == (smallest > 0.0)
    if smallest < 0.0:
        assert hessian.factorise(shift=-1.01 * smallest)
        assert not hessian.factorise(shift=-0.99 * smallest)


def test_without_negative_lateral_parts_springs_are_positive_semidefinite():
    problem = build_random_problem(4, weights=())
    step, p, _ = build_step(problem)
    hessian = step.hessian(0.01 * p)  # nearly all springs compressed
    assert not hessian.factorise()
    assert hessian.factorise(0.0)


@pytest.mark.parametrize("weight", ["exact", 1e4])
def test_the_hessian_does_not_depend_on_threads(weight, monkeypatch):
    monkeypatch.setattr(block_cholesky, "_MIN_THREADED_FLOPS", 0.0)
    monkeypatch.setattr(hessian_pattern, "_MIN_THREADED_BLOCKS", 0)
    problem = build_first_problem(build_cloth(9, weight))
    p, found = problem.initial_guess * [1.0, 1.1, 0.9], []
    for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):  # type: ignore[attr-defined]
        with limit_threads(threads):
            step = StepObjective(FixedObjective(problem.system), problem)
            found += [step.hessian(p).assemble_clamped().values for _ in range(2)]
    for values in found[1:]:
        np.testing.assert_array_equal(values, found[0])


def test_a_temporary_pattern_leaves_no_trace():
    near, far = (with_links(build_first_problem(build_cloth(7, "exact")), reach) for reach in (0.4, 0.9))
    whole = FixedObjective(near.system)
    fresh = FixedObjective(near.system)
    p = near.initial_guess
    b = np.random.default_rng(0).normal(size=p.shape)
    b[near.system.pins.vertices] = 0.0

    def solve_with_hessian(objective: FixedObjective, problem: StepProblem) -> Positions:
        hessian = StepObjective(objective, problem).hessian(p)
        assert hessian.factorise(shift=1e4)
        return hessian.solve(b)

    first = solve_with_hessian(whole, near)
    solve_with_hessian(whole, replace(near, system=replace(near.system, energies=far.system.energies)))
    np.testing.assert_array_equal(solve_with_hessian(whole, near), first)
    np.testing.assert_array_equal(solve_with_hessian(fresh, near), first)


def test_springs_of_no_length_have_the_curvature_of_the_energy():
    p = np.zeros((3, 3))
    springs = Springs.from_rest_shape(
        np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]), np.array([[0, 1], [1, 2]]), np.ones(2)
    )
    problem = build_random_problem(0, n=3, m=1, weights=())
    problem = replace(problem, system=replace(problem.system, energies=(springs,)))
    step = StepObjective(FixedObjective(problem.system), problem)
    H = exact_hessian(problem, p)
    x = np.random.default_rng(0).normal(size=(3, 3))
    np.testing.assert_allclose(step.hessian(p).matvec(x).ravel(), H @ x.ravel(), rtol=SUMS)


def test_pairs_of_free_vertices_are_listed_once_and_in_order():
    problem = build_first_problem(build_cloth(5, "exact"))
    objective, rng = FixedObjective(problem.system), np.random.default_rng(3)
    number = objective.free_index
    vertices = rng.integers(-1, problem.system.num_vertices, (400, 4))
    expected = {
        (int(min(i, j)), int(max(i, j)))
        for row in number[vertices]
        for i in row
        for j in row
        if i != j and min(i, j) >= 0
    }
    assert (number[:-1] < 0).any()  # some vertices are not free
    i, j = objective.free_vertex_pairs(vertices)
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == sorted(expected)


@problems
@pytest.mark.parametrize("is_view", [False, True])
def test_a_trial_of_a_line_search_is_the_objective_at_its_end(problem, is_view):
    step, p, q = build_step(problem)
    direction = q - p
    if is_view:  # every second row of larger arrays
        p, direction = (np.repeat(x, 2, axis=0)[::2] for x in (p, direction))
    end = step.apply_exact_pins(p + 0.5 * direction)
    for slope, is_sufficient in ((-1e300, False), (1e300, True)):
        trial = step.try_step(p, direction, 0.5, slope, 0.0)
        np.testing.assert_array_equal(trial.positions, end)
        assert (trial.change, trial.noise) == step.objective_change(p, end)
        if not is_sufficient:
            assert trial.gradient is None
        elif not step.other_energies:
            assert trial.gradient is not None
            np.testing.assert_array_equal(trial.gradient, step.gradient(end))


@pytest.mark.parametrize("mass", [1.0, 0.0])
def test_the_inertial_prediction_is_where_no_energy_acts(mass):
    problem = build_random_problem(2, weights=(np.inf, 3.0))
    problem = replace(problem, system=replace(problem.system, mass=mass * problem.system.mass))
    found, h = (
        StepObjective(FixedObjective(problem.system), problem).inertial_prediction(),
        problem.system.inertia_diagonal,
    )
    expected = problem.inertial_target + (problem.external_force / h[:, None] if mass else 0.0)
    expected[problem.system.pins.vertices] = problem.pin_targets
    np.testing.assert_array_equal(found, expected)
