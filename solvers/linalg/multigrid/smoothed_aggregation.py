"""Smoothed aggregation multigrid (Vanek, Mandel and Brezina 1996), as a preconditioner for scalar networks.

    T  vertices to their aggregates, constant in each      P = (I - 4/(3 l) D^-1 A) T,  l = lambda_max(D^-1 A)
    A_coarse = P'AP                                        z = V-cycle(r), a fixed symmetric operator near Q^-1

The smoother is a Chebyshev polynomial in D^-1 A (Adams et al. 2003), the same before and after the coarse correction.
It consists of matrix products only, so that the order of summation never depends on threads. The cycle is stored and
evaluated in float32, since memory traffic limits it; the surrounding iteration provides the accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, dia_array
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.matrix_errors import build_definiteness_error
from springbench.solvers.linalg.multigrid import multigrid_kernels as kernels
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.step_problem import NotPositiveDefinite

_MAX_COARSE_SIZE = 1500
"""Size up to which a level is factorised: its solve then costs less than 2 % of a cycle."""

STRENGTH_THRESHOLD, DOMINANCE_RATIO = 0.25, 10.0
"""Parameters `strength` and `dominance` of `build_aggregates`, of both hierarchies."""

MAX_COARSENING_RATIO = 0.7
"""Size relative to the level above, beyond which a coarser level is not worthwhile."""

_MIN_FILTERED_DIAGONAL = 0.05
"""Least diagonal of the matrix that smooths prolongations, relative to that of A. Lumping of weak entries leaves a
positive diagonal for springs; the bound ensures it for other matrices, and is too small to matter for springs."""

_POWER_ITERATIONS, _EIGENVALUE_MARGIN = 20, 1.1
"""Iterations of the power method, and the factor on its estimate. It approaches the largest eigenvalue from below, but
the smoother would amplify the modes above the estimate."""

_CHEBYSHEV_DEGREE = 2
_SMOOTHED_FRACTION = 0.25
"""The smoother damps the eigenvalues of D^-1 A above this fraction of the largest one."""


class CompressedRows(NamedTuple):
    """A sparse matrix in compressed rows, with float32 entries."""

    pointers: NDArray[np.int64]
    columns: NDArray[np.int32]
    values: NDArray[np.float32]

    @classmethod
    def from_matrix(cls, matrix: csr_array) -> CompressedRows:
        """Convert a matrix, with its entries rounded."""
        return cls(
            np.asarray(matrix.indptr, np.int64), np.asarray(matrix.indices, np.int32), matrix.data.astype(np.float32)
        )


@dataclass(frozen=True, slots=True, eq=False)
class MultigridLevel:
    """A level above the coarsest: matrix, prolongation P, restriction R, smoother, and vectors (n, 4)."""

    A: CompressedRows
    P: CompressedRows
    R: CompressedRows
    inverse_diagonal: NDArray[np.float32]
    smoother_weights: list[tuple[np.float32, np.float32]]
    b: NDArray[np.float32]
    x: NDArray[np.float32]
    scratch: NDArray[np.float32]
    smoother_step: NDArray[np.float32]


class Multigrid:
    """A V-cycle for Q: a linear operator, symmetric and positive definite up to rounding.

    It maps the residual r to the correction z.

    Attributes:
        nonzeros: entries of all levels' matrices, including the coarsest level's factor.
        level_sizes: vertices of each level.
    """

    def __init__(self, Q: csr_array) -> None:
        """Build all levels; raise NotPositiveDefinite if the coarsest one is not positive definite."""
        self._levels: list[MultigridLevel] = []
        self.level_sizes = [len(Q.indptr) - 1]
        self.nonzeros = 0
        A = Q
        while self.level_sizes[-1] > _MAX_COARSE_SIZE:
            level, coarse = _build_level(A)
            if len(coarse.indptr) - 1 > MAX_COARSENING_RATIO * self.level_sizes[-1]:
                break
            self._levels.append(level)
            self.nonzeros += A.nnz + 2 * len(level.P.values)
            self.level_sizes.append(len(coarse.indptr) - 1)
            A = coarse
        try:
            self._factor = SupernodalCholesky(A)
        except NotPositiveDefinite as error:
            raise build_definiteness_error(
                place=f"level {len(self._levels)} of multigrid, of {self.level_sizes[-1]} vertices"
            ) from error
        self.nonzeros += self._factor.nonzeros or 0
        self._coarse_vectors = (
            np.zeros((self.level_sizes[-1], 4), np.float32),
            np.zeros((self.level_sizes[-1], 4), np.float32),
        )
        self._coarse_float64 = np.zeros((self.level_sizes[-1], 3)), np.zeros((self.level_sizes[-1], 3))

    @property
    def right_hand_side(self) -> NDArray[np.float32]:
        """Input r of `apply_cycle`, (n, 4), with a zero last column."""
        return self._levels[0].b if self._levels else self._coarse_vectors[0]

    def apply_cycle(self) -> NDArray[np.float32]:
        """Return z near Q^-1 r, (n, 4); the next call overwrites it."""
        return self._run_v_cycle(0)

    def _run_v_cycle(self, depth: int) -> NDArray[np.float32]:
        if depth == len(self._levels):
            (b, x), (b64, x64) = self._coarse_vectors, self._coarse_float64
            b64[:] = b[:, :3]
            self._factor.solve(b64, x64)
            x[:, :3] = x64
            return x
        level = self._levels[depth]
        b, x, other, step = level.b, level.x, level.scratch, level.smoother_step
        (_, scale), *more = level.smoother_weights
        kernels.chebyshev_first_step(level.inverse_diagonal, scale, b, step, x)
        for keep, scale in more:
            kernels.chebyshev_step(*level.A, level.inverse_diagonal, keep, scale, b, step, x, other)
            x, other = other, x
        kernels.compute_linear_residual(*level.A, b, x, other)
        below = self._levels[depth + 1].b if depth + 1 < len(self._levels) else self._coarse_vectors[0]
        kernels.multiply_sparse(*level.R, other, below)
        kernels.add_sparse_product(*level.P, self._run_v_cycle(depth + 1), x)
        for keep, scale in level.smoother_weights:
            kernels.chebyshev_step(*level.A, level.inverse_diagonal, keep, scale, b, step, x, other)
            x, other = other, x
        return x


def _build_level(A: csr_array) -> tuple[MultigridLevel, csr_array]:
    """Return a level and the matrix of the next one."""
    n = len(A.indptr) - 1
    of, count = kernels.build_aggregates(A.indptr, A.indices, A.data, STRENGTH_THRESHOLD, DOMINANCE_RATIO)
    diagonal = np.asarray(A.diagonal(), np.float64)
    largest = estimate_largest_eigenvalue(A, diagonal)
    inside = np.flatnonzero(of >= 0)
    start = np.concatenate([[0], np.cumsum(of >= 0)])
    T = csr_array((np.ones(len(inside)), of[inside], start.astype(A.indptr.dtype)), shape=(n, count))
    F = csr_array(
        (kernels.filter_weak_entries(A.indptr, A.indices, A.data, STRENGTH_THRESHOLD), A.indices, A.indptr),
        shape=A.shape,
    )
    D = dia_array(
        (1.0 / np.maximum(F.diagonal(), _MIN_FILTERED_DIAGONAL * diagonal)[None, :], np.array([0])), shape=(n, n)
    )
    P = system_matrix_assembly.drop_zeros(csr_array(T - (4.0 / 3.0 / largest) * (D @ (F @ T))))
    R = csr_array(P.T)
    coarse = csr_array(R @ csr_array(A @ P))
    vectors = [np.zeros((n, 4), np.float32) for _ in range(4)]
    level = MultigridLevel(
        CompressedRows.from_matrix(A),
        CompressedRows.from_matrix(P),
        CompressedRows.from_matrix(R),
        (1.0 / diagonal).astype(np.float32),
        compute_chebyshev_weights(largest),
        *vectors,
    )
    return level, coarse


def estimate_largest_eigenvalue(A: csr_array, diagonal: NDArray[np.float64]) -> float:
    """Estimate the largest eigenvalue of D^-1 A.

    Args:
        A: matrix (n, n).
        diagonal: D, (n,).

    Returns:
        Estimate by the power method, at most Gershgorin's bound; 0 without rows.
    """
    if not len(diagonal):
        return 0.0
    bound = float(((abs(A) @ np.ones(len(diagonal))) / diagonal).max())
    v = np.random.default_rng(0).normal(size=len(diagonal))  # contains all modes, and is the same in each call
    for _ in range(_POWER_ITERATIONS):
        v = (A @ v) / diagonal
        v /= np.linalg.norm(v)
    return min(bound, _EIGENVALUE_MARGIN * float(v @ (A @ v) / (v @ (diagonal * v))))


def compute_chebyshev_weights(largest: float) -> list[tuple[np.float32, np.float32]]:
    """Return (momentum, scale) of each Chebyshev step, for eigenvalues from _SMOOTHED_FRACTION to 1 times `largest`."""
    centre, half = 0.5 * (1.0 + _SMOOTHED_FRACTION) * largest, 0.5 * (1.0 - _SMOOTHED_FRACTION) * largest
    rho = half / centre
    weights = [(0.0, 1.0 / centre)]
    for _ in range(_CHEBYSHEV_DEGREE - 1):
        following = 1.0 / (2.0 * centre / half - rho)
        weights.append((following * rho, 2.0 * following / half))
        rho = following
    return [(np.float32(keep), np.float32(scale)) for keep, scale in weights]
