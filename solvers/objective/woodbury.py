"""Factorisation of the low-rank update H = S + V V' of a sparse S.

V has few columns. Sources: Woodbury 1950; Sherman and Morrison 1950. The update serves energies that couple all their
vertices by a few scalars c, as gas does by its volume:

    E = S(p) + phi(c(p)),   Hess E = sparse + V V'

    H^-1 = S^-1 - W C^-1 W',   W = S^-1 V,   C = I + V'W

S may be indefinite although H is not: for gas, S lacks the stiffness of the volume. By Sylvester's law of inertia,
applied to both elimination orders of [[S, V], [V', -I]], the number of negative eigenvalues of H is that of S minus
that of C. So if S has no Cholesky factor, a factorisation with negative pivots replaces it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import bsr_array, csc_array, csr_array
from scipy.sparse.linalg import splu
from springbench.solvers.model.step_problem import Energy, Positions
from springbench.solvers.objective.hessian_pattern import BlockMatrix


@runtime_checkable
class RankUpdateEnergy(Energy, Protocol):
    """An energy whose Hessian is sparse plus a low-rank update V V'."""

    def sparse_hessian(self, p: Positions) -> csr_array:
        """Return the Hessian minus V V' [N/m], shape (3n, 3n)."""
        ...

    def low_rank_columns(self, p: Positions) -> Positions:
        """Return V [(N/m)^(1/2)], one column for each scalar, shape (n, 3, r)."""
        ...


LinearSolve = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""The product with S^-1, (f, 3)."""


def sparse_part(energy: Energy, p: Positions) -> csr_array:
    """Return the Hessian of an energy without its low-rank part V V'.

    Args:
        energy: an energy; its whole Hessian is sparse unless it is a `RankUpdateEnergy`.
        p: positions (n, 3) [m].

    Returns:
        Sparse matrix (3n, 3n) [N/m].
    """
    return csr_array(energy.sparse_hessian(p) if isinstance(energy, RankUpdateEnergy) else energy.hessian(p))


def low_rank_columns(energies: Sequence[Energy], p: Positions) -> NDArray[np.float64] | None:
    """Return V of all energies, or None if there is none.

    Args:
        energies: energies; those that are no `RankUpdateEnergy` have no columns.
        p: positions (n, 3) [m].

    Returns:
        Columns of all energies (n, 3, r) [(N/m)^(1/2)].
    """
    found = [energy.low_rank_columns(p) for energy in energies if isinstance(energy, RankUpdateEnergy)]
    return np.concatenate(found, axis=2) if found else None


class Woodbury:
    """The factorisation of H = S + V V', with the interface of `BlockCholesky`.

    S is a block matrix.
    """

    def __init__(self, matrix: BlockMatrix, V: NDArray[np.float64]) -> None:
        """Create the factorisation for given columns; S follows with `factorise`.

        Args:
            matrix: block matrix over the free vertices, whose pattern and Cholesky factorisation S uses.
            V: columns (f, 3, r) [(N/m)^(1/2)].
        """
        self._matrix, self._V = matrix, V

    def factorise(self, values: NDArray[np.float64]) -> bool:
        """Factorise H from the blocks of S; return False if H is not positive definite."""
        cholesky, negative = self._matrix.factor, 0
        self._sparse_solve: LinearSolve = cholesky.solve
        if not cholesky.factorise(values):
            found = _factorise_indefinite(self._matrix.graph, values)
            if found is None:
                return False
            self._sparse_solve, negative = found
        V = self._V
        self._W = np.stack([self._sparse_solve(np.ascontiguousarray(V[:, :, k])) for k in range(V.shape[2])], axis=2)
        C = np.eye(V.shape[2]) + np.einsum("fik,fil->kl", V, self._W)
        size, self._eigenvectors = eigh(0.5 * (C + C.T)) if np.isfinite(C).all() else (np.zeros(len(C)), C)
        self._eigenvalues = size
        return bool(size.all()) and negative == np.count_nonzero(size < 0.0)

    def solve(self, b: Positions) -> Positions:
        """Return H^-1 b, both (f, 3)."""
        x = self._sparse_solve(b)
        along = self._eigenvectors @ ((self._eigenvectors.T @ np.einsum("fik,fi->k", self._V, x)) / self._eigenvalues)
        return x - self._W @ along

    def factorise_and_solve(self, values: NDArray[np.float64], b: Positions) -> Positions | None:
        """Factorise H from the blocks of S, and return H^-1 b.

        Args:
            values: blocks of S (b, 3, 3) [N/m].
            b: right-hand side (f, 3) [N].

        Returns:
            H^-1 b (f, 3) [m]; None if H is not positive definite.
        """
        return self.solve(b) if self.factorise(values) else None


def _factorise_indefinite(graph: csr_array, values: NDArray[np.float64]) -> tuple[LinearSolve, int] | None:
    """Return the product with S^-1 and the number of negative eigenvalues.

    The result is None if a pivot is zero or would have to be chosen off the diagonal.
    """
    S: Any = csc_array(bsr_array((values, graph.indices, graph.indptr), shape=(3 * graph.shape[0], 3 * graph.shape[1])))
    # Pivots on the diagonal have as many negative signs as S has negative eigenvalues.
    settings: Any = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    try:
        factor = splu(S, **settings)
    except (RuntimeError, ValueError):  # a pivot is zero, an entry is not finite
        return None
    if not np.array_equal(factor.perm_r, factor.perm_c):
        return None
    pivots = factor.U.diagonal()
    return (lambda b: factor.solve(b.ravel()).reshape(-1, 3)), int(np.count_nonzero(pivots < 0.0))
