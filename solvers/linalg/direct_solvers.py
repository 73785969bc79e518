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
from springbench.solvers.linalg.matrix_errors import build_definiteness_error, require_finite_rows
from springbench.solvers.model.step_problem import Positions, Unsupported


class LinearSolver(Protocol):
    """Interface of a linear solver of a fixed matrix.

    Example:
        >>> class Diagonal:
        ...     nonzeros = None
        ...     def __init__(self, Q):
        ...         self.diagonal = Q.diagonal()
        ...     def solve(self, b, out):
        ...         out[:] = b / self.diagonal[:, None]

        >>> import numpy as np
        >>> factor: springbench.LinearSolver = Diagonal(4.0 * np.eye(1))
        >>> solution = np.empty((1, 3))
        >>> factor.solve(np.ones((1, 3)), solution)
        >>> solution.tolist()
        [[0.25, 0.25, 0.25]]
    """

    nonzeros: int | None

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3), not modified.
            out: solution (n, 3), not `b` itself.
        """
        ...


class DenseCholesky:
    """Dense Cholesky factorisation of Q by LAPACK.

    Example:
        >>> import numpy as np
        >>> solution = np.empty((1, 3))
        >>> springbench.DenseCholesky(np.array([[4.0]])).solve(np.ones((1, 3)), solution)
        >>> solution.tolist()
        [[0.25, 0.25, 0.25]]
    """

    def __init__(self, Q: np.ndarray) -> None:
        """Factorise Q (n, n); raise NotPositiveDefinite if a pivot is not positive."""
        try:
            self._factor = cho_factor(Q, lower=True)
        except (LinAlgError, ValueError) as error:
            raise build_definiteness_error() from error
        self.nonzeros: int | None = len(Q) * (len(Q) + 1) // 2

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3); they are not checked for NaN or infinity.
            out: solution (n, 3).
        """
        out[:] = cho_solve(self._factor, b, check_finite=False)


class SparseLU:
    """SuperLU factorisation of a symmetric Q: minimum degree order of Q'+Q, diagonal pivots.

    Example:
        >>> import numpy as np
        >>> from scipy.sparse import csr_array
        >>> solution = np.empty((1, 3))
        >>> springbench.SparseLU(csr_array(np.array([[4.0]]))).solve(np.ones((1, 3)), solution)
        >>> solution.tolist()
        [[0.25, 0.25, 0.25]]
    """

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
            raise build_definiteness_error() from error
        # With diagonal pivots Q = P'LUP is L D L', so that Q is positive definite if D is positive.
        if not (self._factor.U.diagonal() > 0.0).all():
            raise build_definiteness_error()
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
                f"linear_solver: cholespy cannot be imported ({error}); install cholespy, or leave linear_solver out"
            ) from error
        require_finite_rows(Q)
        pointers, columns = Q.indptr.astype(np.int32), Q.indices.astype(np.int32)
        try:
            self._factor = CholeskySolverD(len(pointers) - 1, pointers, columns, Q.data, MatrixType.CSR)
        except ValueError as error:
            raise build_definiteness_error() from error

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3), C-contiguous.
            out: solution (n, 3), C-contiguous.
        """
        self._factor.solve(b, out)
