"""The V-cycle by itself: aggregates, a symmetric and definite operator, coarse levels of small size."""

from __future__ import annotations

import numpy as np
import pytest
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.multigrid.multigrid_kernels import build_aggregates, filter_weak_entries
from springbench.solvers.linalg.multigrid.smoothed_aggregation import Multigrid

from tests.network_matrices import grid_matrix, grid_springs, network_matrix, random_right_hand_sides

SHEET, SOLID = grid_matrix(70, 70), grid_matrix(14, 14, 14)


def cycle(multigrid, r):
    multigrid.right_hand_side[:, :3] = r
    return multigrid.apply_cycle()[:, :3].astype(float)


def aggregates(Q):
    return build_aggregates(Q.indptr, Q.indices, Q.data, 0.25, 10.0)


@pytest.mark.parametrize("Q", [SHEET, SOLID], ids=["sheet", "solid"])
def test_the_cycle_is_symmetric_and_positive_definite(Q):
    multigrid, n = Multigrid(Q), len(Q.indptr) - 1
    r, s = random_right_hand_sides(n, 1), random_right_hand_sides(n, 2)
    zr, zs = cycle(multigrid, r), cycle(multigrid, s)
    cross = np.abs(r * zs).sum(axis=0)
    # float32 rounds each of about a hundred operations to 6e-8, of terms that cancel in the sum
    assert np.abs((s * zr).sum(axis=0) - (r * zs).sum(axis=0)).max() <= 1e-4 * cross.max()
    assert ((r * zr).sum(axis=0) > 0.0).all()


@pytest.mark.parametrize("Q", [SHEET, SOLID], ids=["sheet", "solid"])
def test_a_cycle_takes_out_most_of_any_error(Q):
    multigrid, n = Multigrid(Q), len(Q.indptr) - 1
    x = random_right_hand_sides(n)

    def energy(e):
        return np.einsum("ij,ij->", e, Q @ e)

    rates = []
    for _ in range(12):  # what is left of the error is what the cycle is worst at
        following = x - cycle(multigrid, Q @ x)
        rates.append((energy(following) / energy(x)) ** 0.5)
        x = following / np.abs(following).max()
    # 0.2 was measured for both; textbooks' smoothed aggregation has 0.1 to 0.4
    assert max(rates) <= 0.4


@pytest.mark.parametrize(("Q", "most"), [(SHEET, 0.14), (SOLID, 0.06)], ids=["sheet", "solid"])
def test_levels_shrink_by_the_neighbours_of_a_vertex(Q, most):
    multigrid = Multigrid(Q)
    # 9 and 27 vertices an aggregate, less at the borders
    assert multigrid.level_sizes[1] <= most * multigrid.level_sizes[0]
    assert multigrid.nonzeros <= 2.5 * Q.nnz


def test_stiffness_over_six_decades_does_not_fill_the_levels():
    springs, rng = grid_springs(70, 70), np.random.default_rng(0)
    Q = network_matrix(springs, 10.0 ** rng.uniform(0, 6, len(springs)), np.full(4900, 1e-3))
    # measured: 3; without the filter of weak springs 33 on a sheet of 150 vertices a side
    assert Multigrid(Q).nonzeros <= 4 * Q.nnz


def test_every_vertex_is_in_one_connected_aggregate():
    of, count = aggregates(SHEET)
    fixed = [0, 69]
    assert (of[fixed] == -1).all()
    others = np.delete(of, fixed)
    np.testing.assert_array_equal(np.unique(others), np.arange(count))
    for a in range(0, count, 50):
        members = np.flatnonzero(of == a)
        rows, cols = np.divmod(members, 70)
        assert np.ptp(rows) <= 4  # within two of its root
        assert np.ptp(cols) <= 4


def test_aggregates_extend_along_stiff_springs():
    springs = grid_springs(40, 40)
    along = springs[:, 1] - springs[:, 0] == 1
    of, count = aggregates(network_matrix(springs, np.where(along, 1e4, 1.0), np.full(1600, 1e-3)))
    for a in range(count):
        assert np.ptp(np.flatnonzero(of == a) // 40) == 0  # in one row of the grid


def test_vertices_that_smoothing_determines_are_in_no_aggregate():
    Q = network_matrix(grid_springs(40, 40), 0.01, np.ones(1600))
    of, count = aggregates(Q)
    assert count == 0
    assert (of == -1).all()


def test_weak_entries_are_lumped_into_the_diagonal_and_row_sums_are_preserved():
    springs, rng = grid_springs(20, 20), np.random.default_rng(0)
    Q = network_matrix(springs, 10.0 ** rng.uniform(0, 6, len(springs)), np.ones(400))
    F = Q.copy()
    F.data = filter_weak_entries(Q.indptr, Q.indices, Q.data, 0.25)
    # sums of up to nine terms of one size: a few eps of the largest
    np.testing.assert_allclose(F.sum(axis=1), Q.sum(axis=1), rtol=0, atol=1e-14 * np.abs(Q.data).max())
    off = F.toarray() - np.diag(F.diagonal())
    assert 0 < np.count_nonzero(off) < Q.nnz - 400
    assert (F.diagonal() > 0.0).all()


def test_a_system_of_the_coarsest_size_is_solved_at_once():
    Q = grid_matrix(20, 20)
    b, expected = random_right_hand_sides(400), np.empty((400, 3))
    SupernodalCholesky(Q).solve(b, expected)
    # in and out in float32
    assert np.abs(cycle(Multigrid(Q), b) - expected).max() <= 1e-6 * np.abs(expected).max()
