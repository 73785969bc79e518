"""The sum of a system's constant quadratic forms: weights of vertex pairs and of vertices.

    x'Lx/2 = sum over i < j of w_ij/2 |x_i - x_j|^2 + sum over i of h_i/2 |x_i|^2,     w_ij = -L_ij,  h = L 1

Differences of positions avoid the cancellation in products with L. If a form couples more than neighbours, as bending
does, some w are negative. Its force at the origin is constant in a step and is part of the step's external force.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, triu
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel

_ROW_SUM_ROUNDOFF = 1e-13
"""Ratio of a row's sum to its absolute sum below which it counts as zero: the round-off of a dozen terms."""


class QuadraticForm(NamedTuple):
    """A quadratic form: pairs (k, 2) of vertices; pair_weight: w (k,) [N/m]; vertex_weight: h (n,) [N/m]."""

    pairs: NDArray[np.int64]
    pair_weight: NDArray[np.float64]
    vertex_weight: NDArray[np.float64]

    @classmethod
    def from_matrix(cls, L: csr_array) -> QuadraticForm:
        """Build the form of a symmetric matrix [N/m], (n, n)."""
        above = coo_array(triu(L, 1))
        row_sums, size = L.sum(axis=1), abs(L).sum(axis=1)
        return cls(
            np.column_stack(above.coords).astype(np.int64),
            -np.asarray(above.data, np.float64),
            np.where(abs(row_sums) <= _ROW_SUM_ROUNDOFF * size, 0.0, row_sums),
        )

    @classmethod
    def empty_form(cls) -> QuadraticForm:
        """Build an empty form."""
        return cls(np.empty((0, 2), np.int64), np.empty(0), np.empty(0))


@jit_inner
def add_product(form, x, out):
    """Add the product L x; do nothing without a form.

    Args:
        form: the form, or None.
        x: positions or displacements (n, 3) [m].
        out: (n, 3) [N], updated.
    """
    if form is None:
        return
    _add_product(form, x, out)


@jit_inner
def _add_product(form, x, out):
    for i in range(len(form.vertex_weight)):
        h = form.vertex_weight[i]
        out[i, 0] += h * x[i, 0]
        out[i, 1] += h * x[i, 1]
        out[i, 2] += h * x[i, 2]
    for k in range(len(form.pair_weight)):
        i, j, w = form.pairs[k, 0], form.pairs[k, 1], form.pair_weight[k]
        f0, f1, f2 = w * (x[i, 0] - x[j, 0]), w * (x[i, 1] - x[j, 1]), w * (x[i, 2] - x[j, 2])
        out[i, 0] += f0
        out[i, 1] += f1
        out[i, 2] += f2
        out[j, 0] -= f0
        out[j, 1] -= f1
        out[j, 2] -= f2


@jit_inner
def change_form(form, p, q):
    """Return the change q'Lq/2 - p'Lp/2 [J]; 0 without a form.

    Args:
        form: the form, or None.
        p, q: positions (n, 3) [m], before and after.
    """
    if form is None:
        return 0.0
    total = 0.0
    for i in range(len(form.vertex_weight)):
        h = 0.5 * form.vertex_weight[i]
        for c in range(3):
            total += h * (q[i, c] - p[i, c]) * (q[i, c] + p[i, c])
    for k in range(len(form.pair_weight)):
        i, j, change = form.pairs[k, 0], form.pairs[k, 1], 0.0
        for c in range(3):
            s = (q[i, c] - p[i, c]) - (q[j, c] - p[j, c])
            change += s * (2.0 * (p[i, c] - p[j, c]) + s)
        total += 0.5 * form.pair_weight[k] * change
    return total


@jit_kernel
def add_quadratic_blocks(form, diagonal, off_diagonal, values):
    """Add L to the blocks of a matrix.

    Args:
        form: the form.
        diagonal: index of each vertex's diagonal block (n,), -1 for none.
        off_diagonal: indices of each pair's blocks in both directions (k, 2), -1 for none.
        values: blocks (b, 3, 3) [N/m], updated.
    """
    for i in range(len(form.vertex_weight)):
        add_to_diagonal(values, diagonal[i], form.vertex_weight[i])
    for k in range(len(form.pair_weight)):
        w = form.pair_weight[k]
        add_to_diagonal(values, diagonal[form.pairs[k, 0]], w)
        add_to_diagonal(values, diagonal[form.pairs[k, 1]], w)
        add_to_diagonal(values, off_diagonal[k, 0], -w)
        add_to_diagonal(values, off_diagonal[k, 1], -w)


@jit_kernel
def multiply_matrix(pointers, columns, values, x, out):
    """Write the product of a sparse matrix with three columns.

    Args:
        pointers: first entry of each row (n + 1,), the matrix being in compressed rows.
        columns, values: column and number of each entry.
        x: the columns (n, 3).
        out: output (n, 3), overwritten.
    """
    for i in range(len(out)):
        s0, s1, s2 = 0.0, 0.0, 0.0
        for e in range(pointers[i], pointers[i + 1]):
            a, j = values[e], columns[e]
            s0 += a * x[j, 0]
            s1 += a * x[j, 1]
            s2 += a * x[j, 2]
        out[i, 0], out[i, 1], out[i, 2] = s0, s1, s2


@jit_inner
def add_to_diagonal(values, block, w):
    """Add a number to the diagonal of a block.

    Args:
        values: blocks (b, 3, 3) [N/m], updated.
        block: index of the block, -1 for none.
        w: number that is added [N/m].
    """
    if block >= 0:
        values[block, 0, 0] += w
        values[block, 1, 1] += w
        values[block, 2, 2] += w
