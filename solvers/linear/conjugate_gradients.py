"""Conjugate gradients (Hestenes and Stiefel 1952) preconditioned by multigrid: for what no factor fits.

    z = V-cycle(r),  p = z + beta p,  x += alpha p,  r -= alpha Q p

Three right-hand sides are three iterations that share each pass over the matrices. z is near the error of x itself,
whatever the stiffness of a row: the iteration ends when no entry of z is above TOLERANCE times the largest of x.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.linear import multigrid_kernels as kernels
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
        self._vectors = [np.zeros((len(diagonal), 4)) for _ in range(4)]
        self._parts = np.zeros((-(-len(diagonal) // kernels.BLOCK), 9))

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b, shape (n, 3), to `out`; b is left as it is and must not be `out`.

        Raises NotPositiveDefinite, with the vertex at fault, and Unsupported where the iteration does not end.
        """
        x, r, p, image = self._vectors
        parts, rounded = self._parts, self._multigrid.right_hand_side
        x[:] = 0.0
        p[:] = 0.0
        r[:, :3] = b
        rounded[:] = r
        before, size = np.zeros(3), 0.0
        self.iterations, self.changes = 0, []
        while True:
            z = self._multigrid.apply()
            kernels.compare(r, z, parts)
            dot, change = parts[:, :3].sum(axis=0), parts[:, 3:6].max(axis=0, initial=0.0)
            self.changes.append(change / size if size else np.ones(3))
            if (change <= TOLERANCE * size).all():
                break
            if self.iterations == _LIMIT or not np.isfinite(dot).all():
                raise Unsupported(
                    f"cg: after {self.iterations} iterations entries still change by {self.changes[-1].max():.1e} of "
                    "the largest: the stiffnesses lie too far apart for multigrid; use supernodal"
                )
            kernels.turn(_ratio(dot, before), z, p)
            kernels.multiply_and_dot(*self._Q, p, image, parts)
            curvature = parts[:, :3].sum(axis=0)
            if (curvature < 0.0).any():
                v = int(np.abs(p[:, :3][:, curvature < 0.0]).max(axis=1).argmax())
                raise NotPositiveDefinite(
                    f"Q = A'KA + M/dt^2 + w C'C is not positive definite about vertex {v}: stiffnesses, masses and pin "
                    "weights lie too far apart or are negative"
                )
            kernels.advance(_ratio(dot, curvature), p, image, x, r, rounded, parts)
            size = float(parts[:, :3].max(initial=0.0))
            before = dot
            self.iterations += 1
        out[:] = x[:, :3]


def _ratio(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """a / b, and 0 where b is: a right-hand side that is done, or zero, stays as it is."""
    return np.divide(a, b, out=np.zeros(3), where=b > 0.0)
