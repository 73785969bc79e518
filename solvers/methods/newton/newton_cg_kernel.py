"""Compiled iterations of Newton-CG.

    H d = -g to |H d + g| <= limit,   |r|^2 = r' Q^-1 r,   p <- p + t d

Conjugate gradients on the exact Hessian are preconditioned by a factor of Q.

`springbench.solvers.methods.newton.newton_cg` describes the method.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_inner_options, jit_kernel
from springbench.solvers.kernels.descent_search import (
    SearchArrays,
    exceeds_roundoff,
    move_to_trial,
    read_residual,
    search_backtracking,
)
from springbench.solvers.kernels.iteration_loop import build_compiled_loop
from springbench.solvers.kernels.objective_kernels import compute_inner_product
from springbench.solvers.kernels.spring_hessian import linearise_springs, multiply_hessian
from springbench.solvers.linalg.cholesky.triangular_solve import SupernodalFactor, solve_supernodal
from springbench.solvers.linalg.krylov import NEGATIVE_CURVATURE, compile_cg_loop

MAX_ETA, MIN_ETA = 0.5, 1e-10
"""Upper and lower bound of eta."""

MAX_CG_ITERATIONS = 1000
"""Maximum number of conjugate gradient iterations: the stiffest springs need it for a few digits."""


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
    return compute_inner_product(newton.p, newton.hessian_product)


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
    return compute_inner_product(newton.r, newton.z)


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
    product = compute_inner_product(gradient, descent)
    count, ended = _iterate_loop((newton, eta * eta * product), product, most)
    if ended == NEGATIVE_CURVATURE and count == 0:
        for i in range(len(newton.d)):
            for c in range(3):
                newton.d[i, c] = newton.p[i, c]


NEWTON_CG_PROGRESS_DTYPE = np.dtype(
    [
        ("is_started", np.int64),
        ("eta", np.float64),  # tolerance of the next direction, relative to |g|
        ("has_residual", np.int64),  # whether the residual at the current point is known
        ("residual", np.float64),  # [J^(1/2)]
    ]
)
"""The progress of a solve."""


class NewtonCGArrays(NamedTuple):
    """Arrays of the iteration for one system.

    Attributes:
        search: springs and quadratic forms, line search and residual.
        linear_terms: scratch, the linearised springs (m, 4).
        equation: Newton equation with that linearisation and no scaling, in one thread.
    """

    search: SearchArrays
    linear_terms: NDArray[np.float64]
    equation: NewtonEquation


@register_jitable(**jit_inner_options)
def update_eta(eta, square, square_before, max_eta):
    """Return the tolerance of the next direction, by the second choice of Eisenstat and Walker (1996).

    Their safeguard limits it to at least 0.9 times the square of the last tolerance, while that exceeds 0.1.

    Args:
        eta: last tolerance, relative to |g|.
        square, square_before: square of |g| after and before the step [J].
        max_eta: upper bound.
    """
    guarded = 0.9 * eta**2
    return min(max_eta, max(MIN_ETA, 0.9 * square / square_before, guarded if guarded > 0.1 else 0.0))


@jit_inner
def _take_step(state):
    """Do a step; return whether the positions changed."""
    arrays, step_data, exact_pins, p, gradient, descent, progress = state
    now, newton, product = progress[0], arrays.equation, compute_inner_product(gradient, descent)
    if not exceeds_roundoff(arrays.search, p, product):
        return False
    linearise_springs(arrays.search.objective_terms, p, arrays.linear_terms)
    solve_direction(newton, gradient, descent, now.eta, MAX_CG_ITERATIONS)
    slope = compute_inner_product(gradient, newton.d)
    if not search_backtracking(arrays.search, step_data, exact_pins, p, newton.d, 1.0, slope):
        for v in range(len(p)):
            for c in range(3):
                newton.d[v, c] = -descent[v, c]
        if not search_backtracking(arrays.search, step_data, exact_pins, p, newton.d, 1.0, -product):
            return False
    move_to_trial(arrays.search, p, gradient)
    solve_supernodal(newton.factor, gradient, descent, None)
    now.eta = update_eta(now.eta, compute_inner_product(gradient, descent), product, MAX_ETA)
    now.has_residual = 0
    return True


@jit_inner
def _compute_residual(state):
    arrays, _, _, _, gradient, descent, progress = state
    return read_residual(arrays.search, descent, gradient, progress)


_newton_loop = build_compiled_loop(_take_step, _compute_residual)


@jit_kernel
def run_newton_cg(arrays, step_data, exact_pins, limits, p, gradient, descent, progress):
    """Run the iteration loop (`springbench.solvers.kernels.iteration_loop`).

    Args:
        arrays: arrays of the system.
        step_data: data of the step.
        exact_pins: exactly pinned vertices and their targets.
        limits: limits of the loop, in iterations.
        p: positions (n, 3) [m], updated.
        gradient: gradient there (n, 3) [N], updated.
        descent: preconditioned gradient Q^-1 g (n, 3) [m], updated; zero at the start.
        progress: progress of the solve (1,), updated; zero at the start.

    Returns:
        Number of iterations, last residual [J^(1/2)] and termination reason.
    """
    if progress[0].is_started == 0:
        solve_supernodal(arrays.equation.factor, gradient, descent, None)
        progress[0].is_started, progress[0].eta = 1, MAX_ETA
    return _newton_loop((arrays, step_data, exact_pins, p, gradient, descent, progress), limits)
