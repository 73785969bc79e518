"""Conjugate gradients on the exact Hessian, preconditioned by a factor of Q, without Python.

H d = -g to |H d + g| <= limit,   |r|^2 = r' Q^-1 r           see `solvers.methods.newton_cg`
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.kernels.hessian import multiply
from solvers.linear.supernodal import Supernodal
from solvers.linear.supernodal_solve import solve
from solvers.linear.team import Team


class Factor(NamedTuple):
    """A factor of Q's free part, its solves from and to vectors of all vertices; see `solvers.linear.supernodal`."""

    squares: NDArray[Any]
    panels: NDArray[Any]
    places: NDArray[np.int32]
    chunks: NDArray[np.int64]
    spans: NDArray[np.int64]
    by_slot: NDArray[np.uint32]
    by_vertex: NDArray[np.uint32]
    work: NDArray[np.float64]
    team: Team

    @classmethod
    def of(cls, factor: Supernodal, free: NDArray[np.int64]) -> Factor:
        """A float64 factor, whose unknowns are the vertices free (f,)."""
        at = factor.layout
        by_slot, by_vertex = (
            np.stack([free[order[:, 0]], order[:, 1]], axis=1).astype(np.uint32) for order in (at.by_slot, at.by_vertex)
        )
        work, team = np.zeros(4 * at.rows), Team.of(len(at.spans) - 1)
        return cls(factor.squares, factor.panels, at.places, at.chunks, at.spans, by_slot, by_vertex, work, team)


@kernel
def direction(
    terms, linear, form, joined, curvature, factor, threads, held, gradient, descent, eta, most, scratch, d
):  # fmt: skip
    """Write d (n, 3) [m].

    linear, form, joined, curvature: see `hessian.multiply`; threads: of a solve, None for one; held: vertices that do
    not move; gradient, descent (n, 3): g [N] and Q^-1 g [m]; eta: what is left of |g|; most: products with H; scratch
    (4, n, 3), which is zero at the held vertices.
    """
    r, s, z, product = scratch[0], scratch[1], scratch[2], scratch[3]
    for i in range(len(d)):
        for c in range(3):
            d[i, c], r[i, c], s[i, c] = 0.0, gradient[i, c], -descent[i, c]
    norm = _dot(gradient, descent)
    limit = eta * eta * norm
    for k in range(most):
        multiply(terms, linear, form, joined, curvature, s, product)
        for v in held:
            for c in range(3):
                product[v, c] = 0.0
        along = _dot(s, product)
        if along <= 0.0:
            if k == 0:
                for i in range(len(d)):
                    for c in range(3):
                        d[i, c] = s[i, c]
            return
        length, before = norm / along, norm
        for i in range(len(d)):
            for c in range(3):
                d[i, c] += length * s[i, c]
                r[i, c] += length * product[i, c]
        solve(
            factor.squares, factor.panels, factor.places, factor.chunks, factor.spans, factor.by_slot,
            factor.by_vertex, factor.work, r, z, factor.team, threads,
        )  # fmt: skip
        norm = _dot(r, z)
        if norm <= limit:
            return
        for i in range(len(d)):
            for c in range(3):
                s[i, c] = norm / before * s[i, c] - z[i, c]


@inner
def _dot(a, b):
    total = 0.0
    for i in range(len(a)):
        total += a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
    return total
