"""The barrier of pairs on a device, a thread a pair: energy, gradient and blocks, friction, and the largest safe step.

The functions are the processor's: closest points (`solvers.contact.contacts`), the barrier and its second derivatives,
and additive continuous collision detection. There closest points that several pairs share are one contact; here each
pair has its own, which has the same sum. What a pair does to its vertices is written down, and gathered by vertices in
the order of pairs: sums are the same each time.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from solvers.contact import barrier, closest, contacts, curvature, grip, mollifier, ways
from solvers.contact.contacts import Contacts, Pairs
from solvers.cuda import sums
from solvers.cuda.shared import shared
from solvers.cuda.target import cuda
from solvers.kernels import half_spaces

_at, _dot = shared(closest.at), shared(closest.dot)
_point_triangle, _edge_edge = shared(closest.point_triangle_way), shared(closest.edge_edge_way)
_take, _press, _forces = shared(contacts.take), shared(barrier.press), shared(barrier.forces)
_terms, _weighed, _summed = shared(curvature.terms), shared(curvature.weighed), shared(curvature.summed)
_crossed, _turned, _free = shared(mollifier.crossed), shared(mollifier.turned), shared(ways.free)
_slipped, _rounded, _rate = shared(grip.slipped), shared(grip.rounded), shared(grip.rate)
_bends, _bent, _combined = shared(grip.bends), shared(grip.bent), shared(grip.combined)
_solved = shared(half_spaces.solved)
_Pairs, _Contacts = Pairs, Contacts


class Acts(NamedTuple):
    """What pairs do at a point. own (k,): which of the four corners take part, as bits, none out of range; force (k, 4,
    3) [N]: the gradient; block (k, 4, 6) [N/m]: the upper triangles of the diagonal blocks, where these are wanted."""

    own: Any
    force: Any
    block: Any


class Grips(NamedTuple):
    """Pairs that grip in a step: see `solvers.contact.grip.Grip`. force: 0 of those that do not; own: as in `Acts`."""

    vertices: Any
    weights: Any
    normal: Any
    anchor: Any
    force: Any
    own: Any


@cuda.jit(device=True)
def contact(pairs, e, p, corner, one, tile, slot, out):
    """Whether a pair is in range at p; then the contact that it is goes to `out`, by its corners (4, 3), which are
    written. one: a pair, tile (9, 1), slot (1,): scratch."""
    edges, x = e >= pairs.points, pairs.vertices[e]
    a, b, c, d = _at(p, x[0]), _at(p, x[1]), _at(p, x[2]), _at(p, x[3])
    tile[8, 0] = 0.0
    if edges:
        tile[0, 0], tile[1, 0], tile[2, 0], tile[3, 0], z, tile[8, 0] = _edge_edge(a, b, c, d)
    else:
        tile[0, 0], tile[1, 0], tile[2, 0], tile[3, 0], z = _point_triangle(a, b, c, d)
    squared, limit = _dot(z, z), pairs.thickness + pairs.reach
    if not squared < limit * limit:
        return False
    tile[4, 0], tile[5, 0], tile[6, 0], tile[7, 0] = z[0], z[1], z[2], squared
    for k in range(4):
        one.vertices[0, k] = k
        for axis in range(3):
            corner[k, axis] = p[x[k], axis]
    one.scale[0], one.stiffness[0], one.parallel[0] = pairs.scale[e], pairs.stiffness[e], pairs.parallel[e]
    slot[0] = -1
    return _take(one, 0, edges, tile, 0, slot, out, 0) > 0


@cuda.jit(device=True, inline="always")
def space(pairs):
    """Scratch of `contact`, in memory of the thread."""
    corner = cuda.local.array((4, 3), np.float64)
    four, numbers = cuda.local.array((1, 4), np.int64), cuda.local.array((3, 1), np.float64)
    one = _Pairs(four, pairs.points, numbers[0], numbers[1], numbers[2], pairs.thickness, pairs.reach)
    tile, slot = cuda.local.array((9, 1), np.float64), cuda.local.array(1, np.int32)
    vertices, kind = cuda.local.array((1, 4), np.int64), cuda.local.array(1, np.int64)
    weights, between = cuda.local.array((1, 4), np.float64), cuda.local.array((1, 3), np.float64)
    more = cuda.local.array((4, 1), np.float64)
    out = _Contacts(vertices, kind, weights, between, more[0], more[1], more[2], more[3], pairs.thickness, pairs.reach)
    return corner, one, tile, slot, out


@cuda.jit(device=True)
def corners_of(contact):
    """The corners that take part in a contact, as bits."""
    own = 0
    for i in range(min(contact.kind[0], 4)):
        own |= 1 << contact.vertices[0, i]
    return own


@cuda.jit
def press(pairs, many, p, acts, which, partials):
    """Write what the barriers do at rows p (n, 3); the first stage of their energy and of how many are in range."""
    corner, one, tile, slot, found = space(pairs)
    total, near, e = 0.0, 0.0, cuda.grid(1)
    while e < many:
        acts.own[e] = 0
        if contact(pairs, e, p, corner, one, tile, slot, found):
            force = acts.force[e]
            for k in range(4):
                force[k, 0], force[k, 1], force[k, 2] = 0.0, 0.0, 0.0
            total += _press(found, corner, force)
            near += 1.0
            acts.own[e] = corners_of(found)
        e += cuda.gridsize(1)
    sums.keep(total, which, partials)
    sums.keep(near, which + 1, partials)


@cuda.jit
def curve(pairs, many, p, acts):
    """Write the blocks of the barriers at rows p (n, 3), where `press` was asked last, nothing of what bends downwards
    kept."""
    corner, one, tile, slot, found = space(pairs)
    work, e = cuda.local.array((4, 12), np.float64), cuda.grid(1)
    while e < many:
        if acts.own[e] and contact(pairs, e, p, corner, one, tile, slot, found):
            terms = _terms(found, 0, corner, 0.0, work)
            for i in range(min(found.kind[0], 4)):
                diagonal(found, terms, corner, i, work, acts.block[e, found.vertices[0, i]])
        e += cuda.gridsize(1)


@cuda.jit(device=True)
def diagonal(found, terms, corner, i, work, out):
    """Write the upper triangle of the block of a contact's vertex i with itself."""
    c, entry = found.weights[0, i], 0
    for a in range(3):
        weights = _weighed(terms, work, 3 * i + a)
        for b in range(a, 3):
            s = 3 * i + b
            h = _summed(weights, work[0, s], work[1, s], work[2, s], work[3, s])
            if a == b:
                h += terms.side * c * c
            if terms.turn != 0.0:
                one, other = _turned(_crossed(corner, found.vertices[0]), terms.turn, 0.0, a, b)
                h += one if i < 2 else other
            out[entry] = h
            entry += 1


@cuda.jit
def hold(pairs, many, p, begun, friction, grips, which, partials):
    """Write which pairs grip at rows p in a step that starts at rows `begun`; the first stage of how many."""
    corner, one, tile, slot, found = space(pairs)
    force = cuda.local.array(1, np.float64)
    near, e = 0.0, cuda.grid(1)
    while e < many:
        grips.force[e], grips.own[e] = 0.0, 0
        if contact(pairs, e, p, corner, one, tile, slot, found):
            _forces(found, force)
            z, c = found.between[0], found.weights[0]
            length = math.sqrt(z[0] * z[0] + z[1] * z[1] + z[2] * z[2])
            for axis in range(3):
                grips.normal[e, axis] = z[axis] / length
            for k in range(4):
                grips.weights[e, k] = 0.0
            for i in range(min(found.kind[0], 4)):
                grips.weights[e, found.vertices[0, i]] = c[i]
            for axis in range(3):
                grips.anchor[e, axis] = _combined(grips.vertices[e], grips.weights[e], begun, axis)
            grips.force[e], grips.own[e] = friction * force[0], corners_of(found)
            near += 1.0
        e += cuda.gridsize(1)
    sums.keep(near, which, partials)


@cuda.jit
def slip(many, grips, s, p, acts, which, partials):
    """Write what friction does at rows p; the first stage of its energy. s: of `solvers.contact.grip` [m]."""
    total, e = 0.0, cuda.grid(1)
    while e < many:
        acts.own[e] = grips.own[e]
        if grips.own[e]:
            force, (u0, u1, u2, length) = grips.force[e], _slipped(grips, p, e)
            pull, second = force * _rate(length, s), _bends(u0, u1, u2, length, s)
            total += force * _rounded(length, s)
            for k in range(4):
                c, entry = grips.weights[e, k], 0
                act = acts.force[e, k]
                act[0], act[1], act[2] = c * (pull * u0), c * (pull * u1), c * (pull * u2)
                for a in range(3):
                    for b in range(a, 3):
                        acts.block[e, k, entry] = c * c * (force * _bent(grips.normal[e], second, a, b))
                        entry += 1
        e += cuda.gridsize(1)
    sums.keep(total, which, partials)


@cuda.jit
def gather(first, slots, acts, fresh, out):
    """Add the gradient by rows to `out` (n, 3) [N], which is overwritten where `fresh`."""
    i = cuda.grid(1)
    while i < first.shape[0] - 1:
        g0, g1, g2 = 0.0, 0.0, 0.0
        if not fresh:
            g0, g1, g2 = out[i, 0], out[i, 1], out[i, 2]
        for k in range(first[i], first[i + 1]):
            e, corner = slots[k] // 4, slots[k] % 4
            if acts.own[e] >> corner & 1:
                f = acts.force[e, corner]
                g0, g1, g2 = g0 + f[0], g1 + f[1], g2 + f[2]
        out[i, 0], out[i, 1], out[i, 2] = g0, g1, g2
        i += cuda.gridsize(1)


@cuda.jit
def gather_blocks(first, slots, acts, near, out):
    """Add four times the blocks by rows to `out` (n, 6) [N/m], and tell which rows have any."""
    i = cuda.grid(1)
    while i < first.shape[0] - 1:
        for k in range(first[i], first[i + 1]):
            e, corner = slots[k] // 4, slots[k] % 4
            if acts.own[e] >> corner & 1:
                near[i] = True
                for a in range(6):
                    out[i, a] += 4.0 * acts.block[e, corner, a]
        i += cuda.gridsize(1)


@cuda.jit
def reach(pairs, many, p, way, most):
    """most[0] becomes the largest part, if it is less, by which all pairs may go from p along a way, rows (n, 3)."""
    four, corner, own = (
        cuda.local.array(4, np.int64),
        cuda.local.array((4, 3), np.float64),
        cuda.local.array((4, 3), np.float64),
    )
    for k in range(4):
        four[k] = k
    least, e = 1.0, cuda.grid(1)
    while e < many:
        least = min(least, _free(pairs, e, p, way, least, e >= pairs.points, four, corner, own))
        e += cuda.gridsize(1)
    cuda.atomic.min(most, 0, least)


@cuda.jit
def total_way(p, q, which, partials):
    """The first stage of the sum of q - p, in rows."""
    t0, t1, t2, i = 0.0, 0.0, 0.0, cuda.grid(1)
    while i < p.shape[0]:
        t0, t1, t2 = t0 + (q[i, 0] - p[i, 0]), t1 + (q[i, 1] - p[i, 1]), t2 + (q[i, 2] - p[i, 2])
        i += cuda.gridsize(1)
    sums.keep(t0, which, partials)
    sums.keep(t1, which + 1, partials)
    sums.keep(t2, which + 2, partials)


@cuda.jit
def farthest(p, q, now):
    """now[:3]: the sum of q - p; now[3], now[4] become, if they are less: the largest |q - p|^2 but for the mean, and
    the largest coordinate of p."""
    most, size, i = 0.0, 0.0, cuda.grid(1)
    while i < p.shape[0]:
        square = 0.0
        for c in range(3):
            away = q[i, c] - p[i, c] - now[c] / p.shape[0]
            square += away * away
            size = max(size, abs(p[i, c]))
        most = max(most, square)
        i += cuda.gridsize(1)
    cuda.atomic.max(now, 3, most)
    cuda.atomic.max(now, 4, size)


@cuda.jit
def without_mean(q, now, out):
    """Write q less the mean way to it."""
    i = cuda.grid(1)
    while i < q.shape[0]:
        for c in range(3):
            out[i, c] = q[i, c] - now[c] / q.shape[0]
        i += cuda.gridsize(1)


@cuda.jit
def compare(before, after, p, q, which, partials):
    """The first stage of |after q|, after (q - p) and before (q - p), of gradients before and after, in rows."""
    size, rising, rose, i = 0.0, 0.0, 0.0, cuda.grid(1)
    while i < before.shape[0]:
        for c in range(3):
            step = q[i, c] - p[i, c]
            size += abs(after[i, c] * q[i, c])
            rising += after[i, c] * step
            rose += before[i, c] * step
        i += cuda.gridsize(1)
    sums.keep(size, which, partials)
    sums.keep(rising, which + 1, partials)
    sums.keep(rose, which + 2, partials)
