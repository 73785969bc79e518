"""Compiled symplectic Euler, with the springs in packets of eight vertices."""

from __future__ import annotations

from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.kernels.spring_local_step import add_descent


@jit_kernel
def run_symplectic_euler(bundles, pins, begin, end, force, rate, h, count, p, v, acceleration):
    """Run `count` substeps of size h.

    The arrays p and v, in rows of four, are overwritten with the result.

    Args:
        bundles: packets of the springs.
        pins: vertices (q,) that move uniformly from `begin` to `end`.
        begin, end: positions of the pins (q, 3) [m].
        force: force [N] in the layout of the packets' right-hand side, with zero anchor stiffness.
        rate: h/m (n,) [s/kg], 0 for pinned vertices.
        h: step size [s].
        count: number of substeps.
        p: positions [m].
        v: velocities [m/s].
        acceleration: scratch in rows of four.
    """
    for step in range(1, count + 1):
        for k in range(len(acceleration)):
            acceleration[k] = 0.0
        add_descent(bundles, 0, len(bundles.packet_start) - 1, p, force, acceleration, 0)
        for i in range(len(rate)):
            for k in range(4 * i, 4 * i + 3):
                v[k] += rate[i] * acceleration[k]
                p[k] += h * v[k]
        left = (count - step) / count
        for q in range(len(pins)):
            for c in range(3):
                p[4 * pins[q] + c] = end[q, c] + left * (begin[q, c] - end[q, c])
