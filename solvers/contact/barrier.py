"""The barrier of pairs: a function of positions, zero from a range on, infinite where the gap closes.

    E(p) = sum over pairs of m k r^2 b((d - t)/r),     b(x) = -(1 - x)^2 ln x  for 0 < x < 1

d is the distance of a point and a triangle, or of two edges; t the thickness, r the range, k a stiffness [N/m] (Li et
al. 2020, "Incremental potential contact", with the offset of Li, Kaufman and Jiang 2021, "Codimensional incremental
potential contact"; there b is of d^2). m is 1 but for edges that are nearly parallel (`contact.mollifier`).

Second derivatives in closed form: with z = sum_i c_i x_i and its free places (`contact.closest`), D = |z|^2/2,

    D'' = c c' (x) I - B G^-1 B',     B_ia = c_i z_a + c_ia z,     G_ab = z_a z_b

so that f(d)'' = f'' g g' + f'/d (c c' (x) (I - n n') - B G^-1 B'), and f' is negative: only the first part of the
bracket bends downwards. `keep` says how much of what bends downwards is kept: with 1 the blocks are exact, with 0 they
are positive semidefinite, and never less than exact ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.closest import WAYS, between, closest, distance
from solvers.contact.mollifier import add_mollified, crossed, mollifier

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Pairs(NamedTuple):
    """Pairs of points and triangles, then of edges. vertices (k, 4); points: how many are of the first kind; scale
    (k,): of thickness and range; stiffness (k,) [N/m]; parallel (k,): e [m^4], 0 of a point and a triangle; thickness,
    reach: t and r [m]."""

    vertices: Indices
    points: int
    scale: Array
    stiffness: Array
    parallel: Array
    thickness: float
    reach: float


@inner
def law(x):
    """b and its first two derivatives, for 0 < x < 1."""
    y, log = 1.0 - x, np.log(x)
    return -y * y * log, y * (2.0 * log - y / x), 4.0 * y / x + y * y / (x * x) - 2.0 * log


@inner
def _pushing(gap):
    """The gap over the range that a pair pushes by: a closed one as if a millionth were left; below 1e-154 b''
    overflows."""
    return max(gap, 1e-100) if gap > 0.0 else 1e-6


@inner
def _gap(pairs, e, p):
    """(d - t)/r of pair e."""
    d = distance(p, pairs.vertices[e], e >= pairs.points)
    return (d / pairs.scale[e] - pairs.thickness) / pairs.reach


def distances(pairs: Pairs, p: Array) -> Array:
    """Of each pair at p (n, 3) [m]."""
    out = np.empty(len(pairs.vertices))
    _distances(pairs, p, out)
    return out


@kernel
def _distances(pairs, p, out):
    for e in range(len(pairs.vertices)):
        out[e] = distance(p, pairs.vertices[e], e >= pairs.points)


@kernel
def value(pairs, p):
    """The energy [J] at p (n, 3); infinite where a gap is closed."""
    total = 0.0
    for e in range(len(pairs.vertices)):
        x = _gap(pairs, e, p)
        if not x < 1.0:
            continue
        if not x > 0.0:
            return np.inf
        r, m = pairs.scale[e] * pairs.reach, 1.0
        if pairs.parallel[e] > 0.0:
            m = mollifier(crossed(p, pairs.vertices[e]).c, pairs.parallel[e])[0]
        total += m * pairs.stiffness[e] * r * r * law(x)[0]
    return total


@kernel
def add_gradient(pairs, p, out):
    """Add the gradient [N] at p (n, 3) to `out`; pairs whose gap is closed push as if a millionth of it were left."""
    for e in range(len(pairs.vertices)):
        x = pairs.vertices[e]
        edges = e >= pairs.points
        c0, c1, c2, c3, _, _ = closest(p, x, edges)
        z0, z1, z2 = between(p, x, c1, c2, c3)
        d = np.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
        gap = (d / pairs.scale[e] - pairs.thickness) / pairs.reach
        if not gap < 1.0:
            continue
        b, first, _ = law(_pushing(gap))
        r, m = pairs.scale[e] * pairs.reach, 1.0
        f, f1 = pairs.stiffness[e] * r * r * b, pairs.stiffness[e] * r * first
        if pairs.parallel[e] > 0.0:
            both = crossed(p, x)
            m, m1, _ = mollifier(both.c, pairs.parallel[e])
            if m1 != 0.0:
                (u0, u1, u2), (v0, v1, v2), uu, uv, vv, _ = both
                w = 2.0 * f * m1
                a0, a1, a2 = w * (vv * u0 - uv * v0), w * (vv * u1 - uv * v1), w * (vv * u2 - uv * v2)
                b0, b1, b2 = w * (uu * v0 - uv * u0), w * (uu * v1 - uv * u1), w * (uu * v2 - uv * u2)
                _add(out, x[0], -1.0, a0, a1, a2)
                _add(out, x[1], 1.0, a0, a1, a2)
                _add(out, x[2], -1.0, b0, b1, b2)
                _add(out, x[3], 1.0, b0, b1, b2)
        w = m * f1 / max(d, 1e-300)
        _add(out, x[0], w * c0, z0, z1, z2)
        _add(out, x[1], w * c1, z0, z1, z2)
        _add(out, x[2], w * c2, z0, z1, z2)
        _add(out, x[3], w * c3, z0, z1, z2)


@inner
def _add(out, i, c, g0, g1, g2):
    out[i, 0] += c * g0
    out[i, 1] += c * g1
    out[i, 2] += c * g2


@kernel
def active(pairs, p, reach, out):
    """Write which pairs have a gap below `reach` times the range at p (n, 3) to `out`; how many they are."""
    count = 0
    for e in range(len(pairs.vertices)):
        if _gap(pairs, e, p) < reach:
            out[count] = e
            count += 1
    return count


@kernel
def press(pairs, which, p, weights, ways, force):
    """Write c (a, 4), z (a, 3) and -f' (a,) [N] of the pairs `which` (a,) at p (n, 3)."""
    for k in range(len(which)):
        e = which[k]
        x = pairs.vertices[e]
        c0, c1, c2, c3, _, _ = closest(p, x, e >= pairs.points)
        z0, z1, z2 = between(p, x, c1, c2, c3)
        weights[k, 0], weights[k, 1], weights[k, 2], weights[k, 3] = c0, c1, c2, c3
        ways[k, 0], ways[k, 1], ways[k, 2] = z0, z1, z2
        gap, m = _gap(pairs, e, p), 1.0
        if pairs.parallel[e] > 0.0:
            m = mollifier(crossed(p, x).c, pairs.parallel[e])[0]
        force[k] = -m * pairs.stiffness[e] * pairs.scale[e] * pairs.reach * law(_pushing(gap))[1]


@kernel
def curve(pairs, which, p, keep, work, out):
    """Write the second derivatives [N/m] of the pairs `which` (a,) at p (n, 3) to `out` (a, 12, 12); work (6, 12):
    scratch. keep: of what bends downwards."""
    for k in range(len(which)):
        _curve(pairs, which[k], p, keep, work, out[k])


@inner
def _curve(pairs, e, p, keep, work, H):
    x = pairs.vertices[e]
    edges = e >= pairs.points
    c0, c1, c2, c3, one, two = closest(p, x, edges)
    z0, z1, z2 = between(p, x, c1, c2, c3)
    d = max(np.sqrt(z0 * z0 + z1 * z1 + z2 * z2), 1e-300)
    gap = (d / pairs.scale[e] - pairs.thickness) / pairs.reach
    if not gap < 1.0:
        H[:, :] = 0.0
        return
    n, c, g, dc, first, second = work[0], work[1], work[2], work[3], work[4], work[5]
    n[0], n[1], n[2] = z0 / d, z1 / d, z2 / d
    c[0], c[1], c[2], c[3] = c0, c1, c2, c3
    b, b1, b2 = law(_pushing(gap))
    r, m, m1, m2 = pairs.scale[e] * pairs.reach, 1.0, 0.0, 0.0
    f, f1, f2 = pairs.stiffness[e] * r * r * b, pairs.stiffness[e] * r * b1, pairs.stiffness[e] * b2
    if pairs.parallel[e] > 0.0:
        m, m1, m2 = mollifier(crossed(p, x).c, pairs.parallel[e])
    across = f1 / d
    lag, hold = _rows(p, x, c, z0, z1, z2, one, two, first, second)
    for i in range(4):
        for a in range(3):
            g[3 * i + a] = c[i] * n[a]
    along = m * (f2 - keep * across)
    for i in range(12):
        for j in range(12):
            H[i, j] = along * g[i] * g[j] - m * across * (lag * first[i] * first[j] + hold * second[i] * second[j])
    side = keep * m * across
    for i in range(4):
        for j in range(4):
            for a in range(3):
                H[3 * i + a, 3 * j + a] += side * c[i] * c[j]
    if m1 != 0.0:
        add_mollified(crossed(p, x), (m, m1, m2), (f, f1, f2), keep, g, dc, H)


@inner
def _rows(p, x, c, z0, z1, z2, one, two, first, second):
    """The columns of B, made orthogonal by G: the weights of their squares in B G^-1 B'."""
    first[:], second[:] = 0.0, 0.0
    if one < 0:
        return 0.0, 0.0
    a0, a1, a2 = _way(p, x, one, c, z0, z1, z2, first)
    length = a0 * a0 + a1 * a1 + a2 * a2
    if two < 0:
        return 1.0 / length, 0.0
    b0, b1, b2 = _way(p, x, two, c, z0, z1, z2, second)
    mixed = (a0 * b0 + a1 * b1 + a2 * b2) / length
    n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    for i in range(12):
        second[i] -= mixed * first[i]
    return 1.0 / length, length / (n0 * n0 + n1 * n1 + n2 * n2)


@inner
def _way(p, x, way, c, z0, z1, z2, out):
    """z_a, and its column of B in `out` (12,)."""
    w0, w1, w2, w3 = WAYS[way, 0], WAYS[way, 1], WAYS[way, 2], WAYS[way, 3]
    a0, a1, a2 = between(p, x, w1, w2, w3)
    for i in range(4):
        w = w0 if i == 0 else w1 if i == 1 else w2 if i == 2 else w3
        out[3 * i] = c[i] * a0 + w * z0
        out[3 * i + 1] = c[i] * a1 + w * z1
        out[3 * i + 2] = c[i] * a2 + w * z2
    return a0, a1, a2
