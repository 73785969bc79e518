"""The Hessian of springs, assembled directly into a matrix of 3 x 3 blocks, and its products.

    H_e = k nn' + t/l (I - nn'),   t = k (l - r),   n the direction of a spring, l its length, t its tension

A compressed spring (t < 0) has a negative transverse part. It is scaled by `keep`: 1 gives the exact
Hessian, 0 makes it positive semidefinite spring by spring (Teran et al. 2005). The tensions are a separate argument,
for methods that predict them (see `solvers.methods.hybrid`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.compiling import inner, kernel
from solvers.energies.elements import add_products
from solvers.kernels.forms import add_product
from solvers.kernels.forms import hold as hold_block
from solvers.kernels.objective import along
from solvers.problem import System


class Places(NamedTuple):
    """Block indices of vertices and springs in a matrix over the free vertices.

    Attributes:
        free: free vertices (f,).
        diagonal: diagonal block of each vertex (n,), -1 for a vertex that is not free.
        across: blocks of each spring from its first end to its second and back (m, 2), -1 if an end is not free.
    """

    free: NDArray[np.int64]
    diagonal: NDArray[np.int64]
    across: NDArray[np.int64]

    @classmethod
    def of(cls, system: System, edges: NDArray[np.int64], graph: csr_array) -> Places:
        """Return the indices for a matrix with the block pattern `graph`, (f, f), sorted, over the free vertices."""
        n, f = system.vertices, len(system.free)
        key = np.repeat(np.arange(f), np.diff(graph.indptr)) * f + graph.indices
        number = np.full(n, -1)
        number[system.free] = np.arange(f)
        diagonal = np.full(n, -1)
        diagonal[system.free] = np.searchsorted(key, np.arange(f) * (f + 1))
        i, j = number[edges].T
        inside = (i >= 0) & (j >= 0) & (i != j)
        across = np.full((len(edges), 2), -1)
        for side, (a, b) in enumerate([(i, j), (j, i)]):
            across[inside, side] = np.searchsorted(key, a[inside] * f + b[inside])
        return cls(system.free, diagonal, across)


@kernel
def locate(number, starts, columns, vertices, out):
    """Write the block of each vertex pair within rows of vertices (m, k) to `out` (m, k^2).

    It is -1 if one vertex is not free. Returns False if a block is missing. The matrix has sorted columns; `number` is
    the index of each vertex among the free ones, or -1.
    """
    many = vertices.shape[1]
    for e in range(len(vertices)):
        for a in range(many):
            i = number[vertices[e, a]]
            for b in range(many):
                j, at = number[vertices[e, b]], many * a + b
                if i < 0 or j < 0:
                    out[e, at] = -1
                    continue
                low, high = starts[i], starts[i + 1] - 1
                while low < high:
                    middle = (low + high) // 2
                    if columns[middle] < j:
                        low = middle + 1
                    else:
                        high = middle
                if columns[low] != j:
                    return False
                out[e, at] = low
    return True


@kernel
def meetings(number, size, vertices, out):
    """Write each pair of different free vertices of each row (m, k) to `out`, as lower index times `size` plus higher.

    Returns the number of pairs; `number` is that of `locate`.
    """
    count = 0
    for e in range(len(vertices)):
        for a in range(vertices.shape[1]):
            i = number[vertices[e, a]]
            for b in range(a):
                j = number[vertices[e, b]]
                if i >= 0 and j >= 0 and i != j:
                    out[count] = min(i, j) * size + max(i, j)
                    count += 1
    return count


@kernel
def tensions(terms, p, d, out):
    """Write the springs' tensions [N] at p, linearised for a displacement d (both (n, 3)), to out (m,)."""
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        n0, n1, n2, length = along(terms, e, p)
        stretch = n0 * (d[i, 0] - d[j, 0]) + n1 * (d[i, 1] - d[j, 1]) + n2 * (d[i, 2] - d[j, 2])
        out[e] = terms.stiffness[e] * (length - terms.rest_length[e] + stretch)


@inner
def _lateral(terms, e, length, tension, keep):
    """Return the transverse stiffness [N/m] of spring e, at most k; 0 for zero length and positive rest length."""
    if terms.rest_length[e] == 0.0:
        return terms.stiffness[e]
    if length <= 0.0:
        return 0.0
    lateral = min(tension / length, terms.stiffness[e])
    return lateral * keep if lateral < 0.0 else lateral


@inner
def _add(values, block, sign, xx, xy, xz, yy, yz, zz):
    """Add sign times a symmetric block."""
    values[block, 0, 0] += sign * xx
    values[block, 0, 1] += sign * xy
    values[block, 0, 2] += sign * xz
    values[block, 1, 0] += sign * xy
    values[block, 1, 1] += sign * yy
    values[block, 1, 2] += sign * yz
    values[block, 2, 0] += sign * xz
    values[block, 2, 1] += sign * yz
    values[block, 2, 2] += sign * zz


@kernel
def hold(terms, places, values):
    """Write the stiffness [N/m] of inertia and penalty pins to the blocks `values`, (b, 3, 3)."""
    _hold(terms, places, values)


@inner
def _hold(terms, places, values):
    values[:] = 0.0
    for v in places.free:
        hold_block(values, places.diagonal[v], terms.inertia[v])
    for q in range(len(terms.pinned)):
        hold_block(values, places.diagonal[terms.pinned[q]], terms.weight[q])


@kernel
def assemble(terms, places, constant, p, tension, keep, values):
    """Write the Hessian [N/m] of springs, inertia and penalty pins at p (n, 3) to the blocks `values`, (b, 3, 3).

    Args:
        terms: objective terms.
        places: block indices.
        constant: blocks of inertia, pins and other terms independent of p; None if there are no other terms.
        p: positions (n, 3) [m].
        tension: tension of each spring (m,) [N].
        keep: factor of the springs' negative transverse parts.
        values: output (b, 3, 3) [N/m].
    """
    if constant is None:
        _hold(terms, places, values)
    else:
        for block in range(len(values)):
            for row in range(3):
                for column in range(3):
                    values[block, row, column] = constant[block, row, column]
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        if i == j:
            continue
        n0, n1, n2, length = along(terms, e, p)
        lateral = _lateral(terms, e, length, tension[e], keep)
        a = terms.stiffness[e] - lateral
        xx, xy, xz = a * n0 * n0 + lateral, a * n0 * n1, a * n0 * n2
        yy, yz, zz = a * n1 * n1 + lateral, a * n1 * n2, a * n2 * n2 + lateral
        if places.diagonal[i] >= 0:
            _add(values, places.diagonal[i], 1.0, xx, xy, xz, yy, yz, zz)
        if places.diagonal[j] >= 0:
            _add(values, places.diagonal[j], 1.0, xx, xy, xz, yy, yz, zz)
        if places.across[e, 0] >= 0:
            _add(values, places.across[e, 0], -1.0, xx, xy, xz, yy, yz, zz)
            _add(values, places.across[e, 1], -1.0, xx, xy, xz, yy, yz, zz)


@kernel
def linearise(terms, p, out):
    """Write the linearised springs at p (n, 3) to out (m, 4).

    These are sqrt(k - lateral) n and lateral, the transverse stiffness.
    """
    for e in range(len(terms.stiffness)):
        n0, n1, n2, length = along(terms, e, p)
        k = terms.stiffness[e]
        lateral = _lateral(terms, e, length, k * (length - terms.rest_length[e]), 1.0)
        root = np.sqrt(k - lateral)
        out[e, 0], out[e, 1], out[e, 2], out[e, 3] = root * n0, root * n1, root * n2, lateral


@kernel
def multiply(terms, linear, form, joined, curvature, x, out):
    """Write the product [N] of the exact Hessian with x [m], (n, 3), to `out`.

    Args:
        terms: objective terms.
        linear: output of `linearise`.
        form, joined, curvature: quadratic form, elements and their Hessians, or None.
        x: (n, 3) [m].
        out: output (n, 3) [N].
    """
    _multiply(terms, linear, x, out)
    add_product(form, x, out)
    add_products(joined, curvature, x, out)


@inner
def _multiply(terms, linear, x, out):
    for v in range(len(x)):
        for c in range(3):
            out[v, c] = terms.inertia[v] * x[v, c]
    for q in range(len(terms.pinned)):
        v = terms.pinned[q]
        for c in range(3):
            out[v, c] += terms.weight[q] * x[v, c]
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        s0, s1, s2 = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        stretch = linear[e, 0] * s0 + linear[e, 1] * s1 + linear[e, 2] * s2
        f0 = linear[e, 3] * s0 + stretch * linear[e, 0]
        f1 = linear[e, 3] * s1 + stretch * linear[e, 1]
        f2 = linear[e, 3] * s2 + stretch * linear[e, 2]
        out[i, 0] += f0
        out[i, 1] += f1
        out[i, 2] += f2
        out[j, 0] -= f0
        out[j, 1] -= f1
        out[j, 2] -= f2
