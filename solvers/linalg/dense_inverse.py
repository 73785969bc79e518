"""Dense inverse of a small Q.

A solve is one dense product, without a chain of dependent operations:

    x = Q^-1 b,   Q^-1 = L^-T L^-1

For springs Q is an M-matrix. Its inverse has no negative entry, so that the product loses accuracy by two roundings
only.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.sparse import csr_array
from springbench.solvers.jit.kernel_compilation import cached_njit
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.linalg.matrix_errors import build_definiteness_error, require_finite_rows
from springbench.solvers.model.step_problem import Positions

_ROWS_PER_BLOCK = 4
"""Rows of the inverse that are processed together: 12 independent sums hide the latency of an addition."""


class DenseInverse:
    """Dense inverse of a symmetric positive definite Q, for small n: it has n^2 entries.

    Attributes:
        nonzeros: entries of one triangle.
        factor_bytes: bytes of the inverse that a solve reads.
        flops: additions and multiplications of a solve, including padding.
        inverse_matrix: padded with zeros.
    """

    def __init__(self, Q: csr_array, *, precision: Literal["float64", "float32"] = "float64") -> None:
        """Invert Q.

        Args:
            Q: symmetric positive definite matrix (n, n).
            precision: of the stored inverse and of the product.

        Raises:
            NotPositiveDefinite: with the vertex at fault.
        """
        n = len(Q.indptr) - 1
        require_finite_rows(Q)
        dense = np.asfortranarray(Q.toarray())
        inverse = dense
        if n:
            factor, info = dpotrf(dense, lower=1)
            lost = np.flatnonzero(factor.diagonal() ** 2 <= 4.0 * np.finfo(float).eps * dense.diagonal())
            if info or len(lost):
                raise build_definiteness_error(info - 1 if info else int(lost[0]))
            inverse, _ = dpotri(factor, lower=1)
        padded = -(-n // _ROWS_PER_BLOCK) * _ROWS_PER_BLOCK
        stored = np.zeros((padded, padded), precision)
        stored[:n, :n] = np.tril(inverse) + np.tril(inverse, -1).T
        self.nonzeros: int | None = n * (n + 1) // 2
        self.factor_bytes = stored.nbytes
        self.flops = 2 * 3 * stored.size
        self.inverse_matrix, self._columns = stored, np.zeros((3, padded), precision)
        self._multiply_contiguous = TypedKernel(multiply_dense)

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3), not modified.
            out: solution (n, 3), not `b` itself.
        """
        is_contiguous = b.flags.c_contiguous and out.flags.c_contiguous
        multiply = self._multiply_contiguous.call if is_contiguous else multiply_dense
        multiply(self.inverse_matrix, self._columns, b, out)


# Reordering of sums permits vectorisation; NaN and infinity are still respected.
@cached_njit(fastmath={"contract", "reassoc", "nsz"})
def multiply_dense(inverse, columns, b, out):
    """Compute out = inverse b.

    Args:
        inverse: padded inverse matrix.
        columns: scratch (3, padded n) whose padding is zero.
        b: right-hand sides (n, 3).
        out: product (n, 3).
    """
    n = len(b)
    for i in range(n):
        columns[0, i], columns[1, i], columns[2, i] = b[i, 0], b[i, 1], b[i, 2]
    x, y, z = columns[0], columns[1], columns[2]
    zero = inverse.dtype.type(0.0)
    for i in range(0, len(inverse), _ROWS_PER_BLOCK):
        r0, r1, r2, r3 = inverse[i], inverse[i + 1], inverse[i + 2], inverse[i + 3]
        x0, x1, x2, x3 = zero, zero, zero, zero
        y0, y1, y2, y3 = zero, zero, zero, zero
        z0, z1, z2, z3 = zero, zero, zero, zero
        for j in range(len(inverse)):
            a, b_, c = x[j], y[j], z[j]
            x0 += r0[j] * a
            x1 += r1[j] * a
            x2 += r2[j] * a
            x3 += r3[j] * a
            y0 += r0[j] * b_
            y1 += r1[j] * b_
            y2 += r2[j] * b_
            y3 += r3[j] * b_
            z0 += r0[j] * c
            z1 += r1[j] * c
            z2 += r2[j] * c
            z3 += r3[j] * c
        for k, s in enumerate(((x0, y0, z0), (x1, y1, z1), (x2, y2, z2), (x3, y3, z3))):
            if i + k < n:
                out[i + k, 0], out[i + k, 1], out[i + k, 2] = s
