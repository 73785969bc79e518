"""Local-global iterations: descent, what an iteration is, what they conserve, and what a backend refuses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice, pairwise

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.solvers.methods.local_global import reference_local_global
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.methods.local_global.reference_local_global import DenseLocalGlobal, SparseLocalGlobal
from springbench.solvers.model.energies.spring_energy import ZERO_LENGTH, Springs
from springbench.solvers.model.step_problem import (
    DirichletPins,
    NotPositiveDefinite,
    Positions,
    StepProblem,
    StopRule,
    System,
    Unsupported,
)
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

from tests.scene_builders import (
    LOCAL_GLOBAL_BACKENDS,
    SCENE_BUILDERS,
    build_cloth,
    build_first_problem,
    build_random_network,
    build_random_problem,
    build_step_start,
)

VALUE = 1e-13
"""Round-off of the objective relative to its magnitude: sums of some hundred terms."""
SOLVE = 1e-9
"""A solve with Q whose condition number, with weights of 1e4 and stiffnesses of 1, is below 1e6."""

backends = pytest.mark.parametrize("backend", LOCAL_GLOBAL_BACKENDS, ids=lambda b: type(b).__name__)


def iterates(backend, problem: StepProblem, count: int) -> list[Positions]:
    return [p.copy() for p in islice(backend.prepare(problem.system).iterates(problem), count)]


def collapse_guess(problem: StepProblem) -> StepProblem:
    """All vertices in one point: no spring has a direction."""
    return replace(problem, initial_guess=np.zeros_like(problem.inertial_target))


def scatter_guess(problem: StepProblem) -> StepProblem:
    return replace(problem, initial_guess=np.random.default_rng(1).normal(size=problem.inertial_target.shape))


STARTS = {"hanging": lambda problem: problem, "collapsed": collapse_guess, "scattered": scatter_guess}
NETWORKS = {
    "cloth": lambda: build_first_problem(build_cloth(12)),
    "cloth, exact pins": lambda: build_first_problem(build_cloth(12, "exact")),
    "stiff cloth": lambda: build_first_problem(build_cloth(12, stretch=1e6)),
    "block": lambda: build_first_problem(SCENE_BUILDERS["block"](1e10)),
    "random": lambda: build_random_problem(0),
    "random, not pinned": lambda: build_random_problem(1, weights=()),
}


@backends
@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("network", NETWORKS)
def test_energy_never_rises(backend, network, start):
    problem = STARTS[start](NETWORKS[network]())
    iterated = iterates(backend, problem, 40)
    for before, after in pairwise(iterated):
        assert problem.value(after) <= problem.value(before) + VALUE * problem.value_scale(before)
    assert np.isfinite(iterated[-1]).all()


@backends
@pytest.mark.parametrize("scale", [1.0, 1e-3, 0.0])
@pytest.mark.parametrize("weights", [(), (1e4,), (np.inf,), (1e4, np.inf, 1e2, np.inf)], ids=str)
def test_an_iteration_is_a_preconditioned_gradient_step_of_length_one(backend, weights, scale):
    """Q^-1 grad g(p) = p - LG(p) over the free vertices, also where springs have no length."""
    problem = build_random_problem(2, weights=weights)
    s = problem.system
    guess = scale * problem.initial_guess
    exact = s.pins.exact_mask
    guess[s.pins.vertices[exact]] = problem.pin_targets[exact]
    problem = replace(problem, initial_guess=guess)
    (after,) = iterates(backend, problem, 1)
    Q = assemble_system_matrix(s, [require_only_springs(s, "the test")]).toarray()
    step = np.linalg.solve(Q[np.ix_(s.free_vertices, s.free_vertices)], problem.gradient(guess)[s.free_vertices])
    np.testing.assert_allclose((guess - after)[s.free_vertices], step, rtol=0, atol=SOLVE * np.abs(step).max())


@backends
def test_iterations_end_where_the_gradient_vanishes(backend):
    problem = build_random_problem(3)
    p = iterates(backend, problem, 3000)[-1]
    forces = np.abs(problem.system.mass[:, None] / problem.system.time_step**2 * (p - problem.inertial_target)).max()
    assert np.abs(problem.gradient(p)).max() <= 1e-9 * forces  # the first gradient is of the order of `forces`


@backends
def test_every_iterate_moves_the_centre_of_mass_by_the_external_forces(backend):
    """1'A' = 0, so that springs drop out of the sum of all rows of Q p = A'K d + y, converged or not."""
    problem = build_random_problem(4, weights=())
    mass, dt = problem.system.mass, problem.system.time_step
    expected = mass @ problem.inertial_target + dt**2 * problem.external_force.sum(axis=0)
    for p in iterates(backend, problem, 5):
        np.testing.assert_allclose(mass @ p, expected, rtol=0, atol=SOLVE * mass.sum())


@backends
@pytest.mark.parametrize("length", [0.0, 1e-170, 0.5 * ZERO_LENGTH, 2 * ZERO_LENGTH, 1e-100], ids="{:.0e}".format)
def test_springs_of_almost_no_length_have_the_same_direction_in_every_backend(backend, length):
    rest = np.array([[0.0, 0, 0], [0.0, 2, 0]])
    springs = Springs.from_rest_shape(rest, np.array([[1, 0]]), np.array([100.0]))
    system = System(np.ones(2), 0.1, (springs,))
    guess = np.array([[0.0, 0, 0], [0.0, 0, length]])
    zero, none = np.zeros((2, 3)), np.empty((0, 3))
    problem = StepProblem(system, zero, zero, none, zero, guess, build_step_start(system, zero, zero))
    (p,) = iterates(backend, problem, 1)
    # Q^-1 A'K r e, with e the eigenvector (1, -1) of A'A: k r / (m/dt^2 + 2k).
    expected = 100 * 2 / (100 + 200) * (np.array([0.0, 1, 0]) if length <= ZERO_LENGTH else np.array([0.0, 0, 1]))
    np.testing.assert_allclose(p, [-expected, expected], rtol=0, atol=1e-14)  # a solve with two unknowns


@backends
def test_loops_twins_and_springs_of_no_rest_length_are_harmless(backend):
    rest = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])
    edges = np.array([[0, 0], [0, 1], [1, 0], [1, 2]])
    springs = Springs.from_rest_shape(rest, edges, np.array([5.0, 1.0, 2.0, 4.0]))
    twinless = Springs.from_rest_shape(rest, edges[[1, 3]], np.array([3.0, 4.0]))
    shared = build_random_problem(5, n=3, m=1, weights=())
    found = [
        iterates(backend, replace(shared, system=replace(shared.system, energies=(energy,))), 10)[-1]
        for energy in (springs, twinless)
    ]
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-12)  # a few solves with three unknowns


@backends
def test_springs_in_two_energies_are_as_good_as_in_one(backend):
    problem = build_random_problem(6)
    one = require_only_springs(problem.system, "the test")
    parts = tuple(
        Springs(one.edges[k], one.stiffness[k], one.rest_length[k], one.rest_direction[k])
        for k in (slice(0, 11), slice(11, None))
    )
    split = replace(problem, system=replace(problem.system, energies=parts))
    difference = iterates(backend, split, 10)[-1] - iterates(backend, problem, 10)[-1]
    assert np.abs(difference).max() <= SOLVE


@backends
@pytest.mark.parametrize("count", [1, 3], ids="{} vertices".format)
def test_vertices_without_springs_follow_the_external_forces(backend, count):
    problem = build_random_problem(7, n=count, m=0, weights=())
    mass, dt = problem.system.mass[:, None], problem.system.time_step
    (p,) = iterates(backend, problem, 1)
    np.testing.assert_allclose(p, problem.inertial_target + dt**2 / mass * problem.external_force, rtol=1e-14)


@backends
def test_a_system_without_any_energy_falls(backend):
    problem = build_random_problem(8, weights=())
    bare = replace(problem, system=replace(problem.system, energies=()))
    mass, dt = bare.system.mass[:, None], bare.system.time_step
    np.testing.assert_allclose(
        iterates(backend, bare, 1)[0], bare.inertial_target + dt**2 / mass * bare.external_force, rtol=1e-14
    )


def test_the_stats_count_what_is_stored():
    problem = build_random_problem(9, n=10, m=0, weights=())
    edges = np.array([[i, i + 1] for i in range(9)])
    chain = Springs.from_rest_shape(np.zeros((10, 3)), edges, np.ones(9))
    system = replace(problem.system, energies=(chain,))
    backends = (
        *LOCAL_GLOBAL_BACKENDS[:2],
        *(CompiledLocalGlobal(linear) for linear in ("inverse", "supernodal", "cholespy")),
    )
    facts = [backend.prepare(system).stats for backend in backends]
    assert [fact["nnz_system"] for fact in facts] == [10 + 2 * 9] * 5
    # A tree's factor has no fill-in; a dense one has the whole triangle; cholespy does not report it.
    assert [fact.get("nnz_factor") for fact in facts] == [10 * 11 / 2, 10 + 9, 10 * 11 / 2, 10 + 9, None]


@dataclass(frozen=True)
class Well:
    """An energy that no backend supports: |p|^2/2, without a projection."""

    def value(self, p: Positions) -> float:
        return 0.5 * float(np.sum(p * p))

    def add_gradient(self, p: Positions, out: Positions) -> None:
        out += p

    def hessian(self, p: Positions) -> csr_array:
        return csr_array(np.eye(p.size))


@dataclass(frozen=True)
class ProjectiveWell(Well):
    """The same with its projection, d = 0."""

    def stiffness_matrix(self, n: int) -> csr_array:
        return csr_array(np.eye(n))

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Adds nothing, since d = 0."""


@backends
def test_an_energy_that_a_backend_does_not_support_is_refused_by_name(backend):
    system = replace(build_random_problem(0).system, energies=(Well(),))
    with pytest.raises(Unsupported, match="Well"):
        backend.prepare(system)


def test_backends_with_sparse_factors_take_any_projective_energy_and_the_dense_one_refuses_it():
    problem = build_random_problem(10)
    problem = replace(problem, system=replace(problem.system, energies=(*problem.system.energies, ProjectiveWell())))
    for backend in (SparseLocalGlobal(), CompiledLocalGlobal(), CompiledLocalGlobal("supernodal", "float32")):
        p = iterates(backend, problem, 3000)[-1]
        assert np.abs(problem.gradient(p)).max() <= 1e-9 * np.abs(problem.gradient(problem.initial_guess)).max()
    with pytest.raises(Unsupported, match="ProjectiveWell"):
        DenseLocalGlobal().prepare(problem.system)


INDEFINITE = {
    "a negative stiffness": lambda system: replace(system, energies=(_stiffness(system, -1e6),)),
    "a stiffness that is not a number": lambda system: replace(system, energies=(_stiffness(system, np.nan),)),
    "an infinite stiffness": lambda system: replace(system, energies=(_stiffness(system, np.inf),)),
    "a mass that is not a number": lambda system: replace(system, mass=np.full(system.num_vertices, np.nan)),
    "a negative pin weight": lambda system: replace(system, pins=DirichletPins(np.array([0]), np.array([-1e9]))),
    "no mass and no pin": lambda system: replace(system, mass=np.zeros(system.num_vertices), pins=DirichletPins()),
}


def _stiffness(system: System, k: float) -> Springs:
    springs = require_only_springs(system, "the test")
    return replace(springs, stiffness=np.full(len(springs.edges), k))


@backends
@pytest.mark.parametrize("fault", INDEFINITE)
# infinity less infinity, on the way to the factorisation that refuses the result
@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
def test_a_matrix_that_is_not_positive_definite_is_refused(backend, fault):
    with pytest.raises(NotPositiveDefinite):
        backend.prepare(INDEFINITE[fault](build_random_problem(0).system))


@backends
def test_stiffness_beyond_the_digits_of_inertia_leaves_numbers(backend):
    """1e15 times the inertia: float64 has no digits left to place the whole, but nothing becomes NaN."""
    rest, springs = build_random_network(np.random.default_rng(11), 10, 30)
    stiff = replace(springs, stiffness=np.full(30, 1e12))
    system = System(np.full(10, 1e-3), 1.0, (stiff,))
    zero, none = np.zeros((10, 3)), np.empty((0, 3))
    problem = StepProblem(system, rest, zero, none, rest, rest + 1.0, build_step_start(system, rest, rest))
    solution = backend.prepare(system).solve(problem, StopRule(5, 1e-6))
    assert np.isfinite(solution.positions).all()
    assert np.isfinite(solution.residual)


def test_the_product_with_a_large_dense_matrix_is_the_same(monkeypatch):
    problem = build_first_problem(build_cloth(12))
    usual = iterates(DenseLocalGlobal(), problem, 10)
    monkeypatch.setattr(reference_local_global, "_LARGE_MATRIX_ENTRIES", 0)
    for one, other in zip(usual, iterates(DenseLocalGlobal(), problem, 10), strict=True):
        np.testing.assert_allclose(other, one, rtol=0.0, atol=1e-12)  # metres, for an extent of one
