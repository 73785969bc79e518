"""Direct solvers of the constant matrix Q, with three right-hand sides at a time.

Each class is constructed from Q. `solve(b, out)` solves Q out = b, both (n, 3) and C-contiguous; `nonzeros` is the
number of stored entries of the factor, None where the library does not provide it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu
from springbench.solvers.model.step_problem import NotPositiveDefinite, Positions, Unsupported

_NOT_DEFINITE_MESSAGE = (
    "Q = A'KA + M/dt^2 + w C'C is not positive definite in floating point: its stiffnesses, masses and "
    "pin weights lie too far apart, or one of them is negative or not finite"
)


class LinearSolver(Protocol):
    """Interface of a linear solver of a fixed matrix."""

    nonzeros: int | None

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3), not modified.
            out: solution (n, 3), not `b` itself.
        """
        ...


class DenseCholesky:
    """Dense Cholesky factorisation of Q by LAPACK."""

    def __init__(self, Q: np.ndarray) -> None:
        """Factorise Q (n, n); raise NotPositiveDefinite if a pivot is not positive."""
        try:
            self._factor = cho_factor(Q, lower=True)
        except (LinAlgError, ValueError) as error:
            raise NotPositiveDefinite(_NOT_DEFINITE_MESSAGE) from error
        self.nonzeros: int | None = len(Q) * (len(Q) + 1) // 2

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3); they are not checked for NaN or infinity.
            out: solution (n, 3).
        """
        out[:] = cho_solve(self._factor, b, check_finite=False)


class SparseLU:
    """SuperLU factorisation of a symmetric Q: minimum degree order of Q'+Q, diagonal pivots."""

    def __init__(self, Q: csr_array) -> None:
        """Factorise Q (n, n); raise NotPositiveDefinite if a pivot is not positive."""
        try:
            self._factor = splu(
                csc_array(Q),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError as error:
            raise NotPositiveDefinite(_NOT_DEFINITE_MESSAGE) from error
        # With diagonal pivots Q = P'LUP is L D L', so that Q is positive definite if D is positive.
        if not (self._factor.U.diagonal() > 0.0).all():
            raise NotPositiveDefinite(_NOT_DEFINITE_MESSAGE)
        self.nonzeros: int | None = self._factor.L.nnz

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3), not modified.
            out: solution (n, 3).
        """
        out[:] = self._factor.solve(b)


class SimplicialCholesky:
    """Simplicial Cholesky factorisation by CHOLMOD through cholespy, which has wheels for x86-64 only."""

    nonzeros: int | None = None

    def __init__(self, Q: csr_array) -> None:
        """Factorise Q (n, n); raise Unsupported without cholespy, NotPositiveDefinite if a pivot is not positive."""
        try:
            from cholespy import CholeskySolverD, MatrixType  # pyright: ignore[reportAttributeAccessIssue]
        except ImportError as error:
            raise Unsupported(
                "cholespy is not installed, for it has no wheel for this machine; leave `linear_solver` out"
            ) from error
        if not np.isfinite(Q.data).all():
            raise NotPositiveDefinite(_NOT_DEFINITE_MESSAGE)
        pointers, columns = Q.indptr.astype(np.int32), Q.indices.astype(np.int32)
        try:
            self._factor = CholeskySolverD(len(pointers) - 1, pointers, columns, Q.data, MatrixType.CSR)
        except ValueError as error:
            raise NotPositiveDefinite(_NOT_DEFINITE_MESSAGE) from error

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3), C-contiguous.
            out: solution (n, 3), C-contiguous.
        """
        self._factor.solve(b, out)
