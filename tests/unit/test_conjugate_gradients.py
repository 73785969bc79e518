"""Conjugate gradients with multigrid: accuracy, iterations that do not grow, the same bits, refusals."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import block_diag, csr_array
from scipy.sparse.linalg import splu
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.multigrid.multigrid_pcg import CG_RTOL, ConjugateGradients
from springbench.solvers.model.step_problem import NotPositiveDefinite, Unsupported

from tests.network_matrices import backward_error, grid_matrix, grid_springs, network_matrix, random_right_hand_sides


def solve_system(Q, b):
    out = np.full_like(b, np.nan)
    factor = ConjugateGradients(Q)
    factor.solve(b, out)
    return out, factor


def build_shuffled_grid(n):
    springs = np.random.default_rng(0).permutation(n * n)[grid_springs(n, n)]
    return network_matrix(springs, 1.0, np.full(n * n, 1e-3))


def half_stiff(n, ratio):
    springs = grid_springs(n, n)
    return network_matrix(springs, np.where(springs[:, 0] < n * n // 2, ratio, 1.0), np.full(n * n, 1e-3))


def rough(n, decades):
    springs, rng = grid_springs(n, n), np.random.default_rng(1)
    return network_matrix(springs, 10.0 ** rng.uniform(0, decades, len(springs)), np.full(n * n, 1e-1))


def pinned_rows(n):
    diagonal = np.full(n * n, 1e-3)
    diagonal[::7] = 1e10
    return network_matrix(grid_springs(n, n), 1e5, diagonal)


CASES = {
    "one vertex": network_matrix([], 1.0, [2.0]),
    "a sheet below the coarsest size": grid_matrix(10, 10),
    "a sheet": grid_matrix(70, 70),
    "a sheet numbered at random": build_shuffled_grid(60),
    "a solid": grid_matrix(15, 15, 15),
    "a chain": network_matrix([(i, i + 1) for i in range(3999)], 1.0, np.full(4000, 0.01)),
    "a star": network_matrix([(0, i) for i in range(1, 4000)], 1.0, np.ones(4000)),
    "isolated vertices": network_matrix([], 1.0, np.arange(1.0, 4001.0)),
    "springs that mass outweighs": network_matrix(grid_springs(60, 60), 0.01, np.ones(3600)),
    "sheets apart": csr_array(block_diag([grid_matrix(25, 25)] * 6, format="csr")),
    "many pins": pinned_rows(60),
    "stiffness over four decades": rough(60, 4.0),
    "one half stiffer": half_stiff(60, 1e3),
}


@pytest.mark.parametrize("name", CASES)
def test_solves_networks_of_every_shape_in_few_iterations(name):
    Q = CASES[name]
    b = random_right_hand_sides(len(Q.indptr) - 1)
    out, factor = solve_system(Q, b)
    expected = splu(Q.tocsc()).solve(b)
    # z underestimates the error by the cycle's rate, 0.1 to 0.3; conditions of 1e4 to 1e6 times eps are the rest.
    assert np.abs(out - expected).max() <= 1e-10 * np.abs(expected).max()
    # measured: 2 to 17; a cycle that fails to take out some error takes hundreds
    assert factor.num_iterations <= 25


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1600, 2500), st.floats(0.5, 4.0))
def test_solves_random_networks_as_superlu_does(seed, n, degree):
    rng = np.random.default_rng(seed)
    ends = rng.integers(0, n, (int(degree * n), 2))
    near = (ends[:, 0] + rng.integers(0, 12, len(ends))) % n  # half of the springs are short, as in a mesh
    ends[: len(ends) // 2, 1] = near[: len(ends) // 2]
    Q = network_matrix(ends, 10.0 ** rng.uniform(0, 2, len(ends)), 10.0 ** rng.uniform(0, 2, n))
    b = random_right_hand_sides(n)
    expected = splu(Q.tocsc()).solve(b)
    # entries over four decades: the condition is at most 1e5, and z is within ten times the error
    assert np.abs(solve_system(Q, b)[0] - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("shapes", [[(60, 60), (240, 240)], [(13, 13, 13), (30, 30, 30)]], ids=["sheets", "solids"])
def test_iterations_do_not_grow_with_the_mesh(shapes):
    counts = [
        solve_system(grid_matrix(*shape), random_right_hand_sides(int(np.prod(shape))))[1].num_iterations
        for shape in shapes
    ]
    # 16 times the vertices; without a coarse level they take four times the iterations
    assert counts[1] <= counts[0] + 3


def test_a_tolerance_in_positions_sees_through_the_units_of_rows():
    Q = grid_matrix(60, 60)
    b = random_right_hand_sides(3600)
    out, factor = solve_system(Q, b)
    scaled, again = solve_system(csr_array(Q * 2.0**-40), b * 2.0**-40)
    np.testing.assert_array_equal(scaled, out)  # powers of two change no digit
    assert again.num_iterations == factor.num_iterations
    # The rows of the pins are 1e5 times the others, and weigh no more.
    assert backward_error(Q, out, b) <= 1e-10


def test_the_last_corrections_explain_the_termination():
    _, factor = solve_system(grid_matrix(60, 60), random_right_hand_sides(3600))
    assert len(factor.correction_ratios) == factor.num_iterations + 1
    assert factor.correction_ratios[-1].max() <= CG_RTOL < factor.correction_ratios[-2].max()


def test_right_hand_sides_that_are_zero_or_far_apart_do_not_disturb_each_other():
    Q = grid_matrix(60, 60)
    b = random_right_hand_sides(3600)
    b[:, 1] = 0.0
    b[:, 2] *= 1e3
    out, _ = solve_system(Q, b)
    expected = np.empty_like(b)
    SupernodalCholesky(Q).solve(b, expected)
    assert (out[:, 1] == 0.0).all()
    # the tolerance is that of the largest entry of all
    assert np.abs(out - expected).max() <= 1e-11 * np.abs(expected).max()
    assert (solve_system(Q, np.zeros((3600, 3)))[0] == 0.0).all()


def test_solves_no_equations_at_all():
    assert solve_system(csr_array((0, 0)), np.empty((0, 3)))[0].shape == (0, 3)


def test_a_solve_depends_on_its_right_hand_sides_alone():
    b = random_right_hand_sides(3600)
    factor = ConjugateGradients(grid_matrix(60, 60))
    first, between, last = (np.empty_like(b) for _ in range(3))
    original = b.copy()
    factor.solve(b, first)
    factor.solve(b[::-1].copy(), between)
    factor.solve(b, last)
    np.testing.assert_array_equal(last, first)
    np.testing.assert_array_equal(b, original)


def test_gives_the_same_bits_whatever_the_number_of_threads():
    Q, b = grid_matrix(100, 100), random_right_hand_sides(10000)
    before, results = numba.get_num_threads(), []
    try:
        for count in range(1, before + 1):
            numba.set_num_threads(count)
            results.append(solve_system(Q, b)[0])
    finally:
        numba.set_num_threads(before)
    for out in results[1:]:
        np.testing.assert_array_equal(out, results[0])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_refuses_a_matrix_that_is_not_finite_and_states_where(value):
    Q = grid_matrix(5, 5)
    Q.data[Q.indptr[7]] = value
    with pytest.raises(NotPositiveDefinite, match=r"not finite in row 7\b"):
        ConjugateGradients(Q)


def test_names_a_vertex_of_negative_mass():
    with pytest.raises(NotPositiveDefinite, match=r"vertex 31\b"):
        ConjugateGradients(network_matrix([], 1.0, np.where(np.arange(50) == 31, -1.0, 1.0)))


def test_refuses_an_unconstrained_sheet():
    Q = network_matrix(grid_springs(60, 60), 1.0, np.zeros(3600))
    with pytest.raises(NotPositiveDefinite, match="not positive definite"):
        solve_system(Q, random_right_hand_sides(3600))


def test_names_a_vertex_near_springs_that_push():
    springs = grid_springs(60, 60)
    k = np.ones(len(springs))
    k[np.abs(springs - 1830).min(axis=1) == 0] = -0.9  # about vertex 1830, whose diagonal is positive by a mass
    diagonal = np.full(3600, 1e-3)
    diagonal[1830] = 10.0
    with pytest.raises(NotPositiveDefinite):
        solve_system(network_matrix(springs, k, diagonal), random_right_hand_sides(3600))


def test_reports_stiffnesses_that_are_too_far_apart():
    springs, rng = grid_springs(100, 100), np.random.default_rng(0)
    Q = network_matrix(springs, 10.0 ** rng.uniform(0, 14, len(springs)), np.full(10000, 1e-3))
    with pytest.raises((Unsupported, NotPositiveDefinite), match="too far apart"):
        solve_system(Q, random_right_hand_sides(10000))
