"""The factorisation of matrices of 3 x 3 blocks, against SciPy's."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import bsr_array, coo_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import spsolve
from springbench.harness.execution.machine_info import limit_threads
from springbench.solvers.linalg.cholesky import block_cholesky
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky

from tests.network_matrices import grid_springs

ROUND_OFF = 1e-12
"""Of a solution relative to its largest entry: the matrices are diagonally dominant, so that errors do not grow."""


def blocks(n: int, pairs: np.ndarray, seed: int = 0, margin: float = 0.1) -> bsr_array:
    """A random symmetric matrix with blocks at the pairs (m, 2) and on the diagonal, which dominates by a margin."""
    rng = np.random.default_rng(seed)
    i, j = np.concatenate([pairs, pairs[:, ::-1], np.tile(np.arange(n)[:, None], 2)]).T
    graph = csr_array(coo_array((np.ones(len(i)), (i, j)), shape=(n, n)))
    graph.sum_duplicates()
    random = bsr_array((rng.normal(size=(graph.nnz, 3, 3)), graph.indices, graph.indptr), shape=(3 * n, 3 * n))
    A = csr_array(random + random.T)
    A = csr_array(A + diags_array(np.asarray(abs(A).sum(axis=1)).ravel() + margin))
    out = bsr_array(A, blocksize=(3, 3))
    out.sort_indices()
    return out


def graph_of(A: bsr_array) -> csr_array:
    return csr_array((np.ones(len(A.indices)), A.indices, A.indptr))


def entries(A: bsr_array) -> NDArray[np.float64]:
    return np.array(A.data, np.float64)


def random_pairs(n: int, m: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, n, (m, 2))


MATRICES = {
    "one vertex": blocks(1, np.empty((0, 2), np.int64)),
    "two vertices apart": blocks(2, np.empty((0, 2), np.int64)),
    "a chain of odd length": blocks(7, np.stack([np.arange(6), np.arange(1, 7)], axis=1)),
    "a sheet": blocks(400, grid_springs(20, 20)),
    "a sheet that threads would share": blocks(3600, grid_springs(60, 60)),
    "a solid": blocks(343, grid_springs(7, 7, 7)),
    "many parts": blocks(300, random_pairs(300, 200)),
    "nearly full": blocks(60, random_pairs(60, 900)),
    "more columns than are multiplied together": blocks(150, random_pairs(150, 6000)),
}
matrices = pytest.mark.parametrize("A", MATRICES.values(), ids=list(MATRICES))


@matrices
def test_a_solve_agrees_with_scipy(A):
    b = np.random.default_rng(2).normal(size=(len(A.indptr) - 1, 3))
    factor = BlockCholesky(graph_of(A))
    assert factor.factorise(entries(A))
    expected = np.asarray(spsolve(A.tocsc(), b.ravel())).reshape(-1, 3)
    np.testing.assert_allclose(factor.solve(b), expected, rtol=0, atol=ROUND_OFF * np.abs(expected).max())
    np.testing.assert_array_equal(BlockCholesky(graph_of(A)).factorise_and_solve(entries(A), b), factor.solve(b))


@matrices
def test_an_indefinite_matrix_is_detected_wherever_it_is_indefinite(A):
    factor, n = BlockCholesky(graph_of(A)), len(A.indptr) - 1
    rows = np.repeat(np.arange(n), np.diff(A.indptr))
    for vertex in np.unique(np.linspace(0, n - 1, 5).astype(int)):
        values = entries(A)
        values[(rows == vertex) & (A.indices == vertex), 1, 1] *= -1.0
        assert not factor.factorise(values)
        assert factor.factorise_and_solve(values, np.ones((n, 3))) is None
    assert factor.factorise(entries(A)), "a failure leaves nothing behind"


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_not_positive_definite(value):
    A = MATRICES["a sheet"]
    factor, values = BlockCholesky(graph_of(A)), entries(A)
    rows = np.repeat(np.arange(400), np.diff(A.indptr))
    values[(rows == 200) & (A.indices == 200), 0, 0] = value
    assert not factor.factorise(values)


def test_a_matrix_that_is_singular_within_round_off_is_not_positive_definite():
    """Springs without supports: the sum of each row is zero."""
    n, pairs = 20, np.stack([np.arange(19), np.arange(1, 20)], axis=1)
    laplace = np.diag(np.r_[1.0, 2.0 * np.ones(18), 1.0]) - np.eye(n, k=1) - np.eye(n, k=-1)
    A = bsr_array(csr_array(np.kron(laplace, np.eye(3))), blocksize=(3, 3))
    A.sort_indices()
    assert len(A.indices) == n + 2 * len(pairs)
    assert not BlockCholesky(graph_of(A)).factorise(entries(A))


def test_a_factor_gives_the_same_bits_each_time_and_in_each_copy():
    A, B = (blocks(400, grid_springs(20, 20), seed) for seed in (0, 1))
    b = np.random.default_rng(2).normal(size=(400, 3))
    one, two = BlockCholesky(graph_of(A)), BlockCholesky(graph_of(A))
    assert one.factorise(entries(A))
    first = one.solve(b)
    assert one.factorise(entries(B))
    assert one.factorise(entries(A))
    assert two.factorise(entries(A))
    np.testing.assert_array_equal(one.solve(b), first)
    np.testing.assert_array_equal(two.solve(b), first)


@matrices
def test_the_count_of_entries_is_that_of_a_factor_in_blocks(A):
    n = len(A.indptr) - 1
    factor = BlockCholesky(graph_of(A))
    # At least the lower triangle of the matrix, at most a full one.
    assert (9 * (len(A.indices) + n) // 2 - 3 * n) <= factor.nonzeros <= 3 * n * (3 * n + 1) // 2


@pytest.fixture
def always_by_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads share even small factorisations."""
    monkeypatch.setattr(block_cholesky, "_MIN_THREADED_FLOPS", 0.0)


def by_threads(A: bsr_array, values: NDArray[np.float64]) -> list[tuple[NDArray[np.float64] | None, float, bytes]]:
    """The solution, the counted factorisations and another solve, for each number of threads."""
    size = values.shape[1]
    b, found = np.random.default_rng(3).normal(size=(len(A.indptr) - 1, size)), []
    for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):  # type: ignore[attr-defined]
        with limit_threads(threads):
            factor = BlockCholesky(graph_of(A), block_size=size)
            x = factor.factorise_and_solve(values, b)
            again = b if x is None else factor.solve(b)
        found.append((x, factor.num_factorisations, again.tobytes()))
    return found


@pytest.mark.usefixtures("always_by_threads")
@matrices
@pytest.mark.parametrize("size", [1, 3])
def test_the_bits_do_not_depend_on_threads(A, size):
    values = entries(A)[:, :size, :size].copy()
    (first, *_), *others = by_threads(A, values)
    assert first is not None
    for x, _, again in others:
        assert x is not None
        assert first.tobytes() == x.tobytes() == again


@matrices
def test_numbers_are_blocks_of_one(A):
    """The first entry of each block makes a matrix that is diagonally dominant too."""
    values, n = entries(A)[:, :1, :1].copy(), len(A.indptr) - 1
    b = np.random.default_rng(4).normal(size=(n, 1))
    found = BlockCholesky(graph_of(A), block_size=1).factorise_and_solve(values, b)
    expected = np.asarray(spsolve(csc_array(csr_array((values.ravel(), A.indices, A.indptr), shape=(n, n))), b.ravel()))
    assert found is not None
    np.testing.assert_allclose(found.ravel(), expected, rtol=0, atol=ROUND_OFF * np.abs(expected).max())


@pytest.mark.usefixtures("always_by_threads")
@pytest.mark.parametrize("part", [0.0, 0.3, 0.7, 1.0])
def test_what_a_failure_counts_does_not_depend_on_threads(part):
    A = MATRICES["a sheet"]
    values, rows = entries(A), np.repeat(np.arange(400), np.diff(A.indptr))
    vertices = [int(part * 399), 200]  # whichever is eliminated first
    values[(A.indices == rows) & np.isin(rows, vertices), 0, 0] *= -1.0
    (x, count, _), *others = by_threads(A, values)
    assert x is None
    assert {count} == {count for _, count, _ in others}


@pytest.mark.usefixtures("always_by_threads")
@pytest.mark.parametrize("vertex", [0, 133, 399])
def test_a_failure_names_the_vertex_of_its_pivot(vertex: int):
    A = MATRICES["a sheet"]
    values, rows = entries(A), np.repeat(np.arange(400), np.diff(A.indptr))
    values[(A.indices == rows) & (rows == vertex), 0, 0] *= -1.0
    for threads in range(1, numba.config.NUMBA_NUM_THREADS + 1):  # type: ignore[attr-defined]
        with limit_threads(threads):
            factor = BlockCholesky(graph_of(A))
            assert not factor.factorise(values)
            assert factor.failed_vertex == vertex
