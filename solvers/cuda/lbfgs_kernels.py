"""Kernels of L-BFGS: products with a sparse matrix in the place of Q^-1, directions, and scalar products with pairs.

Each row of the matrix gathers its own product; vectors are of the kernels' type, their scalar products are added up in
float64.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array

from solvers.cuda import sums
from solvers.cuda.network import WARP
from solvers.cuda.target import cuda

Real = type[np.float32] | type[np.float64]


class Rows(NamedTuple):
    """A sparse matrix by rows, those of a warp side by side. first (warps + 1,); of each entry its column, the row
    itself where a row is filled up, and its value, 0 there."""

    first: Any
    other: Any
    value: Any

    @classmethod
    def of(cls, matrix: csr_array) -> Rows:
        """Of a matrix (f, f)."""
        rows = len(matrix.indptr) - 1
        warps, each = -(-rows // WARP), np.diff(matrix.indptr)
        count = np.zeros(warps * WARP, np.int64)
        count[:rows] = each
        first = np.concatenate([[0], np.cumsum(WARP * count.reshape(warps, WARP).max(axis=1, initial=0))])
        here, nth = np.repeat(np.arange(rows), each), np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], each)
        at, lane = first[here // WARP] + WARP * nth + here % WARP, np.arange(first[-1])
        other = (
            np.repeat(WARP * np.arange(warps), np.diff(first)) + (lane - np.repeat(first[:-1], np.diff(first))) % WARP
        )
        other, value = np.minimum(other, rows - 1), np.zeros(len(lane))
        other[at], value[at] = matrix.indices, matrix.data
        return cls(first.astype(np.int32), other.astype(np.int32), value)


class Kernels(NamedTuple):
    """Of a precision: see each."""

    multiply: Any
    combine: Any
    keep: Any
    against: Any


@cache
def kernels(real: Real) -> Kernels:
    """Those of vectors in `real`."""

    @cuda.jit
    def multiply(S, g, out):
        """Write -S g (f, 3) to `out`."""
        i = cuda.grid(1)
        while i < out.shape[0]:
            x0 = x1 = x2 = real(0.0)
            e, end = S.first[i >> 5] + (i & 31), S.first[(i >> 5) + 1]
            while e < end:
                j, a = S.other[e], S.value[e]
                x0, x1, x2 = x0 - a * real(g[j, 0]), x1 - a * real(g[j, 1]), x2 - a * real(g[j, 2])
                e += 32
            out[i, 0], out[i, 1], out[i, 2] = x0, x1, x2
            i += cuda.gridsize(1)

    @cuda.jit
    def combine(scale, c, a, b, steps, images, d):
        """Write scale c - sum of a_j s_j + b_j w_j to d, (f, 3)."""
        i = cuda.grid(1)
        while i < d.shape[0]:
            for k in range(3):
                total = scale * np.float64(c[i, k])
                for j in range(a.shape[0]):
                    if a[j] != 0.0 or b[j] != 0.0:
                        total -= a[j] * np.float64(steps[j, i, k]) + b[j] * np.float64(images[j, i, k])
                d[i, k] = real(total)
            i += cuda.gridsize(1)

    @cuda.jit
    def keep(new, p, q, g, there, c, after, steps, images, partials):
        """Keep s = q - p and w = c - c after as the pair `new`; and the first stages of -g'c after, s'y and w'y, with
        y = g there - g."""
        squared, sy, wy, i = 0.0, 0.0, 0.0, cuda.grid(1)
        while i < c.shape[0]:
            for k in range(3):
                s, w, y = real(q[i, k] - p[i, k]), c[i, k] - after[i, k], there[i, k] - g[i, k]
                steps[new, i, k], images[new, i, k] = s, w
                squared -= there[i, k] * np.float64(after[i, k])
                sy += np.float64(s) * y
                wy += np.float64(w) * y
            i += cuda.gridsize(1)
        sums.keep(squared, 0, partials)
        sums.keep(sy, 1, partials)
        sums.keep(wy, 2, partials)

    @cuda.jit
    def against(steps, images, g, partials):
        """The first stages of s_j'g and w_j'g of all pairs j, after those of `keep`."""
        m = steps.shape[0]
        for j in range(m):
            sg, wg, i = 0.0, 0.0, cuda.grid(1)
            while i < g.shape[0]:
                for k in range(3):
                    sg += np.float64(steps[j, i, k]) * g[i, k]
                    wg += np.float64(images[j, i, k]) * g[i, k]
                i += cuda.gridsize(1)
            sums.keep(sg, 3 + j, partials)
            sums.keep(wg, 3 + m + j, partials)

    return Kernels(multiply, combine, keep, against)
