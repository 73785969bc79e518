"""Additive continuous collision detection (CCD): the largest collision-free step size along a displacement.

    t <- t + .9 (d(t) - closed)/l,     l = upper bound of the speed at which the distance d of the pair shrinks

Source: Li, Kaufman and Jiang 2021, "Codimensional incremental potential contact", section 5. The common translation of
a pair is removed first, which gives a tighter bound l. Pairs that are farther apart than they can move are discarded in
8-lane packets. Each pair retains at least a twentieth of its initial gap, which is far more than round-off.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.boxes import larger, smaller
from solvers.contact.closest import distance, dot, edge_edge_way, minus, point_triangle_way
from solvers.problem import Positions
from solvers.vectors.eights import bits, loaded, lowest, root, rows, stored, where

LEFT = 0.1
"""Fraction of the initial gap at which the CCD of a pair stops; each step leaves at least half of it."""

_WIDER = 1.0 + 1e-12
"""Factor on displacements, so that round-off discards no pair."""

_LOOKS = 500
"""Maximum number of CCD iterations of one pair; if they do not suffice, the last iterate is used, which is safe."""


def scratch() -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Allocate the scratch arrays `four`, `corners` and `way` of the CCD."""
    return np.empty(4, np.int64), np.empty((4, 3)), np.empty((4, 3))


@kernel
def largest(pairs, p, direction, most, four, corners, way):
    """Return the largest step size that keeps all candidate pairs separated, on linear trajectories.

    Args:
        pairs: point-triangle pairs, then edge-edge pairs.
        p: positions (n, 4) [m]; column 3 is padding.
        direction: displacements (n, 4) [m]; column 3 is padding.
        most: upper bound of the step size.
        four, corners, way: scratch, (4,), (4, 3) and (4, 3).

    Returns:
        Step size in [0, most]; 0 if a pair starts closer than its minimum distance.
    """
    for k in range(4):
        four[k] = k
    end, edges = pairs.points, False
    for _ in range(2):
        begin, end = (end, len(pairs.vertices)) if edges else (0, end)
        for first in range(begin, end, 8):
            left = _reached(pairs, p, direction, most, first, end - 1, edges)
            while left != 0:
                e = first + lowest(left)
                left &= left - 1
                if e < end:
                    most = min(most, free(pairs, e, p, direction, most, edges, four, corners, way))
            if most == 0.0:
                return 0.0
        edges = True
    return most


@inner
def _reached(pairs, p, direction, most, first, last, edges):
    """Return as bits which of eight pairs can reach each other, by distances and displacement lengths alone."""
    x = pairs.vertices
    a, b, c, d = (rows(p, x, first, last, 0), rows(p, x, first, last, 1), rows(p, x, first, last, 2),
                  rows(p, x, first, last, 3))  # fmt: skip
    z = edge_edge_way(a, b, c, d)[4] if edges else point_triangle_way(a, b, c, d)[4]
    a, b, c, d = (rows(direction, x, first, last, 0), rows(direction, x, first, last, 1),
                  rows(direction, x, first, last, 2), rows(direction, x, first, last, 3))  # fmt: skip
    mean = _mean(a, b, c, d, 0), _mean(a, b, c, d, 1), _mean(a, b, c, d, 2)
    l0, l1, l2, l3 = _size(a, mean), _size(b, mean), _size(c, mean), _size(d, mean)
    speed = _more(l0, l1) + _more(l2, l3) if edges else l0 + _more(l1, _more(l2, l3))
    return 255 & ~bits((root(dot(z, z)) - pairs.thickness) * (1.0 - LEFT) >= _WIDER * most * speed)


@inner
def _mean(a, b, c, d, axis):
    return 0.25 * (a[axis] + b[axis] + c[axis] + d[axis])


@inner
def _size(a, mean):
    a = minus(a, mean)
    return root(dot(a, a))


@inner
def _more(a, b):
    return where(a > b, a, b)


@inner
def free(pairs, e, p, direction, most, edges, four, corners, way):
    """Return the largest step size in [0, most] that keeps one pair separated.

    Args:
        pairs: the candidate pairs.
        e: index of the pair.
        p: positions (n, 4) [m].
        direction: displacements (n, 4) [m].
        most: upper bound of the step size.
        edges: whether the pair is one of edges.
        four, corners, way: scratch, (4,), (4, 3) and (4, 3).
    """
    x = pairs.vertices[e]
    speed = _relative(p, direction, x, edges, corners, way)
    closed = pairs.scale[e] * pairs.thickness
    gap = distance(p, x, edges) - closed
    if not gap > 0.0:
        return 0.0
    return most if gap * (1.0 - LEFT) >= most * speed else _one(corners, way, four, edges, gap, closed, speed, most)


@inner
def _one(corners, way, four, edges, gap, closed, speed, most):
    least, t = LEFT * gap, 0.9 * (1.0 - LEFT) * gap / speed
    done = 0.0
    for _ in range(_LOOKS):
        if t >= most:
            return most
        for k in range(4):
            for a in range(3):
                corners[k, a] += (t - done) * way[k, a]
        done = t
        gap = distance(corners, four, edges) - closed
        if gap <= least:
            return t
        t += 0.9 * (gap - 0.5 * least) / speed
    return done


@inner
def _relative(p, direction, x, edges, corners, way):
    """Write corners (4, 3) relative to the first one and displacements without their mean; return the closing speed."""
    for a in range(3):
        mean = 0.25 * (direction[x[0], a] + direction[x[1], a] + direction[x[2], a] + direction[x[3], a])
        for k in range(4):
            corners[k, a] = p[x[k], a] - p[x[0], a]
            way[k, a] = direction[x[k], a] - mean
    l0, l1, l2, l3 = _length(way, 0), _length(way, 1), _length(way, 2), _length(way, 3)
    return max(l0, l1) + max(l2, l3) if edges else l0 + max(l1, l2, l3)


@inner
def _length(way, k):
    return np.sqrt(way[k, 0] ** 2 + way[k, 1] ** 2 + way[k, 2] ** 2)


def unevenness(p: Positions, q: Positions) -> float:
    """Return the largest displacement of any two vertices relative to each other.

    Args:
        p: start positions, contiguous (n, 3) [m].
        q: end positions, contiguous (n, 3) [m].

    Returns:
        Upper bound [m]; infinite if a coordinate is not finite.
    """
    return _unevenness(p, q, np.empty((9, 8)))


@kernel
def _unevenness(p, q, tile):
    """Return the diagonal [m] of the bounding box of all q - p; tile (9, 8): scratch."""
    whole = len(p) // 8
    tile[:3], tile[3:6], tile[6:] = np.inf, -np.inf, 0.0
    if whole > 0:
        # Three consecutive registers contain x y z x y z ... of eight vertices.
        x, y, z = loaded(q, 0) - loaded(p, 0), loaded(q, 8) - loaded(p, 8), loaded(q, 16) - loaded(p, 16)
        low, high, nothing = (x, y, z), (x, y, z), (0.0 * x, 0.0 * y, 0.0 * z)
        for k in range(24, 24 * whole, 24):
            x, y, z = (
                loaded(q, k) - loaded(p, k),
                loaded(q, k + 8) - loaded(p, k + 8),
                loaded(q, k + 16) - loaded(p, k + 16),
            )
            low, high = smaller((x, y, z), low), larger((x, y, z), high)
            nothing = nothing[0] + 0.0 * x, nothing[1] + 0.0 * y, nothing[2] + 0.0 * z
        for k in range(3):
            stored(low[k], tile, 8 * k)
            stored(high[k], tile, 24 + 8 * k)
            stored(nothing[k], tile, 48 + 8 * k)
    square, known = 0.0, 0.0
    for axis in range(3):
        least, most = np.inf, -np.inf
        for k in range(axis, 24, 3):
            least, most = min(least, tile[k // 8, k % 8]), max(most, tile[3 + k // 8, k % 8])
            known += tile[6 + k // 8, k % 8]
        for i in range(8 * whole, len(p)):
            d = q[i, axis] - p[i, axis]
            least, most, known = min(least, d), max(most, d), known + 0.0 * d
        square += (most - least) ** 2 if most > least else 0.0
    return np.sqrt(square) if known == 0.0 else np.inf


@kernel
def alike(x, p, most):
    """Return whether all vertices are translated equally, up to a tolerance.

    Args:
        x: start positions (n, 4) [m]; column 3 is padding.
        p: end positions (n, 3) [m].
        most: tolerance along each axis [m].
    """
    a, b, c = p[0, 0] - x[0, 0], p[0, 1] - x[0, 1], p[0, 2] - x[0, 2]
    for i in range(len(p)):
        d, e, f = p[i, 0] - x[i, 0] - a, p[i, 1] - x[i, 1] - b, p[i, 2] - x[i, 2] - c
        if not (abs(d) <= most and abs(e) <= most and abs(f) <= most):
            return False
    return True
