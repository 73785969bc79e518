"""Nested dissection and what follows from an order: elimination tree, counts, supernodes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu
from springbench.solvers.linalg.cholesky.nested_dissection import nested_dissection_order
from springbench.solvers.linalg.cholesky.supernode_amalgamation import COLUMN_LANES
from springbench.solvers.linalg.cholesky.symbolic_factorisation import analyse_with_order


def graph(ends, n):
    """The symmetric graph of edges (m, 2), loops included, as a matrix of ones."""
    i, j = np.asarray(ends, np.int64).reshape(-1, 2).T
    loops = np.arange(n)
    rows, columns = np.concatenate([i, j, loops]), np.concatenate([j, i, loops])
    matrix = csr_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    matrix.data[:] = 1.0
    return matrix


def arrays(matrix) -> tuple[np.ndarray, np.ndarray]:
    return matrix.indptr.astype(np.int64), matrix.indices.astype(np.int32)


def box(*shape):
    """A grid in two or three dimensions, each vertex tied to all around it, diagonals included."""
    index = np.arange(np.prod(shape)).reshape(shape)
    ends = []
    for offset in np.ndindex(*[3] * len(shape)):
        step = np.array(offset) - 1
        if tuple(step) > (0,) * len(shape):
            a = index[tuple(slice(max(0, -s), min(k, k - s)) for s, k in zip(step, shape, strict=True))]
            b = index[tuple(slice(max(0, s), min(k, k + s)) for s, k in zip(step, shape, strict=True))]
            ends.append(np.stack([a.ravel(), b.ravel()], axis=1))
    return graph(np.concatenate(ends), int(np.prod(shape)))


@st.composite
def graphs(draw):
    n = draw(st.integers(1, 250))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m = draw(st.integers(0, 3 * n))
    first = rng.integers(0, n, m)
    reach = draw(st.sampled_from([5, 250]))
    return graph(np.stack([first, (first + rng.integers(0, reach, m)) % n], axis=1), n)


def eliminate_dense(matrix, order):
    """The structure of L by elimination of a dense matrix of booleans, in `order`."""
    filled = matrix.toarray()[np.ix_(order, order)] != 0
    for k in range(len(order)):
        below = np.flatnonzero(filled[k + 1 :, k]) + k + 1
        filled[np.ix_(below, below)] = True
    return np.tril(filled)


@settings(max_examples=60, deadline=None)
@given(graphs())
def test_the_order_is_a_permutation(matrix):
    order = nested_dissection_order(*arrays(matrix))
    np.testing.assert_array_equal(np.sort(order), np.arange(matrix.shape[0]))


@settings(max_examples=60, deadline=None)
@given(graphs())
def test_the_structure_is_that_of_dense_elimination(matrix):
    pointers, neighbours = arrays(matrix)
    s = analyse_with_order(pointers, neighbours, nested_dissection_order(pointers, neighbours))
    order = s.vertex_of_slot[s.vertex_of_slot >= 0]
    np.testing.assert_array_equal(np.sort(order), np.arange(matrix.shape[0]))
    np.testing.assert_array_equal(s.vertex_of_slot[s.slot_of_vertex], np.arange(matrix.shape[0]))
    filled = eliminate_dense(matrix, order)
    assert s.nonzeros == filled.sum()
    place = np.cumsum(s.vertex_of_slot >= 0) - 1  # of a slot among the vertices
    for node in range(len(s.parent)):
        columns = place[s.first_slot[node]] + np.arange(s.num_columns[node])
        below = place[s.rows[s.row_start[node] : s.row_start[node + 1]]]
        expected = np.flatnonzero(filled[:, columns].any(axis=1))
        np.testing.assert_array_equal(below, expected[expected > columns[-1]])
        assert s.first_slot[node] % COLUMN_LANES == 0
        assert s.parent[node] == -1 or node < s.parent[node]


# Dissection gains with the number of its levels: nothing yet on the small and narrow ones, a tenth on a cube.
@pytest.mark.parametrize(
    ("shape", "limit"), [((40, 40), 1.0), ((90, 30), 1.03), ((30, 6, 6), 1.03), ((12, 12, 12), 0.9)], ids=str
)
def test_fills_in_about_as_little_as_minimum_degree(shape, limit):
    matrix = box(*shape)
    pointers, neighbours = arrays(matrix)
    filled = analyse_with_order(pointers, neighbours, nested_dissection_order(pointers, neighbours)).nonzeros
    safe = csc_array(matrix + 100 * csr_array(np.eye(len(pointers) - 1)))
    options = {"SymmetricMode": True}
    reference_fill = splu(safe, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).L.nnz
    assert filled <= limit * reference_fill


def test_dissects_a_square_as_well_as_its_geometry_does():
    matrix = box(63, 63)
    pointers, neighbours = arrays(matrix)
    filled = analyse_with_order(pointers, neighbours, nested_dissection_order(pointers, neighbours)).nonzeros

    def cut(rows, columns):
        """Rows and columns of the grid: the order of George's nested dissection along straight lines."""
        if len(rows) * len(columns) <= 4:
            return [(i, j) for i in rows for j in columns]
        if len(rows) < len(columns):
            return [(i, j) for j, i in cut(columns, rows)]
        middle = len(rows) // 2
        line = [(rows[middle], j) for j in columns]
        return cut(rows[:middle], columns) + cut(rows[middle + 1 :], columns) + line

    order = np.array([i * 63 + j for i, j in cut(list(range(63)), list(range(63)))], np.int32)
    geometric = analyse_with_order(pointers, neighbours, order).nonzeros
    assert filled <= 1.02 * geometric


def test_many_components_take_no_longer_than_one():
    """A hundred thousand separate pairs: peeling them off one at a time would take minutes."""
    ends = np.arange(200_000).reshape(-1, 2)
    order = nested_dissection_order(*arrays(graph(ends, 200_000)))
    np.testing.assert_array_equal(np.sort(order), np.arange(200_000))
