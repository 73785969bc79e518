"""Compiled conjugate gradients on the exact Hessian, preconditioned by a factor of Q.

H d = -g to |H d + g| <= limit,   |r|^2 = r' Q^-1 r           see `solvers.methods.newton_cg`
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.kernels.hessian import multiply
from solvers.linear.krylov import CURVED, compiled_over
from solvers.linear.supernodal import Supernodal
from solvers.linear.supernodal_solve import Factor, solve
from solvers.linear.team import Team


def among(factor: Supernodal, free: NDArray[np.int64]) -> Factor:
    """Embed a float64 factor over the free vertices (f,) so that it solves with vectors of all vertices."""
    at = factor.layout
    by_slot, by_vertex = (
        np.stack([free[order[:, 0]], order[:, 1]], axis=1).astype(np.uint32) for order in (at.by_slot, at.by_vertex)
    )
    lists = at.places, at.chunks, at.spans, by_slot, by_vertex
    return Factor(factor.squares, factor.panels, *lists, np.zeros(4 * at.rows), Team.of(len(at.spans) - 1))


class Newton(NamedTuple):
    """The state of the solve of a Newton equation H d = -g.

    Attributes:
        hessian: arguments of `multiply`.
        factor: factor of Q.
        threads: threads of a solve with Q; None for one.
        held: vertices that do not move.
        shrunk: vertices (c,) and blocks S^-1 (c, 3, 3) of the preconditioner (S Q S)^-1; None for Q^-1.
        d, r, p, z, product: iterate, residual, direction, preconditioned residual, and Hessian times direction
            (n, 3).
    """

    hessian: tuple[Any, ...]
    factor: Factor
    threads: int | None
    held: NDArray[np.int64]
    shrunk: tuple[NDArray[np.int64], NDArray[np.float64]] | None
    d: NDArray[np.float64]
    r: NDArray[np.float64]
    p: NDArray[np.float64]
    z: NDArray[np.float64]
    product: NDArray[np.float64]


@inner
def _turn(state, product, before):
    newton, _ = state
    scale = product / before
    for i in range(len(newton.p)):
        for c in range(3):
            newton.p[i, c] = newton.z[i, c] + scale * newton.p[i, c]
    multiply(*newton.hessian, newton.p, newton.product)
    for v in newton.held:
        for c in range(3):
            newton.product[v, c] = 0.0
    return _dot(newton.p, newton.product)


@inner
def _go(state, product, curvature):
    newton, _ = state
    length = product / curvature
    for i in range(len(newton.d)):
        for c in range(3):
            newton.d[i, c] += length * newton.p[i, c]
            newton.r[i, c] -= length * newton.product[i, c]
    b = _scaled(newton.shrunk, newton.r, newton.product)
    solve(newton.factor, b, newton.z, newton.threads)
    _shrink(newton.shrunk, newton.z)
    return _dot(newton.r, newton.z)


@inner
def _scaled(shrunk, r, out):
    """Write S^-1 r (n, 3) to `out` and return it; return r itself without scaling."""
    if shrunk is None:
        return r
    for v in range(len(r)):
        for c in range(3):
            out[v, c] = r[v, c]
    _shrink(shrunk, out)
    return out


@inner
def _shrink(shrunk, x):
    """Multiply x (n, 3) by S^-1."""
    if shrunk is None:
        return
    vertices, root = shrunk
    for k in range(len(vertices)):
        v = vertices[k]
        x0, x1, x2 = x[v, 0], x[v, 1], x[v, 2]
        for c in range(3):
            x[v, c] = root[k, c, 0] * x0 + root[k, c, 1] * x1 + root[k, c, 2] * x2


@inner
def _convex(state, curvature):
    return not curvature <= 0.0


@inner
def _near(state, product):
    _, limit = state
    return product <= limit


_iterate = compiled_over(_turn, _go, _convex, _near)


@kernel
def direction(newton, gradient, descent, eta, most):
    """Write newton.d (n, 3) [m]; it is -Q^-1 g if the Hessian is not convex along that.

    Vectors of `newton` are zero at the vertices that do not move.

    Args:
        newton: the state.
        gradient: g (n, 3) [N].
        descent: Q^-1 g [m], or (S Q S)^-1 g (n, 3).
        eta: tolerance relative to |g|.
        most: maximum number of products with H.
    """
    for i in range(len(newton.d)):
        for c in range(3):
            newton.d[i, c] = newton.p[i, c] = 0.0
            newton.r[i, c], newton.z[i, c] = -gradient[i, c], -descent[i, c]
    product = _dot(gradient, descent)
    count, ended = _iterate((newton, eta * eta * product), product, most)
    if ended == CURVED and count == 0:
        for i in range(len(newton.d)):
            for c in range(3):
                newton.d[i, c] = newton.p[i, c]


@inner
def _dot(a, b):
    total = 0.0
    for i in range(len(a)):
        total += a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
    return total
