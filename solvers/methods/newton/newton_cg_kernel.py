"""Compiled conjugate gradients on the exact Hessian, preconditioned by a factor of Q.

    H d = -g to |H d + g| <= limit,   |r|^2 = r' Q^-1 r

`springbench.solvers.methods.newton.newton_cg` describes the method.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.spring_hessian import multiply_hessian
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.cholesky.thread_team import ThreadTeam
from springbench.solvers.linalg.cholesky.triangular_solve import SupernodalFactor, solve_supernodal
from springbench.solvers.linalg.krylov import NEGATIVE_CURVATURE, compile_cg_loop


def embed_factor(factor: SupernodalCholesky, free: NDArray[np.int64]) -> SupernodalFactor:
    """Embed a factor over the free vertices into vectors of all vertices.

    Args:
        factor: float64 factor of Q's free rows and columns (f, f).
        free: the free vertices (f,).

    Returns:
        Factor with a work vector and thread team of its own; a solve neither reads nor writes the other vertices.
    """
    at = factor.layout
    by_slot, by_vertex = (
        np.stack([free[order[:, 0]], order[:, 1]], axis=1).astype(np.uint32)
        for order in (at.order_by_slot, at.order_by_vertex)
    )
    lists = at.row_slots, at.chunks, at.group_spans, by_slot, by_vertex
    return SupernodalFactor(
        factor.inverse_blocks,
        factor.panels,
        *lists,
        np.zeros(4 * at.num_work_rows),
        ThreadTeam.from_task_count(len(at.group_spans) - 1),
    )


class NewtonEquation(NamedTuple):
    """The state of the solve of a Newton equation H d = -g.

    Attributes:
        hessian_arguments: arguments of `multiply_hessian`.
        factor: factor of Q.
        num_threads: threads of a solve with Q; None for one.
        fixed_vertices: vertices that do not move.
        inverse_scaling: vertices (c,) and blocks S^-1 (c, 3, 3) of the preconditioner (S Q S)^-1; None for Q^-1.
        d, r, p, z, hessian_product: iterate, residual, direction, preconditioned residual, and Hessian times direction
            (n, 3).
    """

    hessian_arguments: tuple[Any, ...]
    factor: SupernodalFactor
    num_threads: int | None
    fixed_vertices: NDArray[np.int64]
    inverse_scaling: tuple[NDArray[np.int64], NDArray[np.float64]] | None
    d: NDArray[np.float64]
    r: NDArray[np.float64]
    p: NDArray[np.float64]
    z: NDArray[np.float64]
    hessian_product: NDArray[np.float64]


@jit_inner
def _update_direction(state, product, before):
    newton, _ = state
    scale = product / before
    for i in range(len(newton.p)):
        for c in range(3):
            newton.p[i, c] = newton.z[i, c] + scale * newton.p[i, c]
    multiply_hessian(*newton.hessian_arguments, newton.p, newton.hessian_product)
    for v in newton.fixed_vertices:
        for c in range(3):
            newton.hessian_product[v, c] = 0.0
    return _inner_product(newton.p, newton.hessian_product)


@jit_inner
def _update_iterate(state, product, curvature):
    newton, _ = state
    length = product / curvature
    for i in range(len(newton.d)):
        for c in range(3):
            newton.d[i, c] += length * newton.p[i, c]
            newton.r[i, c] -= length * newton.hessian_product[i, c]
    b = _scaled_copy(newton.inverse_scaling, newton.r, newton.hessian_product)
    solve_supernodal(newton.factor, b, newton.z, newton.num_threads)
    _apply_scaling(newton.inverse_scaling, newton.z)
    return _inner_product(newton.r, newton.z)


@jit_inner
def _scaled_copy(shrunk, r, out):
    """Write S^-1 r (n, 3) to `out` and return it; return r itself without scaling."""
    if shrunk is None:
        return r
    for v in range(len(r)):
        for c in range(3):
            out[v, c] = r[v, c]
    _apply_scaling(shrunk, out)
    return out


@jit_inner
def _apply_scaling(shrunk, x):
    """Multiply x (n, 3) by S^-1."""
    if shrunk is None:
        return
    vertices, root = shrunk
    for k in range(len(vertices)):
        v = vertices[k]
        x0, x1, x2 = x[v, 0], x[v, 1], x[v, 2]
        for c in range(3):
            x[v, c] = root[k, c, 0] * x0 + root[k, c, 1] * x1 + root[k, c, 2] * x2


@jit_inner
def _is_convex(state, curvature):
    return not curvature <= 0.0


@jit_inner
def _is_converged(state, product):
    _, limit = state
    return product <= limit


_iterate_loop = compile_cg_loop(_update_direction, _update_iterate, _is_convex, _is_converged)


@jit_kernel
def solve_direction(newton, gradient, descent, eta, most):
    """Solve H d = -g approximately, and write newton.d (n, 3) [m].

    It is -Q^-1 g if the Hessian is not convex along that. Vectors of `newton` are zero at vertices that do not move.

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
    product = _inner_product(gradient, descent)
    count, ended = _iterate_loop((newton, eta * eta * product), product, most)
    if ended == NEGATIVE_CURVATURE and count == 0:
        for i in range(len(newton.d)):
            for c in range(3):
                newton.d[i, c] = newton.p[i, c]


@jit_inner
def _inner_product(a, b):
    total = 0.0
    for i in range(len(a)):
        total += a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
    return total
