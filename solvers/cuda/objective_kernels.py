"""Kernels of a step's objective: gradient and change in float64, Hessian products in `real`.

    grad_i g = h_i (p_i - c_i) - f_i + sum over its edges of t n,      t = k (l - r), or k (n.v - o) of a dashpot
    (H x)_i  = h_i x_i + sum over its edges of b + a n (n.b),  b = s (x_i - x_j),  s = t/l,  a = (k - s)
    g(q) - g(p): a sum of differences, as in `solvers.kernels.objective`

Each row gathers its own terms, in the order of its list, so no thread writes to another's row.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from solvers.cuda import sums
from solvers.cuda.target import cuda
from solvers.energies.edges import TINY


@cuda.jit(device=True)
def along(edges, e, v0, v1, v2):
    """Return the direction, tension [N] and length [m] of an entry's edge.

    The direction points away from the entry's own end; v is the vector from the other end.
    """
    length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    k, rest = edges.stiffness[e], edges.rest[e]
    if rest == rest and length > TINY:
        return v0 / length, v1 / length, v2 / length, k * (length - rest), length
    named, sign = edges.edge[e], 1.0
    if named < 0:
        named, sign = ~named, -1.0
    n0, n1, n2 = sign * edges.axis[named, 0], sign * edges.axis[named, 1], sign * edges.axis[named, 2]
    if rest == rest:
        return n0, n1, n2, -k * rest, 0.0
    return n0, n1, n2, k * (n0 * v0 + n1 * v1 + n2 * v2 - edges.offset[named]), length


@cuda.jit
def gradient(edges, given, p, out):
    """Write the gradient [N] at rows p [m] to `out` (f, 3)."""
    i = cuda.grid(1)
    while i < out.shape[0]:
        x, y, z, h = p[i, 0], p[i, 1], p[i, 2], given.hold[i]
        g0 = h * (x - given.centre[i, 0]) - given.force[i, 0]
        g1 = h * (y - given.centre[i, 1]) - given.force[i, 1]
        g2 = h * (z - given.centre[i, 2]) - given.force[i, 2]
        e, end = edges.first[i >> 5] + (i & 31), edges.first[(i >> 5) + 1]
        while e < end:
            j = edges.other[e]
            if j == i:
                break
            n0, n1, n2, tension, _ = along(edges, e, x - p[j, 0], y - p[j, 1], z - p[j, 2])
            g0 += tension * n0
            g1 += tension * n1
            g2 += tension * n2
            e += 32
        out[i, 0], out[i, 1], out[i, 2] = g0, g1, g2
        i += cuda.gridsize(1)


@cuda.jit
def rise(edges, given, p, q, which, partials):
    """First stage of the sum g(q) - g(p) [J], with p and q in rows."""
    total = 0.0
    i = cuda.grid(1)
    while i < given.hold.shape[0]:
        for c in range(3):
            middle = 0.5 * (p[i, c] + q[i, c])
            pull = given.hold[i] * (middle - given.centre[i, c]) - given.force[i, c]
            total += (q[i, c] - p[i, c]) * pull
        i += cuda.gridsize(1)
    e = cuda.grid(1)
    while e < edges.ends.shape[0]:
        i, j, k, rest = edges.ends[e, 0], edges.ends[e, 1], edges.strength[e], edges.length[e]
        if rest == rest:
            before, after, change = 0.0, 0.0, 0.0
            for c in range(3):
                v = p[i, c] - p[j, c]
                s = (q[i, c] - p[i, c]) - (q[j, c] - p[j, c])
                before += v * v
                after += (v + s) * (v + s)
                change += s * (2.0 * v + s)
            both = math.sqrt(before) + math.sqrt(after)
            if both > TINY:
                total += k * (change / both) * (0.5 * both - rest)
        else:
            closing, closer = -edges.offset[e], 0.0
            for c in range(3):
                closing += edges.axis[e, c] * (p[i, c] - p[j, c])
                closer += edges.axis[e, c] * ((q[i, c] - p[i, c]) - (q[j, c] - p[j, c]))
            total += k * closer * (closing + 0.5 * closer)
        e += cuda.gridsize(1)
    sums.keep(total, which, partials)


class Kernels(NamedTuple):
    """Hessian kernels for one precision."""

    linearise: Any
    multiply: Any


@cache
def kernels(real: type[np.float32] | type[np.float64]) -> Kernels:
    """Build the kernels that compute in `real`."""

    @cuda.jit
    def linearise(edges, free, p, linear):
        """Write sqrt(a) n and s of each entry of the first `free` rows to linear (4, entries)."""
        i = cuda.grid(1)
        while i < free:
            x, y, z = p[i, 0], p[i, 1], p[i, 2]
            e, end = edges.first[i >> 5] + (i & 31), edges.first[(i >> 5) + 1]
            while e < end:
                j = edges.other[e]
                if j == i:
                    break
                n0, n1, n2, tension, length = along(edges, e, x - p[j, 0], y - p[j, 1], z - p[j, 2])
                k, rest = edges.stiffness[e], edges.rest[e]
                lateral = 0.0
                if rest == 0.0:
                    lateral = k
                elif rest == rest and length > 0.0:
                    lateral = min(tension / length, k)
                root = math.sqrt(k - lateral)
                linear[0, e], linear[1, e], linear[2, e] = real(root * n0), real(root * n1), real(root * n2)
                linear[3, e] = real(lateral)
                e += 32
            i += cuda.gridsize(1)

    @cuda.jit
    def multiply(edges, hold, linear, x, out, which, partials, now):
        """Write H x (f, 3) to `out` and store the first stage of x'H x.

        Do nothing if now[ENDED] is not 0.
        """
        if now[0] != 0.0:
            return
        total, rows = 0.0, x.shape[0]
        i = cuda.grid(1)
        while i < rows:
            x0, x1, x2, h = x[i, 0], x[i, 1], x[i, 2], real(hold[i])
            y0, y1, y2 = h * x0, h * x1, h * x2
            e, end = edges.first[i >> 5] + (i & 31), edges.first[(i >> 5) + 1]
            while e < end:
                j = edges.other[e]
                if j == i:
                    break
                s0, s1, s2 = x0, x1, x2
                if j < rows:
                    s0, s1, s2 = x0 - x[j, 0], x1 - x[j, 1], x2 - x[j, 2]
                r0, r1, r2, lateral = linear[0, e], linear[1, e], linear[2, e], linear[3, e]
                stretch = r0 * s0 + r1 * s1 + r2 * s2
                y0 += lateral * s0 + stretch * r0
                y1 += lateral * s1 + stretch * r1
                y2 += lateral * s2 + stretch * r2
                e += 32
            out[i, 0], out[i, 1], out[i, 2] = y0, y1, y2
            total += np.float64(x0) * np.float64(y0) + np.float64(x1) * np.float64(y1) + np.float64(x2) * np.float64(y2)
            i += cuda.gridsize(1)
        sums.keep(total, which, partials)

    return Kernels(linearise, multiply)
