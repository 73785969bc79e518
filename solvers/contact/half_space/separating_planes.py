"""Separating planes: the half-space that contains each vertex outside a convex obstacle during one step.

An obstacle is a box in its own frame, rounded by a radius R: all points within R of the box. A sphere is a box without
extent, a capsule a box along one axis, and a plane the top of a box that is unbounded below. In the obstacle's frame a
vertex moves linearly from a to b, where it would end by its velocity alone. The distance f to the box along this line
is convex. Newton's method for f = R, started at a, therefore never passes the time of impact. At each iterate, the
plane through the closest point, displaced outwards by R, separates the obstacle from a. The last one touches the first
point of contact, or does not intersect the line at all. A vertex that ends on the outer side of this plane has not been
inside the obstacle on its path.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel

_MAX_ITERATIONS = 40
_CONTACT_TOLERANCE = 1e-6
"""Tolerance relative to R within which a vertex has reached the obstacle."""


class RoundedBox(NamedTuple):
    """A box from low to high (3,) [m], rounded by a radius R [m]."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    radius: float


class SeparatingPlanes(NamedTuple):
    """Half-spaces n.x >= d in world coordinates at the step's end.

    Attributes:
        vertices: (k,).
        normal: unit normals n (k, 3).
        offset: d [m], (k,).
        comoving_position: position of the vertex if it moved with the obstacle [m], (k, 3).
    """

    vertices: NDArray[np.int64]
    normal: NDArray[np.float64]
    offset: NDArray[np.float64]
    comoving_position: NDArray[np.float64]


@jit_kernel
def find_nearby_obstacles(p, v, dt, frames, low, high, out):
    """Find which obstacles any vertex could reach, by the bounding box of all vertices.

    Args:
        p: positions (n, 3) [m].
        v: velocities (n, 3) [m/s].
        dt: time step [s].
        frames: origin and axes of each obstacle's frame at the step's start and end, (o, 2, 4, 3).
        low, high: corners of each obstacle's activation region in its frame [m], (o, 3).
        out: whether each obstacle can be reached, (o,); overwritten.

    Returns:
        The largest displacement dt |v| [m]; -1 if no obstacle can be reached.
    """
    x0, x1, x2, y0, y1, y2, square = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf, 0.0
    for i in range(len(p)):
        p0, p1, p2 = p[i, 0], p[i, 1], p[i, 2]
        x0, x1, x2 = min(x0, p0), min(x1, p1), min(x2, p2)
        y0, y1, y2 = max(y0, p0), max(y1, p1), max(y2, p2)
        square = max(square, v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
    travel, found = dt * np.sqrt(square), -1.0
    for k in range(len(out)):
        out[k] = True
        for c in range(3):
            begin, end = _project_box(frames[k, 0], c, x0, x1, x2, y0, y1, y2)
            # Vertices end less than `travel` from p, whose box is therefore extended by that in the end frame.
            other, last = _project_box(frames[k, 1], c, x0, x1, x2, y0, y1, y2)
            out[k] &= (
                min(begin, other - travel) <= high[k, c] + travel and max(end, last + travel) >= low[k, c] - travel
            )
        found = travel if out[k] else found
    return found


@jit_inner
def _project_box(frame, c, x0, x1, x2, y0, y1, y2):
    """Return the range of a frame's coordinate c in the box from x to y."""
    e0, e1, e2, o = frame[1 + c, 0], frame[1 + c, 1], frame[1 + c, 2], frame[0]
    middle = e0 * (0.5 * (x0 + y0) - o[0]) + e1 * (0.5 * (x1 + y1) - o[1]) + e2 * (0.5 * (x2 + y2) - o[2])
    half = 0.5 * (abs(e0) * (y0 - x0) + abs(e1) * (y1 - x1) + abs(e2) * (y2 - x2))
    return middle - half, middle + half


@jit_kernel
def build_separating_planes(p, v, dt, frames, obstacle, margin, out, work):
    """Write the half-spaces of the vertices that may reach one obstacle.

    They are written to the first k rows of `out`.

    Args:
        p: positions (n, 3) [m].
        v: velocities (n, 3) [m/s].
        dt: time step [s].
        frames: frame at the step's start and end, (2, 4, 3).
        obstacle: rounded box in its frame.
        margin: distance [m], in addition to twice its displacement, beyond which a vertex gets no half-space.
        out: separating planes of n rows.
        work: scratch (5, 3).

    Returns:
        The number of half-spaces k.
    """
    count = 0
    for i in range(len(p)):
        if write_separating_plane(p, v, i, dt, frames, obstacle, margin, out, count, work):
            out.vertices[count] = i
            count += 1
    return count


@jit_inner
def write_separating_plane(p, v, i, dt, frames, obstacle, margin, out, row_index, work):
    """Write the half-space of one vertex, if it may reach an obstacle.

    Args:
        p: positions (n, 3) [m].
        v: velocities (n, 3) [m/s].
        i: index of the vertex.
        dt: time step [s].
        frames: frame at the step's start and end, (2, 4, 3).
        obstacle: rounded box in its frame.
        margin: distance [m], in addition to twice its displacement, beyond which a vertex gets no half-space.
        out: separating planes, of which all but `vertices` are written.
        row_index: row of `out`.
        work: scratch (5, 3).

    Returns:
        Whether the vertex may reach the obstacle; otherwise `out` is unchanged.
    """
    _, normal, offset, carried = out
    a, b, x, c, n = work[0], work[1], work[2], work[3], work[4]
    first, second, travel = frames[0], frames[1], 0.0
    for k in range(3):
        a[k] = b[k] = 0.0
        for j in range(3):
            a[k] += first[1 + k, j] * (p[i, j] - first[0, j])
            b[k] += second[1 + k, j] * (p[i, j] + dt * v[i, j] - second[0, j])
        travel += (b[k] - a[k]) ** 2
    far = _closest_box_point(a, obstacle, c, n)
    if not far <= obstacle.radius + margin + 2.0 * np.sqrt(travel):
        return False
    _find_separating_plane(a, b, obstacle, far, x, c, n)
    offset[row_index] = obstacle.radius
    for j in range(3):
        normal[row_index, j], carried[row_index, j] = 0.0, second[0, j]
        for k in range(3):
            normal[row_index, j] += n[k] * second[1 + k, j]
            carried[row_index, j] += a[k] * second[1 + k, j]
    for k in range(3):
        offset[row_index] += n[k] * c[k] + normal[row_index, k] * second[0, k]
    return True


@jit_inner
def _find_separating_plane(a, b, obstacle, far, x, c, n):
    """Find the separating plane by Newton's method along the line from a to b.

    c and n, the closest point and the normal, are those of a on entry and those of the half-space on return; x:
    scratch.
    """
    begin, end, slope, radius = 0.0, np.inf, _directional_derivative(a, b, n), obstacle.radius
    for _ in range(_MAX_ITERATIONS):
        if far <= (1.0 + _CONTACT_TOLERANCE) * radius or slope >= 0.0:
            break
        s = begin - (far - radius) / slope
        if s >= 1.0:
            break
        if s >= end:
            s = 0.5 * (begin + end)
        for k in range(3):
            x[k] = a[k] + s * (b[k] - a[k])
        there = _closest_box_point(x, obstacle, c, n)
        steep = _directional_derivative(a, b, n)
        if steep < 0.0:
            begin, far, slope = s, there, steep
        else:  # past the nearest point of the path: the obstacle is not reached
            end = s
    for k in range(3):
        x[k] = a[k] + begin * (b[k] - a[k])
    _closest_box_point(x, obstacle, c, n)


@jit_inner
def _directional_derivative(a, b, n):
    return n[0] * (b[0] - a[0]) + n[1] * (b[1] - a[1]) + n[2] * (b[2] - a[2])


@jit_inner
def _closest_box_point(x, obstacle, c, n):
    """Return the signed distance of x from the box.

    c and n are overwritten with the closest surface point and the normal there.
    """
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
