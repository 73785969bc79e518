"""Implicit Euler of a spring network in Taichi: Newton's method with conjugate gradients.

    g(x) = |x - y|^2_M / 2h^2 + sum of k (|x_i - x_j| - r)^2 / 2,    y = x + h v + h^2 M^-1 f

As in Taichi's own implicit cloth example (`implicit_mass_spring`), the Hessian is stored as one block per spring, not
as a matrix. In addition, the eigenvalues of the blocks are clamped, the preconditioner is block Jacobi, and steps are
halved until g does not increase. The program runs on one core and does not depend on springbench.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np


def build_taichi_program(
    ti: Any, mass: Any, pinned: Any, ends: Any, stiffness: Any, rest_length: Any, cg_rtol: float
) -> Any:
    """Build fields and kernels of a network of n vertices.

    Args:
        ti: the module `taichi`.
        mass: (n,) [kg].
        pinned: indices of the pinned vertices.
        ends: (m, 2).
        stiffness: (m,) [N/m].
        rest_length: (m,) [m].
        cg_rtol: tolerance of conjugate gradients, relative to the gradient.

    Returns:
        An object with `x`, `v`, `load` (n, 3) [m, m/s, N], `h` [s], `newton` (iterations) and `step()`.
    """
    n, m = len(mass), len(ends)
    x, v, y, load, g, d, p, q, z, last = (ti.Vector.field(3, ti.f64, max(n, 1)) for _ in range(10))
    block, inverse = ti.Matrix.field(3, 3, ti.f64, max(m, 1)), ti.Matrix.field(3, 3, ti.f64, max(n, 1))
    weight, free = ti.field(ti.f64, max(n, 1)), ti.field(ti.i32, max(n, 1))
    k, r, end = ti.field(ti.f64, max(m, 1)), ti.field(ti.f64, max(m, 1)), ti.Vector.field(2, ti.i32, max(m, 1))
    h, newton = ti.field(ti.f64, ()), ti.field(ti.i32, ())
    weight.from_numpy(np.asarray(mass, float))
    free.from_numpy((~np.isin(np.arange(n), pinned)).astype(np.int32))
    if m:
        end.from_numpy(np.asarray(ends, np.int32))
        k.from_numpy(np.asarray(stiffness, float))
        r.from_numpy(np.asarray(rest_length, float))

    @ti.func
    def value():
        found = ti.cast(0.0, ti.f64)
        for i in range(n):
            if free[i]:
                found += 0.5 * weight[i] / h[None] ** 2 * (x[i] - y[i]).norm_sqr()
        for s in range(m):
            found += 0.5 * k[s] * ((x[end[s][0]] - x[end[s][1]]).norm() - r[s]) ** 2
        return found

    @ti.func
    def derivatives():
        one = ti.Matrix.identity(ti.f64, 3)
        for i in range(n):
            g[i] = weight[i] / h[None] ** 2 * (x[i] - y[i])
            inverse[i] = weight[i] / h[None] ** 2 * one
        for s in range(m):
            i, j = end[s][0], end[s][1]
            a = x[i] - x[j]
            length = ti.max(a.norm(), 1e-300)
            along = a.outer_product(a) / length**2
            block[s] = k[s] * (along + ti.max(0.0, 1.0 - r[s] / length) * (one - along))
            force = k[s] * (1.0 - r[s] / length) * a
            g[i] += force
            g[j] -= force
            inverse[i] += block[s]
            inverse[j] += block[s]
        for i in range(n):
            if free[i]:
                inverse[i] = inverse[i].inverse()
            else:
                g[i] = 0.0 * g[i]
                inverse[i] = 0.0 * one

    @ti.func
    def product():
        for i in range(n):
            q[i] = weight[i] / h[None] ** 2 * p[i]
        for s in range(m):
            i, j = end[s][0], end[s][1]
            f = block[s] @ (p[i] - p[j])
            q[i] += f
            q[j] -= f
        for i in range(n):
            if not free[i]:
                q[i] = 0.0 * q[i]

    @ti.func
    def conjugate_gradients():
        rho = ti.cast(0.0, ti.f64)
        for i in range(n):
            d[i] = 0.0 * g[i]
            z[i] = -g[i]  # the residual
            p[i] = inverse[i] @ z[i]
            rho += z[i].dot(p[i])
        least, count = cg_rtol**2 * rho, 0
        while rho > least and count < 10 * n:
            product()
            curvature = ti.cast(0.0, ti.f64)
            for i in range(n):
                curvature += p[i].dot(q[i])
            alpha, after = rho / curvature, ti.cast(0.0, ti.f64)
            for i in range(n):
                d[i] += alpha * p[i]
                z[i] -= alpha * q[i]
                after += z[i].dot(inverse[i] @ z[i])
            for i in range(n):
                p[i] = inverse[i] @ z[i] + after / rho * p[i]
            rho = after
            count += 1

    @ti.kernel
    def step():
        ti.loop_config(serialize=True)  # one core: all statements inside run in order
        for _ in range(1):
            for i in range(n):
                last[i] = x[i]
                if free[i]:
                    y[i] = x[i] + h[None] * v[i] + h[None] ** 2 / weight[i] * load[i]
                else:
                    y[i] = x[i]
            for _iteration in range(newton[None]):
                before = value()
                derivatives()
                conjugate_gradients()
                for i in range(n):
                    z[i] = x[i]
                    x[i] += d[i]
                part, halvings = ti.cast(1.0, ti.f64), 0
                while value() > before and halvings < 20:
                    part *= 0.5
                    halvings += 1
                    for i in range(n):
                        x[i] = z[i] + part * d[i]
            for i in range(n):
                if free[i]:
                    v[i] = (x[i] - last[i]) / h[None]

    return SimpleNamespace(x=x, v=v, load=load, h=h, newton=newton, step=step)
