"""Symplectic Euler, compiled: the force of all springs, eight vertices at a time, then velocities, then positions."""

from __future__ import annotations

from solvers.compiling import kernel
from solvers.kernels.springs import add_descent


@kernel
def advance(bundles, pins, begin, end, force, rate, h, count, p, v, acceleration):
    """`count` substeps of h [s] from p [m] and v [m/s], in rows of four, which take the result.

    pins: vertices (q,) that move evenly from `begin` to `end`, (q, 3) [m]; force [N]: as `right` of the bundles, held
    by nothing; rate: h/m (n,) [s/kg], 0 for the pinned; acceleration: scratch in rows of four.
    """
    for step in range(1, count + 1):
        for k in range(len(acceleration)):
            acceleration[k] = 0.0
        add_descent(bundles, 0, len(bundles.start) - 1, p, force, acceleration, 0)
        for i in range(len(rate)):
            for k in range(4 * i, 4 * i + 3):
                v[k] += rate[i] * acceleration[k]
                p[k] += h * v[k]
        left = (count - step) / count
        for q in range(len(pins)):
            for c in range(3):
                p[4 * pins[q] + c] = end[q, c] + left * (begin[q, c] - end[q, c])
