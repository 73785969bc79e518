"""Conjugate gradients preconditioned by multigrid, for systems whose factor does not fit in memory.

    z = V-cycle(r),  p = z + beta p,  x += alpha p,  r -= alpha Q p

Source: Hestenes and Stiefel 1952. Three right-hand sides are solved in lockstep and share each pass over the matrices.
z approximates the error of x itself, whatever the stiffness of a row. The iteration ends when no entry of z exceeds
CG_RTOL times the largest one of x.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.linalg.krylov import NEGATIVE_CURVATURE, ConjugateGradientIteration
from springbench.solvers.linalg.matrix_errors import build_definiteness_error, require_finite_rows
from springbench.solvers.linalg.multigrid import multigrid_kernels as kernels
from springbench.solvers.linalg.multigrid.smoothed_aggregation import Multigrid
from springbench.solvers.model.step_problem import Positions, Unsupported

CG_RTOL = 1e-12
"""Largest correction, relative to the largest entry of x, at which the iteration ends.

Positions distinct at 1e-9 of a scene's size remain so at a distance of a hundred sizes from the origin, and after
some iterations. Each iteration gains a constant number of digits, so that two more digits cost two iterations in
ten."""

_MAX_ITERATIONS = 200
"""Maximum number of iterations. Sheets and solids take about ten at any size, springs over six decades of stiffness
thirty."""


class ConjugateGradients:
    """Iterative solver of Q x = b that starts at zero.

    The result depends on b alone, not on the number of threads.

    Attributes:
        nonzeros: entries of the matrices of all levels and of the coarsest level's factor.
        num_iterations: of the last solve.
        correction_ratios: largest entry of z before each iteration, relative to that of x, (iterations + 1, 3).
    """

    def __init__(self, Q: csr_array) -> None:
        """Set up the preconditioner; raise NotPositiveDefinite, with the vertex at fault where it is known."""
        require_finite_rows(Q)
        diagonal = Q.diagonal()
        if not (diagonal > 0.0).all():
            raise build_definiteness_error(int(np.flatnonzero(~(diagonal > 0.0))[0]))
        self._Q = np.asarray(Q.indptr, np.int64), np.asarray(Q.indices, np.int32), Q.data
        self._multigrid = Multigrid(Q)
        self.nonzeros: int | None = self._multigrid.nonzeros
        self.num_iterations = 0
        self.correction_ratios: list[NDArray[np.float64]] = []
        self._vectors = np.zeros((4, len(diagonal), 4))
        self._partial_sums = np.zeros((-(-len(diagonal) // kernels.ROWS_PER_BLOCK), 9))

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3), not modified.
            out: solution (n, 3), not `b` itself.

        Raises:
            NotPositiveDefinite: with the vertex at fault.
            Unsupported: if the iteration does not converge.
        """
        columns = _ColumnIteration(self._Q, self._multigrid, self._vectors, self._partial_sums, b)
        self.num_iterations, ended = columns.run_iterations(columns.apply_preconditioner(), _MAX_ITERATIONS)
        self.correction_ratios = columns.correction_ratios
        if ended == NEGATIVE_CURVATURE:
            raise build_definiteness_error(
                columns.failing_vertex, "the largest entry of a direction of negative curvature"
            )
        if not columns.is_within_tolerance():
            raise Unsupported(
                f"cg: after {self.num_iterations} iterations entries still change by "
                f"{self.correction_ratios[-1].max():.1e} of "
                "the largest: the stiffnesses lie too far apart for multigrid; use supernodal"
            )
        out[:] = columns.x[:, :3]


class _ColumnIteration(ConjugateGradientIteration):
    """State of the iterations, one per column of b (n, 3).

    x, r, p and Q p are (n, 4) in float64, z in float32.

    correction_ratios: largest entry of z before each iteration, relative to that of x; failing_vertex: the vertex with
    the largest component where a curvature is negative.
    """

    def __init__(
        self,
        Q: Any,
        multigrid: Multigrid,
        vectors: NDArray[np.float64],
        partial_sums: NDArray[np.float64],
        b: Positions,
    ) -> None:
        self._Q, self._multigrid, self._partial_sums = Q, multigrid, partial_sums
        self.x, self._r, self._p, self._image = vectors
        vectors[:3] = 0.0
        self._r[:, :3] = b
        multigrid.right_hand_side[:] = self._r
        self._largest_entry, self.correction_ratios, self.failing_vertex = 0.0, list[NDArray[np.float64]](), -1

    def apply_preconditioner(self) -> NDArray[np.float64]:
        """Compute z, and return r'z."""
        self._z, parts = self._multigrid.apply_cycle(), self._partial_sums
        kernels.dot_and_max(self._r, self._z, parts)
        self._largest_correction = parts[:, 3:6].max(axis=0, initial=0.0)
        self.correction_ratios.append(
            self._largest_correction / self._largest_entry if self._largest_entry else np.ones(3)
        )
        return parts[:, :3].sum(axis=0)

    def update_direction(
        self, product: NDArray[np.float64], previous_product: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Update the search direction p; return p'Qp."""
        kernels.update_direction(_safe_divide(product, previous_product), self._z, self._p)
        kernels.multiply_sparse_and_dot(*self._Q, self._p, self._image, self._partial_sums)
        return self._partial_sums[:, :3].sum(axis=0)

    def update_iterate(self, product: NDArray[np.float64], curvature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Update x and r, and apply the preconditioner; return r'z."""
        parts, rounded = self._partial_sums, self._multigrid.right_hand_side
        kernels.update_iterate_and_residual(
            _safe_divide(product, curvature), self._p, self._image, self.x, self._r, rounded, parts
        )
        self._largest_entry = float(parts[:, :3].max(initial=0.0))
        return self.apply_preconditioner()

    def is_convex(self, curvature: NDArray[np.float64]) -> bool:
        """Return whether no curvature is negative."""
        wrong = curvature < 0.0
        if wrong.any():
            self.failing_vertex = int(np.abs(self._p[:, :3][:, wrong]).max(axis=1).argmax())
        return not wrong.any()

    def is_converged(self, product: NDArray[np.float64]) -> bool:
        """Return whether the iteration ends: converged, or not finite."""
        return self.is_within_tolerance() or not np.isfinite(product).all()

    def is_within_tolerance(self) -> bool:
        """Return whether the corrections of all entries of x are within the tolerance."""
        return bool((self._largest_correction <= CG_RTOL * self._largest_entry).all())


def _safe_divide(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a / b, and 0 where b is not positive: a solved column remains constant."""
    return np.divide(a, b, out=np.zeros(3), where=b > 0.0)
