"""Conjugate gradients (Hestenes and Stiefel 1952) preconditioned by multigrid: for what no factor fits.

    z = V-cycle(r),  p = z + beta p,  x += alpha p,  r -= alpha Q p

Three right-hand sides are three iterations that share each pass over the matrices. z is near the error of x itself,
whatever the stiffness of a row: the iteration ends when no entry of z is above TOLERANCE times the largest of x.
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
"""Positions that are told apart at 1e-9 of a scene's size stay so at a hundred sizes' distance from the origin, and
after some iterations: each multiplies the number of digits by a constant, so that two more cost two in ten."""

_LIMIT = 200
"""Sheets and solids take about ten iterations at any size, springs over six decades thirty."""


class ConjugateGradients:
    """Q out = b by iteration from zero: the result depends on b alone, and on no thread count.

    nonzeros: entries of the matrices of all levels and of the coarsest one's factor; iterations: of the last solve;
    changes: the largest entry of z before each of them, over that of x (iterations + 1, 3).
    """

    def __init__(self, Q: csr_array) -> None:
        """Raises NotPositiveDefinite, with the vertex at fault where one can be told."""
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
        """Write Q^-1 b, shape (n, 3), to `out`; b is left as it is and must not be `out`.

        Raises NotPositiveDefinite, with the vertex at fault, and Unsupported where the iteration does not end.
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
    """One iteration a column of b, (n, 3): x, r, p and the image of p, (n, 4), in float64; z in float32.

    changes: the largest entry of z before each iteration, over that of x; at_fault: the vertex that moves most where
    a curvature is negative.
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
        """z, and r'z."""
        self._z, parts = self._multigrid.apply(), self._parts
        kernels.compare(self._r, self._z, parts)
        self._change = parts[:, 3:6].max(axis=0, initial=0.0)
        self.changes.append(self._change / self._size if self._size else np.ones(3))
        return parts[:, :3].sum(axis=0)

    def turn(self, product: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
        """See Iteration."""
        kernels.turn(_ratio(product, before), self._z, self._p)
        kernels.multiply_and_dot(*self._Q, self._p, self._image, self._parts)
        return self._parts[:, :3].sum(axis=0)

    def go(self, product: NDArray[np.float64], curvature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See Iteration."""
        parts, rounded = self._parts, self._multigrid.right_hand_side
        kernels.advance(_ratio(product, curvature), self._p, self._image, self.x, self._r, rounded, parts)
        self._size = float(parts[:, :3].max(initial=0.0))
        return self.precondition()

    def convex(self, curvature: NDArray[np.float64]) -> bool:
        """See Iteration."""
        wrong = curvature < 0.0
        if wrong.any():
            self.at_fault = int(np.abs(self._p[:, :3][:, wrong]).max(axis=1).argmax())
        return not wrong.any()

    def near(self, product: NDArray[np.float64]) -> bool:
        """See Iteration; nor does it go on from what is not finite."""
        return self.settled() or not np.isfinite(product).all()

    def settled(self) -> bool:
        """Whether no entry of x changes any more."""
        return bool((self._change <= TOLERANCE * self._size).all())


def _ratio(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """a / b, and 0 where b is: a right-hand side that is done, or zero, stays as it is."""
    return np.divide(a, b, out=np.zeros(3), where=b > 0.0)
