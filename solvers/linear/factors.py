"""Factorisations of the constant matrix Q, done once and then solved with three right-hand sides at a time.

Each is a class made from Q, with `solve(b, out)` (Q out = b, both (n, 3), C-contiguous) and `nonzeros`, the stored
entries of its factor (None where the library does not tell).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from solvers.problem import NotPositiveDefinite, Positions, Unsupported

_REASON = (
    "Q = A'KA + M/dt^2 + w C'C is not positive definite in floating point: its stiffnesses, masses and "
    "pin weights lie too far apart, or one of them is negative or not finite"
)


class Factor(Protocol):
    """A factorised matrix."""

    nonzeros: int | None

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b, shape (n, 3), to `out`; b is left as it is and must not be `out`."""
        ...


class DenseCholesky:
    """LAPACK's Cholesky factorisation of a dense Q."""

    def __init__(self, Q: np.ndarray) -> None:
        """Raises NotPositiveDefinite."""
        try:
            self._factor = cho_factor(Q, lower=True)
        except (LinAlgError, ValueError) as error:
            raise NotPositiveDefinite(_REASON) from error
        self.nonzeros: int | None = len(Q) * (len(Q) + 1) // 2

    def solve(self, b: Positions, out: Positions) -> None:
        """Q out = b."""
        out[:] = cho_solve(self._factor, b, check_finite=False)


class SparseLU:
    """SuperLU on a symmetric matrix: a minimum degree order of Q'+Q, pivots on the diagonal."""

    def __init__(self, Q: csr_array) -> None:
        """Raises NotPositiveDefinite."""
        try:
            self._factor = splu(
                csc_array(Q),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise NotPositiveDefinite(_REASON) from error
        # With pivots on the diagonal Q = P'LUP is L D L', so Q is positive definite if D is positive.
        if not (self._factor.U.diagonal() > 0.0).all():
            raise NotPositiveDefinite(_REASON)
        self.nonzeros: int | None = self._factor.L.nnz

    def solve(self, b: Positions, out: Positions) -> None:
        """Q out = b."""
        out[:] = self._factor.solve(b)


class SimplicialCholesky:
    """CHOLMOD's simplicial Cholesky factorisation, through cholespy, which has wheels for x86-64 alone."""

    nonzeros: int | None = None

    def __init__(self, Q: csr_array) -> None:
        """Raises Unsupported where cholespy is not installed, NotPositiveDefinite."""
        try:
            from cholespy import CholeskySolverD, MatrixType  # pyright: ignore[reportAttributeAccessIssue]
        except ImportError as error:
            raise Unsupported(
                "cholespy is not installed, for it has no wheel for this machine; leave `linear` out"
            ) from error
        if not np.isfinite(Q.data).all():
            raise NotPositiveDefinite(_REASON)
        pointers, columns = Q.indptr.astype(np.int32), Q.indices.astype(np.int32)
        try:
            self._factor = CholeskySolverD(len(pointers) - 1, pointers, columns, Q.data, MatrixType.CSR)
        except ValueError as error:
            raise NotPositiveDefinite(_REASON) from error

    def solve(self, b: Positions, out: Positions) -> None:
        """Q out = b."""
        self._factor.solve(b, out)
