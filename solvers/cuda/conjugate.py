"""Conjugate gradients on a device, without a word from the host: H d = -g to r'z <= limit (`solvers.linear.krylov`).

    turn     p = z + r'z / (r'z before) p         multiply   y = H p, and p'y         curve    whether p'y > 0
    go       d += t p,   r -= t y                 apply      z = M^-1 r, and r'z      judge    whether r'z <= limit

The numbers are in `now` on the device; kernels of one block write them. Once it has ended all kernels do nothing, so
that the host launches some iterations at a time and looks only after them.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from solvers.cuda import sums
from solvers.cuda.target import cuda

ENDED, COUNT, PRODUCT, BEFORE, CURVATURE, LIMIT = range(6)
"""Where in `now`: what ended it; iterations done; r'z, the one before, p'Hp and what r'z should be at most [J]."""

GOING, NEAR, CURVED = 0.0, 1.0, 2.0
"""What ended it."""


class Kernels(NamedTuple):
    """Of a precision: see each."""

    turn: Any
    go: Any


@cache
def kernels(real: type[np.float32] | type[np.float64]) -> Kernels:
    """Those that compute in `real`."""

    @cuda.jit
    def turn(z, p, now):
        """p = z + r'z / (r'z before) p."""
        if now[ENDED] != GOING:
            return
        first, scale = now[COUNT] == 0.0, real(now[PRODUCT] / now[BEFORE])
        i = cuda.grid(1)
        while i < p.shape[0]:
            for c in range(3):
                p[i, c] = z[i, c] if first else z[i, c] + scale * p[i, c]
            i += cuda.gridsize(1)

    @cuda.jit
    def go(p, y, d, r, now):
        """d += t p, r -= t y."""
        if now[ENDED] != GOING:
            return
        first, length = now[COUNT] == 0.0, real(now[PRODUCT] / now[CURVATURE])
        i = cuda.grid(1)
        while i < d.shape[0]:
            for c in range(3):
                step = length * p[i, c]
                d[i, c] = step if first else d[i, c] + step
                r[i, c] -= length * y[i, c]
            i += cuda.gridsize(1)

    return Kernels(turn, go)


@cuda.jit
def curve(partials, which, count, now):
    """The second stage of p'Hp, and whether it is positive; one block."""
    if now[ENDED] != GOING:
        return
    total = sums.of_all(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[CURVATURE] = total
        if not total > 0.0:
            now[ENDED] = CURVED


@cuda.jit
def judge(partials, which, count, now):
    """The second stage of r'z, and whether it is small; one block."""
    if now[ENDED] != GOING:
        return
    total = sums.of_all(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[BEFORE], now[PRODUCT] = now[PRODUCT], total
        now[COUNT] += 1.0
        if total <= now[LIMIT]:
            now[ENDED] = NEAR
