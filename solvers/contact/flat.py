"""Distance bounds of clusters that are affine images of their rest shape, by projection onto a plane.

Let a and b be points of primitives of two clusters P and Q, and A and B the same points at rest. x_P, F_P and y_i are
those of `solvers.contact.affine`. Let e_1, e_2 span P's plane, projected on which bending is a
second-order effect, and E = (e_1, e_2)'. Then

    |a - b| >= |E (a - b)| >= l |A - B| - z,     l = least eigenvalue of the symmetric part of E F_P (t_1, t_2)
    z = |E (x_Q - x_P - F_P (X_Q - X_P))| + |E (F_Q - F_P)| rho_Q + |E y_i| + |E y_j|

at most, with |A - B| reduced by its part out of the plane. On a linear motion E is constant, l concave and z convex. A
bound that is satisfied at both ends is therefore satisfied between them.

The initial distance is at most |F_P| |A - B| + z without E. The required fraction of it remains where it is less than
the bound, which is linear in |A - B|.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.affine import added, put, unit
from solvers.contact.closest import dot, minus
from solvers.vectors.eights import bits, loaded, root, rows, stored

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Beside(NamedTuple):
    """Pairs of clusters.

    Attributes:
        patches: (k, 2).
        apart: lower bound of the distance at rest [m], (k,).
        there: centre [m] and axes of the second cluster along the plane of the first; its rho [m]; distance of
            both from that plane [m]; (8, k).
    """

    patches: Indices
    apart: Array
    there: Array

    @classmethod
    def room(cls, many: int) -> Beside:
        """Allocate pairs for a capacity, rounded up to a multiple of eight."""
        eights = 8 * (-(-many // 8))
        return cls(np.empty((eights, 2), np.int64), np.empty(eights), np.empty((8, eights)))


class Sight(NamedTuple):
    """Projections of clusters during a motion.

    Attributes:
        e1, e2: axes of the projection (m, 4).
        begin, end: l, the largest stretch, and |E y_i| [m], (m, 4).
        each: cluster indices (m, 1).
    """

    e1: Array
    e2: Array
    begin: Array
    end: Array
    each: Indices

    @classmethod
    def room(cls, many: int) -> Sight:
        """Allocate the projections of a number of clusters."""
        e1, e2, begin, end = np.empty((4, many, 4))
        return cls(e1, e2, begin, end, np.arange(many)[:, None])


@kernel
def relate(known, first, count, out):
    """Compute the relative poses of cluster pairs at rest.

    Args:
        known: clusters at rest.
        first: first pair to compute.
        count: end of the pairs to compute.
        out: cluster pairs, updated.
    """
    for at in range(first // 8 * 8, count, 8):
        end, x, k = count - 1, out.patches, len(out.apart)
        t1, t2, n = rows(known.t1, x, at, end, 0), rows(known.t2, x, at, end, 0), rows(known.normal, x, at, end, 0)
        u1, u2 = rows(known.t1, x, at, end, 1), rows(known.t2, x, at, end, 1)
        way = minus(rows(known.centre, x, at, end, 1), rows(known.centre, x, at, end, 0))
        mine, other = rows(known.size, x, at, end, 0), rows(known.size, x, at, end, 1)
        for slot, v in enumerate((way, u1, u2)):
            stored(dot(t1, v), out.there, 2 * slot * k + at)
            stored(dot(t2, v), out.there, (2 * slot + 1) * k + at)
        stored(other[0], out.there, 6 * k + at)
        off = root(dot(n, way) * dot(n, way)) + _norm(dot(n, u1), dot(n, u2)) * other[0] + mine[1] + other[1]
        stored(off, out.there, 7 * k + at)


@kernel
def doubtful(begin, end, pairs, count, limits, enough, sight, tile, out):
    """Write the cluster pairs that are not proved to be separated during a linear motion.

    Args:
        begin, end: poses at the start and at the end.
        pairs: cluster pairs.
        count: number of pairs to test.
        limits: limits of the distances.
        enough: required distance at the end [m].
        sight, tile: scratch.
        out: clusters of the unresolved pairs (k, 2).

    Returns:
        Number of unresolved pairs, and a lower bound of the end distances of all others [m].
    """
    for first in range(0, len(sight.e1), 8):
        _look(begin, end, first, tile, sight)
    found, least = 0, np.inf
    for first in range(0, count, 8):
        clear, apart = _clear(begin, end, pairs, sight, first, count - 1, limits, enough)
        stored(apart, tile, 0)
        for lane in range(min(8, count - first)):
            if clear >> lane & 1:
                least = min(least, tile[0, lane])
            else:
                out[found, 0], out[found, 1] = pairs.patches[first + lane, 0], pairs.patches[first + lane, 1]
                found += 1
    return found, least


@inner
def _look(begin, end, first, tile, sight):
    """Write the projections of eight clusters."""
    last, x = first + 7, sight.each
    a1, a2 = rows(begin.f1, x, first, last, 0), rows(begin.f2, x, first, last, 0)
    b1, b2 = rows(end.f1, x, first, last, 0), rows(end.f2, x, first, last, 0)
    e1 = unit((a1[0] + b1[0], a1[1] + b1[1], a1[2] + b1[2]))
    e2 = a2[0] + b2[0], a2[1] + b2[1], a2[2] + b2[2]
    e2 = unit(added(e2, 0.0 - dot(e2, e1), e1))
    put(e1, tile, first, sight.e1)
    put(e2, tile, first, sight.e2)
    put(_stretch(begin, x, first, e1, e2, a1, a2), tile, first, sight.begin)
    put(_stretch(end, x, first, e1, e2, b1, b2), tile, first, sight.end)


@inner
def _stretch(lies, x, first, e1, e2, f1, f2):
    """Return l, the largest stretch, and |E y_i| of eight clusters."""
    a, d, b = dot(e1, f1), dot(e2, f2), 0.5 * (dot(e1, f2) + dot(e2, f1))
    least = 0.5 * (a + d) - root(0.25 * (a - d) * (a - d) + b * b)
    a, d, b = dot(f1, f1), dot(f2, f2), dot(f1, f2)
    most = root(0.5 * (a + d) + root(0.25 * (a - d) * (a - d) + b * b))
    left = rows(lies.rest, x, first, first + 7, 0)
    return least, most, left[0] + left[1] * _length(e1, e2, rows(lies.normal, x, first, first + 7, 0))


@inner
def _clear(begin, end, pairs, sight, first, last, limits, enough):
    """Return as bits which of eight pairs are separated, and their distances at the end."""
    e1, e2 = rows(sight.e1, pairs.patches, first, last, 0), rows(sight.e2, pairs.patches, first, last, 0)
    here, there = rows(sight.begin, pairs.patches, first, last, 0), rows(sight.end, pairs.patches, first, last, 0)
    out = loaded(pairs.there, 7 * len(pairs.apart) + first)
    apart = loaded(pairs.apart, first) - out
    z, far = _off(begin, pairs, first, last, e1, e2)
    w, _ = _off(end, pairs, first, last, e1, e2)
    own = rows(begin.rest, pairs.patches, first, last, 0)
    share, most = limits.share, here[1]
    z, w, far = z + here[2] + most * out, w + there[2] + there[1] * out, far + own[0] + own[1] + most * out
    far = limits.closed + share * far
    l, m = here[0] - share * most, there[0] - share * most
    after = there[0] * apart - w
    return bits((apart > 0.0) & (l > 0.0) & (m > 0.0) & (here[0] * apart - z >= limits.reach)
                & (after >= enough) & (l * apart - z >= far) & (m * apart - w >= far)), after  # fmt: skip


@inner
def _off(lies, pairs, first, last, e1, e2):
    """Return z without the first clusters' own part, of eight pairs, and the same without E."""
    room, x = len(pairs.apart), pairs.patches
    f1, f2 = rows(lies.f1, x, first, last, 0), rows(lies.f2, x, first, last, 0)
    c = minus(rows(lies.centre, x, first, last, 1), rows(lies.centre, x, first, last, 0))
    c = _less(c, loaded(pairs.there, first), f1, loaded(pairs.there, room + first), f2)
    g1 = _less(rows(lies.f1, x, first, last, 1), loaded(pairs.there, 2 * room + first), f1,
               loaded(pairs.there, 3 * room + first), f2)  # fmt: skip
    g2 = _less(rows(lies.f2, x, first, last, 1), loaded(pairs.there, 4 * room + first), f1,
               loaded(pairs.there, 5 * room + first), f2)  # fmt: skip
    wide, left = loaded(pairs.there, 6 * room + first), rows(lies.rest, x, first, last, 1)
    a, b, c1, d = dot(e1, g1), dot(e2, g1), dot(e1, g2), dot(e2, g2)
    z = _length(e1, e2, c) + root(a * a + b * b + c1 * c1 + d * d) * wide
    z = z + left[0] + left[1] * _length(e1, e2, rows(lies.normal, x, first, last, 1))
    return z, root(dot(c, c)) + root(dot(g1, g1) + dot(g2, g2)) * wide + left[0] + left[1]


@inner
def _less(v, s, f1, t, f2):
    """Return v - s f_1 - t f_2."""
    return v[0] - s * f1[0] - t * f2[0], v[1] - s * f1[1] - t * f2[1], v[2] - s * f1[2] - t * f2[2]


@inner
def _length(e1, e2, v):
    return _norm(dot(e1, v), dot(e2, v))


@inner
def _norm(a, b):
    return root(a * a + b * b)
