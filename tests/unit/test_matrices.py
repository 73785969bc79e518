"""The matrices: the assignment's formulas, dense against sparse, and exactly what a sparse one stores."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_array
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import DirichletPins, NotPositiveDefinite, System

EXACT = 0.0
"""Both sides do the same few additions of the same numbers."""
ROUND_OFF = 1e-15
"""A few additions, in another order, relative to the largest entry."""

SPRINGS = np.array([[0, 1], [2, 1]])
STIFFNESS, MASS, TIME_STEP = np.array([2.0, 3.0]), np.array([1.0, 2.0, 3.0]), 0.5
PINNED_VERTICES, WEIGHT = np.array([2]), np.array([10.0])

BY_HAND = {
    "A": [[1, -1, 0], [0, -1, 1]],
    "M": [[1, 0, 0], [0, 2, 0], [0, 0, 3]],
    "C": [[0, 0, 1]],
    # k A'A couples 0-1 with 2 and 1-2 with 3; M/dt^2 = 4 M; the pin adds 10 to vertex 2.
    "Q": [[2 + 4, -2, 0], [-2, 2 + 3 + 8, -3], [0, -3, 3 + 12 + 10]],
}


def dense_matrices(springs, stiffness, mass, time_step, pinned, weight):
    n = len(mass)
    A, M = (
        system_matrix_assembly.signed_incidence_matrix_dense(springs, n),
        system_matrix_assembly.mass_matrix_dense(mass),
    )
    C = system_matrix_assembly.selection_matrix_dense(pinned, n)
    return {
        "A": A,
        "M": M,
        "C": C,
        "Q": system_matrix_assembly.system_matrix_dense(A, stiffness, M, time_step, C, weight),
    }


def sparse_matrices(springs, stiffness, mass, time_step, pinned, weight):
    n = len(mass)
    A, M = (
        system_matrix_assembly.signed_incidence_matrix_sparse(springs, n),
        system_matrix_assembly.mass_matrix_sparse(mass),
    )
    C = system_matrix_assembly.selection_matrix_sparse(pinned, n)
    return {
        "A": A,
        "M": M,
        "C": C,
        "Q": system_matrix_assembly.system_matrix_sparse(A, stiffness, M, time_step, C, weight),
    }


@st.composite
def networks(draw):
    """Springs (unique, no loops), stiffness, mass (some zero), time step, pinned vertices, weights."""
    n = draw(st.integers(2, 9))
    pairs = st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)).filter(lambda e: e[0] != e[1])
    springs = draw(st.lists(pairs, max_size=20, unique_by=lambda e: (min(e), max(e))))
    pinned = draw(st.lists(st.integers(0, n - 1), max_size=n, unique=True).map(sorted))
    positive = st.floats(1e-3, 1e6)

    def some(size, values=positive):
        return np.array(draw(st.lists(values, min_size=size, max_size=size)), float)

    edges = np.array(springs, np.int64).reshape(-1, 2)
    mass = some(n, st.one_of(st.just(0.0), positive))
    return edges, some(len(edges)), mass, 1 / 30, np.array(pinned, np.int64), some(len(pinned))


@pytest.mark.parametrize("name", BY_HAND)
@pytest.mark.parametrize("make", [dense_matrices, sparse_matrices])
def test_matrices_are_those_computed_by_hand(make, name):
    made = make(SPRINGS, STIFFNESS, MASS, TIME_STEP, PINNED_VERTICES, WEIGHT)[name]
    np.testing.assert_array_equal(made.toarray() if isinstance(made, csr_array) else made, BY_HAND[name])


@given(networks())
def test_dense_and_sparse_are_equal(network):
    dense, sparse = dense_matrices(*network), sparse_matrices(*network)
    for name in "AMC":
        np.testing.assert_allclose(sparse[name].toarray(), dense[name], rtol=EXACT, atol=EXACT)
    scale = np.abs(dense["Q"]).max()
    np.testing.assert_allclose(sparse["Q"].toarray(), dense["Q"], rtol=0, atol=ROUND_OFF * scale)


@given(networks())
def test_a_sparse_matrix_stores_exactly_its_entries(network):
    springs, _, mass, _, pinned, _ = network
    made = sparse_matrices(*network)
    diagonal = (mass > 0) | np.isin(np.arange(len(mass)), np.concatenate([springs.ravel(), pinned]))
    assert made["A"].nnz == 2 * len(springs)
    assert made["M"].nnz == np.count_nonzero(mass)
    assert made["C"].nnz == len(pinned)
    assert made["Q"].nnz == diagonal.sum() + 2 * len(springs)


@given(networks())
def test_sparse_matrices_are_canonical_float64_of_the_right_shape(network):
    springs, _, mass, _, pinned, _ = network
    m, n, q = len(springs), len(mass), len(pinned)
    for name, shape in {"A": (m, n), "M": (n, n), "C": (q, n), "Q": (n, n)}.items():
        sparse, dense = sparse_matrices(*network)[name], dense_matrices(*network)[name]
        assert sparse.shape == dense.shape == shape
        assert sparse.dtype == dense.dtype == np.float64
        assert sparse.has_canonical_format


def test_no_explicit_zeros_are_stored_for_zero_mass_zero_stiffness_twins_and_loops():
    springs = np.array([[0, 1], [1, 0], [2, 2], [2, 3], [3, 4]])
    stiffness, mass = np.array([1.0, 2.0, 5.0, 0.0, 4.0]), np.array([1.0, 0.0, 2.0, 0.0, 0.0])
    network = springs, stiffness, mass, 0.1, np.array([4]), np.array([0.0])
    for name, matrix in sparse_matrices(*network).items():
        assert np.count_nonzero(matrix.data) == matrix.nnz, name
        np.testing.assert_allclose(matrix.toarray(), dense_matrices(*network)[name], rtol=ROUND_OFF)


def test_a_loop_has_an_empty_row_in_the_incidence():
    assert system_matrix_assembly.signed_incidence_matrix_sparse(np.array([[1, 1], [0, 1]]), 2).toarray().tolist() == [
        [0, 0],
        [1, -1],
    ]


def test_one_number_stands_for_the_stiffness_of_every_spring_and_the_weight_of_every_pin():
    one = sparse_matrices(SPRINGS, 7.0, MASS, TIME_STEP, PINNED_VERTICES, 9.0)["Q"]
    each = sparse_matrices(SPRINGS, np.full(2, 7.0), MASS, TIME_STEP, PINNED_VERTICES, np.full(1, 9.0))["Q"]
    dense = dense_matrices(SPRINGS, 7.0, MASS, TIME_STEP, PINNED_VERTICES, 9.0)["Q"]
    np.testing.assert_array_equal(one.toarray(), each.toarray())
    np.testing.assert_array_equal(one.toarray(), dense)


def test_rest_lengths_are_the_distances_of_the_ends():
    rest = np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 12]])
    np.testing.assert_array_equal(
        system_matrix_assembly.rest_lengths(rest, np.array([[0, 1], [2, 1], [1, 1]])), [5, 12, 0]
    )


@given(networks())
def test_the_matrix_of_a_system_is_the_assignments_without_exact_pins(network):
    springs, stiffness, mass, time_step, pinned, weight = network
    mass = mass + 1.0  # every vertex is determined
    mixed = np.where(np.arange(len(pinned)) % 2, np.inf, weight)
    energy = Springs.from_rest_shape(np.zeros((len(mass), 3)), springs, stiffness)
    system = System(mass, time_step, (energy,), DirichletPins(pinned, mixed))
    soft = np.isfinite(mixed)
    expected = dense_matrices(springs, stiffness, mass, time_step, pinned[soft], weight[soft])["Q"]
    made = system_matrix_assembly.assemble_system_matrix(system, [energy])
    np.testing.assert_allclose(made.toarray(), expected, rtol=0, atol=ROUND_OFF * np.abs(expected).max())
    assert made.nnz == len(mass) + 2 * len(springs)


def test_the_energy_norm_is_a_number_where_round_off_makes_its_square_negative():
    rng = np.random.default_rng(0)
    springs, k = rng.integers(0, 9, (30, 2)), rng.uniform(size=30)
    network = springs, k, np.zeros(9), 1.0, np.empty(0, np.int64), np.empty(0)
    shifts = [np.tile(shift, (9, 1)) for shift in rng.normal(size=(50, 3))]
    for Q in (dense_matrices(*network)["Q"], sparse_matrices(*network)["Q"]):
        assert min(np.einsum("ij,ij->", e, Q @ e) for e in shifts) < 0.0
        # Springs do not feel a shift: the square is zero but for round-off of some 1e-15.
        assert all(0.0 <= system_matrix_assembly.energy_norm(Q, e) < 1e-6 for e in shifts)


LOOSE = {
    "a vertex alone": ([[0, 1]], [1.0], [1, 1, 0], [], "1 in all (2)"),
    "springs that lead nowhere": ([[1, 2]], [1.0], [1, 0, 0], [], "2 in all (1, 2)"),
    "a spring of no stiffness": ([[0, 1]], [0.0], [1, 0], [], "1 in all (1)"),
    "a loop": ([[1, 1]], [1.0], [1, 0], [], "1 in all (1)"),
    "more than five": (np.empty((0, 2)), [], [0] * 7, [], "7 in all (0, 1, 2, 3, 4, ...)"),
}
DETERMINED_SYSTEMS = {
    "a mass": (np.empty((0, 2)), [], [1.0], []),
    "a pin": (np.empty((0, 2)), [], [0.0], [0]),
    "springs to a mass": ([[0, 1], [1, 2]], [1.0, 1.0], [0, 0, 1], []),
    "a spring to a pin": ([[0, 1]], [1.0], [0, 0], [1]),
}


def bare_system(springs, stiffness, mass, pinned, weight=1.0):
    edges = np.array(springs, np.int64).reshape(-1, 2)
    energy = Springs.from_rest_shape(np.zeros((len(mass), 3)), edges, np.array(stiffness, float))
    pins = DirichletPins(np.array(pinned, np.int64), np.full(len(pinned), weight))
    return System(np.array(mass, float), 1.0, (energy,), pins), energy


@pytest.mark.parametrize("case", LOOSE)
def test_vertices_that_nothing_determines_are_named(case):
    springs, stiffness, mass, pinned, named = LOOSE[case]
    system, energy = bare_system(springs, stiffness, mass, pinned)
    with pytest.raises(NotPositiveDefinite) as raised:
        system_matrix_assembly.assemble_system_matrix(system, [energy])
    assert named in str(raised.value)


@pytest.mark.parametrize("weight", [1.0, np.inf])
@pytest.mark.parametrize("case", DETERMINED_SYSTEMS)
def test_a_mass_or_a_pin_determines_all_that_springs_tie_to_it(case, weight):
    springs, stiffness, mass, pinned = DETERMINED_SYSTEMS[case]
    system, energy = bare_system(springs, stiffness, mass, pinned, weight)
    assert system_matrix_assembly.assemble_system_matrix(system, [energy]).shape == (
        system.num_vertices,
        system.num_vertices,
    )
