"""Aggregation multigrid with several near-null-space vectors, as a preconditioner (MGPBD: Li et al. 2025).

    B  near null space (n, q): random vectors after sweeps of Gauss-Seidel's method for A x = 0
    P  B over each aggregate, orthonormalised: B = P B_coarse (Vanek, Mandel and Brezina 1996)
    A_coarse = P'AP            z = V-cycle(r), a fixed symmetric operator near A^-1

P is not smoothed, so that coarse matrices stay sparse. It depends on the pattern of A and on its slow-to-converge
modes, which change little as A does. One `Prolongation` therefore serves many matrices of one pattern, each
with its own `Cycle`. The method helps if few modes converge slowly. Sums are taken in one order, whatever the number
of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csr_array, dia_array

from solvers.linear.krylov import Iteration
from solvers.linear.multigrid import chebyshev_weights, largest_eigenvalue
from solvers.linear.multigrid_kernels import aggregate, gauss_seidel

Vector = NDArray[np.float64]

_COARSEST, _FULL = 400, 4000
"""Sizes up to which a level is factorised densely; the second one if its matrix has a quarter of all entries."""

_SLOW = 0.7
"""Size relative to the level above, beyond which a coarser level is not worthwhile."""

_WIDE = 0.5
"""Aggregates are merged until their vectors number at most this fraction of the unknowns."""

_STRENGTH, _DOMINANCE = 0.25, 10.0
_SHIFT = 1e-12
"""Shift of the coarsest matrix, relative to its diagonal, which makes its factorisation robust to round-off."""


def near_kernel(A: csr_array, components: int, sweeps: int) -> NDArray[np.float64]:
    """Compute near-null-space vectors by Gauss-Seidel sweeps on random ones.

    Args:
        A: matrix (n, n).
        components: number of vectors q.
        sweeps: number of sweeps.

    Returns:
        Vectors (n, q), each scaled to a largest entry of 1.
    """
    B = np.random.default_rng(0).uniform(size=(A.shape[0], components))  # always the same
    gauss_seidel(A.indptr, A.indices, A.data, B, sweeps)
    return scaled(B)


def coarsest(A: csr_array) -> bool:
    """Return whether A is factorised directly."""
    n = A.shape[0]
    return n <= _COARSEST or (n <= _FULL and 4 * A.nnz >= n * n)


def scaled(B: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the columns of B (n, q) divided by their largest entries; zero columns remain."""
    largest = np.abs(B).max(axis=0, initial=0.0)
    return B / np.where(largest > 0.0, largest, 1.0)


class Prolongation:
    """Prolongation matrices P of all levels, for A and for others with its pattern.

    Attributes:
        levels: P (n, coarse unknowns) of each level, the finest first.
    """

    def __init__(self, A: csr_array, B: NDArray[np.float64], smoothed: bool = False) -> None:
        self.levels: list[csr_array] = []
        nodes = np.arange(A.shape[0])
        while not coarsest(A):
            P, B, nodes = _prolonged(A, B, nodes)
            if not 0 < P.shape[1] <= _SLOW * P.shape[0]:
                break
            if smoothed:
                diagonal = A.diagonal()
                scale = 4.0 / 3.0 / largest_eigenvalue(A, diagonal) / diagonal
                P = csr_array(P - csr_array(dia_array((scale[None, :], np.array([0])), shape=A.shape)) @ (A @ P))
            self.levels.append(P)
            A = csr_array(P.T @ csr_array(A @ P))


def _prolonged(
    A: csr_array, B: NDArray[np.float64], nodes: NDArray[np.int64]
) -> tuple[csr_array, NDArray[np.float64], NDArray[np.int64]]:
    """Return P, B_coarse and the coarse nodes; unknowns are grouped by nodes (n,), which are aggregated as a whole."""
    owner = _aggregates(A, nodes, _WIDE * len(nodes) / max(1, B.shape[1]))
    count = int(owner.max(initial=-1)) + 1
    inside = np.flatnonzero(owner >= 0)
    order = inside[np.argsort(owner[inside], kind="stable")]
    size = np.bincount(owner[inside], minlength=count)
    first = np.cumsum(size) - size
    kept = np.minimum(size, B.shape[1])
    column = np.cumsum(kept) - kept
    total = int(kept.sum())
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
        np.repeat(np.arange(count), kept),
    )


def _aggregates(A: csr_array, nodes: NDArray[np.int64], most: float) -> NDArray[np.int64]:
    """Return the aggregate of each unknown (n,), -1 for none; they are aggregated again while there are too many."""
    owner, before = nodes, -1
    while True:
        condensed = _condensed(A, owner)
        of, count = aggregate(condensed.indptr, condensed.indices, condensed.data, _STRENGTH, _DOMINANCE)
        owner = np.where(owner >= 0, of[owner], -1)
        if count <= most or count == before:
            return owner
        before = count


def _condensed(A: csr_array, nodes: NDArray[np.int64]) -> csr_array:
    """Return the Frobenius norms of A's blocks by nodes, -1 for none; A itself if each unknown is a node."""
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
class _Level:
    """A level above the coarsest: matrix, prolongation, restriction and smoother."""

    A: csr_array
    P: csr_array
    R: csr_array
    inverse_diagonal: Vector
    weights: list[tuple[np.float32, np.float32]]

    @classmethod
    def of(cls, A: csr_array, P: csr_array) -> _Level:
        diagonal = A.diagonal()
        return cls(A, P, csr_array(P.T), 1.0 / diagonal, chebyshev_weights(largest_eigenvalue(A, diagonal)))

    def smoothed(self, b: Vector, x: Vector | None = None) -> Vector:
        """Apply the Chebyshev smoother to A x = b, starting at x or at zero."""
        step = np.zeros_like(b)
        for keep, scale in self.weights:
            left = b if x is None else b - self.A @ x
            step = keep * step + scale * self.inverse_diagonal * left
            x = step if x is None else x + step
        assert x is not None
        return x


class Cycle:
    """V-cycle for A, with the prolongations of this or an earlier matrix.

    Attributes:
        sizes: unknowns of each level.
        bytes: bytes of the matrices that a cycle reads.
    """

    def __init__(self, A: csr_array, prolongation: Prolongation) -> None:
        self._levels: list[_Level] = []
        for P in prolongation.levels:
            self._levels.append(_Level.of(A, P))
            A = csr_array(self._levels[-1].R @ csr_array(A @ P))
        self.sizes = [*(level.A.shape[0] for level in self._levels), A.shape[0]]
        self.bytes = 12 * sum(4 * level.A.nnz + 2 * level.P.nnz for level in self._levels)
        self._factor = None
        if coarsest(A):
            dense = A.toarray()
            self._factor = cho_factor(dense + _SHIFT * np.diag(np.diag(dense)), lower=True)
            self.bytes += 8 * A.shape[0] ** 2
        else:  # nothing there can be gathered: each unknown is its own diagonal's, nearly
            self._last = _Level.of(A, A)
            self.bytes += 12 * A.nnz

    def apply(self, r: Vector) -> Vector:
        """Return z near A^-1 r, (n,)."""
        return self._cycled(0, r)

    def _cycled(self, depth: int, b: Vector) -> Vector:
        if depth == len(self._levels):
            return self._last.smoothed(b) if self._factor is None else cho_solve(self._factor, b)
        level = self._levels[depth]
        x = level.smoothed(b)
        x = x + level.P @ self._cycled(depth + 1, level.R @ (b - level.A @ x))
        return level.smoothed(b, x)


class Solving(Iteration):
    """Preconditioned conjugate gradients for A x = b from zero.

    The iteration ends once |b - A x| is at most rtol |b|.
    """

    def __init__(self, A: csr_array, cycle: Cycle, b: Vector, tolerance: float) -> None:
        self._A, self._cycle, self._limit = A, cycle, tolerance * norm(b)
        self.x, self._r = np.zeros_like(b), b.copy()
        self._p = np.zeros_like(b)

    def solve(self, most: int) -> int:
        """Iterate; `x` contains the solution.

        Args:
            most: maximum number of iterations.

        Returns:
            Number of iterations.
        """
        return self.iterate(self._preconditioned(), most)[0]

    def _preconditioned(self) -> float:
        self._z = self._cycle.apply(self._r)
        return _dot(self._r, self._z)

    def turn(self, product: float, before: float) -> float:
        """Update the search direction p; return p'Ap."""
        self._p = self._z + (product / before) * self._p
        self._image = self._A @ self._p
        return _dot(self._p, self._image)

    def go(self, product: float, curvature: float) -> float:
        """Update x and r, and apply the preconditioner; return r'z."""
        self.x += (product / curvature) * self._p
        self._r -= (product / curvature) * self._image
        return self._preconditioned()

    def convex(self, curvature: float) -> bool:
        """Return whether the curvature is positive; round-off may make it zero."""
        return curvature > 0.0

    def near(self, product: float) -> bool:
        """Return whether the residual norm is within the tolerance."""
        return norm(self._r) <= self._limit or not product > 0.0


def norm(x: Vector) -> float:
    """Return |x|, summed in a fixed order."""
    return float(np.sqrt(_dot(x, x)))


def _dot(x: Vector, y: Vector) -> float:
    return float(np.einsum("i,i->", x, y))
