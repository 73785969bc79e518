"""Which half-space keeps each vertex out of a convex obstacle during one step.

An obstacle is a box of its own frame with a radius around it: all points within R of the box. A sphere is a box
without extent, a capsule one along an axis, a plane the top of one that has no other end. In the obstacle's frame a
vertex goes from a straight to b, where it would end by its velocity alone. The distance f to the box along that way
is convex, and so Newton's method for f = R, from a on, never passes the first contact. At each of its iterates the
plane through the nearest point, R outwards, has the obstacle on the one side and a on the other; the last one touches
the first contact, or does not cut the way at all. A vertex that ends on the outer side of it has not been inside the
obstacle on the way, wherever it ends.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel

_ITERATIONS = 40
_CONTACT = 1e-6
"""Of R: so near to the obstacle a way has reached it."""


class Rounded(NamedTuple):
    """A box from low to high (3,) [m], and a radius R [m] around it."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    radius: float


class HalfSpaces(NamedTuple):
    """n.x >= d of vertices (k,), in the world at the step's end: normal (k, 3), offset d (k,) [m], and carried (k, 3)
    [m]: where the vertex would be had it moved with the obstacle."""

    vertices: NDArray[np.int64]
    normal: NDArray[np.float64]
    offset: NDArray[np.float64]
    carried: NDArray[np.float64]


@kernel
def near(p, v, dt, frames, low, high, out):
    """Whether vertices could come near obstacles, by a box around all of them, to `out` (o,).

    p (n, 3) [m], v (n, 3) [m/s]; frames (o, 2, 4, 3): origin and axes of each obstacle's frame at the step's start and
    end; low, high (o, 3) [m]: corners, in its frame, of what is near an obstacle. Returns the largest displacement
    dt |v| [m], and -1 where no obstacle is near.
    """
    x0, x1, x2, y0, y1, y2, square = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf, 0.0
    for i in range(len(p)):
        p0, p1, p2 = p[i, 0], p[i, 1], p[i, 2]
        x0, x1, x2 = min(x0, p0), min(x1, p1), min(x2, p2)
        y0, y1, y2 = max(y0, p0), max(y1, p1), max(y2, p2)
        square = max(square, v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
    way, found = dt * np.sqrt(square), -1.0
    for k in range(len(out)):
        out[k] = True
        for c in range(3):
            begin, end = _extent(frames[k, 0], c, x0, x1, x2, y0, y1, y2)
            other, last = _extent(frames[k, 1], c, x0, x1, x2, y0, y1, y2)  # less than `way` from where they end
            out[k] &= min(begin, other - way) <= high[k, c] + way and max(end, last + way) >= low[k, c] - way
        found = way if out[k] else found
    return found


@inner
def _extent(frame, c, x0, x1, x2, y0, y1, y2):
    """The least and the largest coordinate c in a frame of a box from x to y."""
    e0, e1, e2, o = frame[1 + c, 0], frame[1 + c, 1], frame[1 + c, 2], frame[0]
    middle = e0 * (0.5 * (x0 + y0) - o[0]) + e1 * (0.5 * (x1 + y1) - o[1]) + e2 * (0.5 * (x2 + y2) - o[2])
    half = 0.5 * (abs(e0) * (y0 - x0) + abs(e1) * (y1 - x1) + abs(e2) * (y2 - x2))
    return middle - half, middle + half


@kernel
def planes(p, v, dt, frames, obstacle, margin, out, work):
    """Write the half-spaces of the vertices that may come near one obstacle to the first k rows of `out`; returns k.

    frames (2, 4, 3) as in `near`; obstacle: Rounded, in its frame; margin [m]: a vertex farther away than that and
    twice its way has none; out: HalfSpaces of n rows; work: (5, 3).
    """
    count = 0
    for i in range(len(p)):
        if plane(p, v, i, dt, frames, obstacle, margin, out, count, work):
            out.vertices[count] = i
            count += 1
    return count


@inner
def plane(p, v, i, dt, frames, obstacle, margin, out, at, work):
    """Whether a vertex may come near an obstacle; then its half-space is in the row `at` of `out`. See `planes`."""
    _, normal, offset, carried = out
    a, b, x, c, n = work[0], work[1], work[2], work[3], work[4]
    first, second, way = frames[0], frames[1], 0.0
    for k in range(3):
        a[k] = b[k] = 0.0
        for j in range(3):
            a[k] += first[1 + k, j] * (p[i, j] - first[0, j])
            b[k] += second[1 + k, j] * (p[i, j] + dt * v[i, j] - second[0, j])
        way += (b[k] - a[k]) ** 2
    far = _nearest(a, obstacle, c, n)
    if not far <= obstacle.radius + margin + 2.0 * np.sqrt(way):
        return False
    _separate(a, b, obstacle, far, x, c, n)
    offset[at] = obstacle.radius
    for j in range(3):
        normal[at, j], carried[at, j] = 0.0, second[0, j]
        for k in range(3):
            normal[at, j] += n[k] * second[1 + k, j]
            carried[at, j] += a[k] * second[1 + k, j]
    for k in range(3):
        offset[at] += n[k] * c[k] + normal[at, k] * second[0, k]
    return True


@inner
def _separate(a, b, obstacle, far, x, c, n):
    """Newton's method along the way from a to b; c and n, the nearest point and the normal, are those at a, and then
    those of the half-space; x: scratch."""
    begin, end, slope, radius = 0.0, np.inf, _slope(a, b, n), obstacle.radius
    for _ in range(_ITERATIONS):
        if far <= (1.0 + _CONTACT) * radius or slope >= 0.0:
            break
        s = begin - (far - radius) / slope
        if s >= 1.0:
            break
        if s >= end:
            s = 0.5 * (begin + end)
        for k in range(3):
            x[k] = a[k] + s * (b[k] - a[k])
        there = _nearest(x, obstacle, c, n)
        steep = _slope(a, b, n)
        if steep < 0.0:
            begin, far, slope = s, there, steep
        else:  # past the nearest point of the way: the obstacle is not met
            end = s
    for k in range(3):
        x[k] = a[k] + begin * (b[k] - a[k])
    _nearest(x, obstacle, c, n)


@inner
def _slope(a, b, n):
    return n[0] * (b[0] - a[0]) + n[1] * (b[1] - a[1]) + n[2] * (b[2] - a[2])


@inner
def _nearest(x, obstacle, c, n):
    """The distance from x to the box, negative inside, the nearest point of its surface to c, the normal there to n."""
    low, high, _ = obstacle
    square, least, axis, side = 0.0, np.inf, 0, 1.0
    for k in range(3):
        c[k] = min(max(x[k], low[k]), high[k])
        n[k] = x[k] - c[k]
        square += n[k] * n[k]
        if high[k] - x[k] < least:
            least, axis, side = high[k] - x[k], k, 1.0
        if x[k] - low[k] < least:
            least, axis, side = x[k] - low[k], k, -1.0
    if square > 0.0:
        far = np.sqrt(square)
        for k in range(3):
            n[k] /= far
        return far
    n[:] = 0.0
    n[axis], c[axis] = side, high[axis] if side > 0.0 else low[axis]
    return -least
