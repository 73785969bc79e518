"""Aggregation multigrid with several near-null-space vectors, as a preconditioner (MGPBD: Li et al. 2025).

    B  near null space (n, q): random vectors after sweeps of Gauss-Seidel's method for A x = 0
    P  B over each aggregate, orthonormalised: B = P B_coarse (Vanek, Mandel and Brezina 1996)
    A_coarse = P'AP            z = V-cycle(r), a fixed symmetric operator near A^-1

P is not smoothed by default, so that coarse matrices stay sparse. It depends on the pattern of A and on its slow
modes, which change little as A does. One `ProlongationHierarchy` therefore serves many matrices of one pattern, each
with its own `VCycle`. The method helps if few modes converge slowly. Sums are taken in one order, whatever the number
of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array, dia_array
from springbench.solvers.linalg.krylov import ConjugateGradientIteration
from springbench.solvers.linalg.multigrid.multigrid_kernels import build_aggregates, sweep_gauss_seidel
from springbench.solvers.linalg.multigrid.smoothed_aggregation import (
    DOMINANCE_RATIO,
    MAX_COARSENING_RATIO,
    STRENGTH_THRESHOLD,
    compute_chebyshev_weights,
    estimate_largest_eigenvalue,
)

FloatVector = NDArray[np.float64]

_MAX_COARSE_SIZE, _MAX_DENSE_COARSE_SIZE = 400, 4000
"""Sizes up to which a level is factorised densely; the second one if its matrix has a quarter of all entries."""

_MAX_UNKNOWN_FRACTION = 0.5
"""Aggregates are merged until their vectors number at most this fraction of the unknowns."""

_COARSE_DIAGONAL_SHIFT = 1e-12
"""Shift of the coarsest matrix, relative to its diagonal, which makes its factorisation robust to round-off."""


def compute_near_nullspace(A: csr_array, num_components: int, num_sweeps: int) -> NDArray[np.float64]:
    """Compute near-null-space vectors by Gauss-Seidel sweeps on random ones.

    Args:
        A: matrix (n, n).
        num_components: number of vectors q.
        num_sweeps: number of sweeps.

    Returns:
        Vectors (n, q), each scaled to a largest entry of 1.
    """
    B = np.random.default_rng(0).uniform(size=(A.shape[0], num_components))  # the same vectors in each call
    sweep_gauss_seidel(A.indptr, A.indices, A.data, B, num_sweeps)
    return normalise_columns(B)


def is_coarsest_level(A: csr_array) -> bool:
    """Return whether A is factorised directly."""
    n = A.shape[0]
    return n <= _MAX_COARSE_SIZE or (n <= _MAX_DENSE_COARSE_SIZE and 4 * A.nnz >= n * n)


def normalise_columns(B: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the columns of B (n, q) divided by their largest entries; zero columns remain."""
    largest = np.abs(B).max(axis=0, initial=0.0)
    return B / np.where(largest > 0.0, largest, 1.0)


class ProlongationHierarchy:
    """Prolongation matrices P of all levels, for A and for others with its pattern.

    Attributes:
        prolongators: P (n, coarse unknowns) of each level, the finest first.
    """

    def __init__(self, A: csr_array, B: NDArray[np.float64], smooth_prolongators: bool = False) -> None:
        """Build the prolongation matrices.

        Args:
            A: matrix (n, n).
            B: near-null-space vectors (n, q).
            smooth_prolongators: whether each P is smoothed by a damped Jacobi step.
        """
        self.prolongators: list[csr_array] = []
        nodes = np.arange(A.shape[0])
        while not is_coarsest_level(A):
            P, B, nodes = _build_prolongator(A, B, nodes)
            if not 0 < P.shape[1] <= MAX_COARSENING_RATIO * P.shape[0]:
                break
            if smooth_prolongators:
                diagonal = A.diagonal()
                scale = 4.0 / 3.0 / estimate_largest_eigenvalue(A, diagonal) / diagonal
                P = csr_array(P - csr_array(dia_array((scale[None, :], np.array([0])), shape=A.shape)) @ (A @ P))
            self.prolongators.append(P)
            A = csr_array(P.T @ csr_array(A @ P))


def _build_prolongator(
    A: csr_array, B: NDArray[np.float64], nodes: NDArray[np.int64]
) -> tuple[csr_array, NDArray[np.float64], NDArray[np.int64]]:
    """Return P, B_coarse and the coarse nodes.

    Unknowns are grouped by nodes (n,), which are aggregated as a whole.
    """
    owner = _aggregate_unknowns(A, nodes, _MAX_UNKNOWN_FRACTION * len(nodes) / max(1, B.shape[1]))
    count = int(owner.max(initial=-1)) + 1
    inside = np.flatnonzero(owner >= 0)
    order = inside[np.argsort(owner[inside], kind="stable")]
    size = np.bincount(owner[inside], minlength=count)
    first = np.cumsum(size) - size
    num_columns = np.minimum(size, B.shape[1])
    column = np.cumsum(num_columns) - num_columns
    total = int(num_columns.sum())
    coarse, parts = np.zeros((total, B.shape[1])), []
    for s in np.unique(size):  # aggregates of one size at a time
        which = np.flatnonzero(size == s)
        rows = order[first[which][:, None] + np.arange(s)]
        Q, R = np.linalg.qr(B[rows])
        columns = column[which][:, None] + np.arange(Q.shape[2])
        coarse[columns] = R
        parts.append([np.ravel(x) for x in np.broadcast_arrays(rows[:, :, None], columns[:, None, :], Q)])
    if not parts:
        return csr_array((len(nodes), 0)), coarse, np.empty(0, np.int64)
    row, col, entries = (np.concatenate(x) for x in zip(*parts, strict=True))
    return (
        csr_array(coo_array((entries, (row, col)), shape=(len(nodes), total))),
        coarse,
        np.repeat(np.arange(count), num_columns),
    )


def _aggregate_unknowns(A: csr_array, nodes: NDArray[np.int64], max_aggregates: float) -> NDArray[np.int64]:
    """Return the aggregate of each unknown (n,), -1 for none.

    Aggregates are aggregated again while there are too many.
    """
    owner, before = nodes, -1
    while True:
        condensed = _condense_blocks(A, owner)
        of, count = build_aggregates(
            condensed.indptr, condensed.indices, condensed.data, STRENGTH_THRESHOLD, DOMINANCE_RATIO
        )
        owner = np.where(owner >= 0, of[owner], -1)
        if count <= max_aggregates or count == before:
            return owner
        before = count


def _condense_blocks(A: csr_array, nodes: NDArray[np.int64]) -> csr_array:
    """Return the Frobenius norms of A's blocks by nodes (n,), -1 for none.

    The result is A itself if each unknown is a node.
    """
    n, count = len(nodes), int(nodes.max(initial=-1)) + 1
    if count == n:
        return A
    inside = np.flatnonzero(nodes >= 0)
    start = np.concatenate([[0], np.cumsum(nodes >= 0)])
    G = csr_array((np.ones(len(inside)), nodes[inside], start), shape=(n, count))
    squared = csr_array((A.data**2, A.indices, A.indptr), shape=A.shape)
    blocks = csr_array(G.T @ csr_array(squared @ G))
    return csr_array((np.sqrt(blocks.data), blocks.indices, blocks.indptr), shape=blocks.shape)


@dataclass(frozen=True, slots=True, eq=False)
class _NearNullspaceLevel:
    """A level above the coarsest: matrix, prolongation, restriction and smoother."""

    A: csr_array
    P: csr_array
    R: csr_array
    inverse_diagonal: FloatVector
    smoother_weights: list[tuple[np.float32, np.float32]]

    @classmethod
    def from_matrices(cls, A: csr_array, P: csr_array) -> _NearNullspaceLevel:
        diagonal = A.diagonal()
        return cls(
            A, P, csr_array(P.T), 1.0 / diagonal, compute_chebyshev_weights(estimate_largest_eigenvalue(A, diagonal))
        )

    def apply_smoother(self, b: FloatVector, x: FloatVector | None = None) -> FloatVector:
        """Apply the Chebyshev smoother to A x = b, starting at x or at zero."""
        step = np.zeros_like(b)
        for keep, scale in self.smoother_weights:
            left = b if x is None else b - self.A @ x
            step = keep * step + scale * self.inverse_diagonal * left
            x = step if x is None else x + step
        assert x is not None
        return x


class VCycle:
    """V-cycle for A, with the prolongations of this or an earlier matrix.

    Attributes:
        level_sizes: unknowns of each level.
        matrix_bytes: bytes of the matrices that a cycle reads.
    """

    def __init__(self, A: csr_array, prolongation: ProlongationHierarchy) -> None:
        """Build the levels.

        Args:
            A: matrix (n, n).
            prolongation: prolongation matrices of all levels, for the pattern of A.
        """
        self._levels: list[_NearNullspaceLevel] = []
        for P in prolongation.prolongators:
            self._levels.append(_NearNullspaceLevel.from_matrices(A, P))
            A = csr_array(self._levels[-1].R @ csr_array(A @ P))
        self.level_sizes = [*(level.A.shape[0] for level in self._levels), A.shape[0]]
        self.matrix_bytes = 12 * sum(4 * level.A.nnz + 2 * level.P.nnz for level in self._levels)
        self._factor = None
        if is_coarsest_level(A):
            dense = A.toarray()
            self._factor = cho_factor(dense + _COARSE_DIAGONAL_SHIFT * np.diag(np.diag(dense)), lower=True)
            self.matrix_bytes += 8 * A.shape[0] ** 2
        else:  # A cannot be coarsened further
            self._coarsest_smoother = _NearNullspaceLevel.from_matrices(A, A)
            self.matrix_bytes += 12 * A.nnz

    def apply_cycle(self, r: FloatVector) -> FloatVector:
        """Return z near A^-1 r, (n,)."""
        return self._run_v_cycle(0, r)

    def _run_v_cycle(self, depth: int, b: FloatVector) -> FloatVector:
        if depth == len(self._levels):
            return self._coarsest_smoother.apply_smoother(b) if self._factor is None else cho_solve(self._factor, b)
        level = self._levels[depth]
        x = level.apply_smoother(b)
        x = x + level.P @ self._run_v_cycle(depth + 1, level.R @ (b - level.A @ x))
        return level.apply_smoother(b, x)


class PreconditionedSolve(ConjugateGradientIteration):
    """Preconditioned conjugate gradients for A x = b from zero.

    The iteration ends once |b - A x| is at most rtol |b|.
    """

    def __init__(self, A: csr_array, cycle: VCycle, b: FloatVector, rtol: float) -> None:
        """Prepare the solve.

        Args:
            A: symmetric positive definite matrix (n, n).
            cycle: V-cycle for A.
            b: right-hand side (n,).
            rtol: tolerance of the residual relative to |b|.
        """
        self._A, self._cycle, self._atol = A, cycle, rtol * ordered_norm(b)
        self.x, self._r = np.zeros_like(b), b.copy()
        self._p = np.zeros_like(b)

    def solve(self, max_iterations: int) -> int:
        """Iterate; `x` contains the solution.

        Args:
            max_iterations: maximum number of iterations.

        Returns:
            Number of iterations.
        """
        return self.run_iterations(self._apply_preconditioner(), max_iterations)[0]

    def _apply_preconditioner(self) -> float:
        self._z = self._cycle.apply_cycle(self._r)
        return _ordered_dot(self._r, self._z)

    def update_direction(self, product: float, previous_product: float) -> float:
        """Update the search direction p; return p'Ap.

        Args:
            product: r'z of the iterate.
            previous_product: r'z of the iterate before; infinite at first.
        """
        self._p = self._z + (product / previous_product) * self._p
        self._image = self._A @ self._p
        return _ordered_dot(self._p, self._image)

    def update_iterate(self, product: float, curvature: float) -> float:
        """Update x and r, and apply the preconditioner; return r'z.

        Args:
            product: r'z before the update.
            curvature: p'Ap of the current direction.
        """
        self.x += (product / curvature) * self._p
        self._r -= (product / curvature) * self._image
        return self._apply_preconditioner()

    def is_convex(self, curvature: float) -> bool:
        """Return whether the curvature is positive; round-off may make it zero."""
        return curvature > 0.0

    def is_converged(self, product: float) -> bool:
        """Return whether the residual norm is within the tolerance."""
        return ordered_norm(self._r) <= self._atol or not product > 0.0


def ordered_norm(x: FloatVector) -> float:
    """Return |x|, summed in a fixed order."""
    return float(np.sqrt(_ordered_dot(x, x)))


def _ordered_dot(x: FloatVector, y: FloatVector) -> float:
    return float(np.einsum("i,i->", x, y))
