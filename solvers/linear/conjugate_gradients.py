"""Conjugate gradients (Hestenes and Stiefel 1952) preconditioned by multigrid, for systems whose factor does not fit.

    z = V-cycle(r),  p = z + beta p,  x += alpha p,  r -= alpha Q p

Three right-hand sides are solved in lockstep and share each pass over the matrices. z approximates the error of x
itself, whatever the stiffness of a row. The iteration ends when no entry of z exceeds TOLERANCE times the largest one
of x.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.linear import multigrid_kernels as kernels
from solvers.linear.krylov import CURVED, Iteration
from solvers.linear.multigrid import Multigrid
from solvers.problem import NotPositiveDefinite, Positions, Unsupported

TOLERANCE = 1e-12
"""Positions distinct at 1e-9 of a scene's size remain so at a distance of a hundred sizes from the origin, and after
some iterations. Each iteration gains a constant number of digits, so that two more digits cost two iterations in
ten."""

_LIMIT = 200
"""Sheets and solids take about ten iterations at any size, springs over six decades of stiffness thirty."""


class ConjugateGradients:
    """Iterative solver of Q x = b that starts at zero.

    The result depends on b alone, not on the number of threads.

    Attributes:
        nonzeros: entries of the matrices of all levels and of the coarsest level's factor.
        iterations: of the last solve.
        changes: largest entry of z before each iteration, relative to that of x, (iterations + 1, 3).
    """

    def __init__(self, Q: csr_array) -> None:
        """Set up the preconditioner; raise NotPositiveDefinite, with the vertex at fault where it is known."""
        if not np.isfinite(Q.data).all():
            v = np.repeat(np.arange(len(Q.indptr) - 1), np.diff(Q.indptr))[~np.isfinite(Q.data)][0]
            raise NotPositiveDefinite(f"Q is not finite in row {v}: a stiffness, a mass or a pin weight there is not")
        diagonal = Q.diagonal()
        if not (diagonal > 0.0).all():
            v = np.flatnonzero(~(diagonal > 0.0))[0]
            raise NotPositiveDefinite(
                f"Q = A'KA + M/dt^2 + w C'C is not positive definite at vertex {v}: it has neither mass nor a spring "
                "nor a pin, or a negative one"
            )
        self._Q = np.asarray(Q.indptr, np.int64), np.asarray(Q.indices, np.int32), Q.data
        self._multigrid = Multigrid(Q)
        self.nonzeros: int | None = self._multigrid.nonzeros
        self.iterations = 0
        self.changes: list[NDArray[np.float64]] = []
        self._vectors = np.zeros((4, len(diagonal), 4))
        self._parts = np.zeros((-(-len(diagonal) // kernels.BLOCK), 9))

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b to `out`.

        Args:
            b: right-hand sides (n, 3), not modified.
            out: solution (n, 3), not `b` itself.

        Raises:
            NotPositiveDefinite: with the vertex at fault.
            Unsupported: if the iteration does not converge.
        """
        columns = _Columns(self._Q, self._multigrid, self._vectors, self._parts, b)
        self.iterations, ended = columns.iterate(columns.precondition(), _LIMIT)
        self.changes = columns.changes
        if ended == CURVED:
            raise NotPositiveDefinite(
                f"Q = A'KA + M/dt^2 + w C'C is not positive definite about vertex {columns.at_fault}: stiffnesses, "
                "masses and pin weights lie too far apart or are negative"
            )
        if not columns.settled():
            raise Unsupported(
                f"cg: after {self.iterations} iterations entries still change by {self.changes[-1].max():.1e} of "
                "the largest: the stiffnesses lie too far apart for multigrid; use supernodal"
            )
        out[:] = columns.x[:, :3]


class _Columns(Iteration):
    """State of the iterations, one per column of b (n, 3).

    x, r, p and Q p are (n, 4) in float64, z in float32.

    changes: largest entry of z before each iteration, relative to that of x; at_fault: the vertex with
    the largest component where a curvature is negative.
    """

    def __init__(
        self, Q: Any, multigrid: Multigrid, vectors: NDArray[np.float64], parts: NDArray[np.float64], b: Positions
    ) -> None:
        self._Q, self._multigrid, self._parts = Q, multigrid, parts
        self.x, self._r, self._p, self._image = vectors
        vectors[:3] = 0.0
        self._r[:, :3] = b
        multigrid.right_hand_side[:] = self._r
        self._size, self.changes, self.at_fault = 0.0, list[NDArray[np.float64]](), -1

    def precondition(self) -> NDArray[np.float64]:
        """Compute z, and return r'z."""
        self._z, parts = self._multigrid.apply(), self._parts
        kernels.compare(self._r, self._z, parts)
        self._change = parts[:, 3:6].max(axis=0, initial=0.0)
        self.changes.append(self._change / self._size if self._size else np.ones(3))
        return parts[:, :3].sum(axis=0)

    def turn(self, product: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
        """Update the search direction p; return p'Qp."""
        kernels.turn(_ratio(product, before), self._z, self._p)
        kernels.multiply_and_dot(*self._Q, self._p, self._image, self._parts)
        return self._parts[:, :3].sum(axis=0)

    def go(self, product: NDArray[np.float64], curvature: NDArray[np.float64]) -> NDArray[np.float64]:
        """Update x and r, and apply the preconditioner; return r'z."""
        parts, rounded = self._parts, self._multigrid.right_hand_side
        kernels.advance(_ratio(product, curvature), self._p, self._image, self.x, self._r, rounded, parts)
        self._size = float(parts[:, :3].max(initial=0.0))
        return self.precondition()

    def convex(self, curvature: NDArray[np.float64]) -> bool:
        """Return whether no curvature is negative."""
        wrong = curvature < 0.0
        if wrong.any():
            self.at_fault = int(np.abs(self._p[:, :3][:, wrong]).max(axis=1).argmax())
        return not wrong.any()

    def near(self, product: NDArray[np.float64]) -> bool:
        """Return whether the iteration ends: converged, or not finite."""
        return self.settled() or not np.isfinite(product).all()

    def settled(self) -> bool:
        """Return whether the corrections of all entries of x are within the tolerance."""
        return bool((self._change <= TOLERANCE * self._size).all())


def _ratio(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a / b, and 0 where b is 0: a converged or zero right-hand side remains constant."""
    return np.divide(a, b, out=np.zeros(3), where=b > 0.0)
