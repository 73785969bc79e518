"""Which points, triangles and edges may be near each other, found on a device by a grid of cells.

A cell is as wide as the widest two boxes of primitives are together, half of each, and what they may be apart: boxes
that come so near have their middles in cells that touch. The grid is a table of buckets by a hash of the cells, so that
it has no bounds. Each thread of one kind looks through 27 cells, and sorts what it has found: the list is the same
whatever the order in which threads filled the buckets.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from solvers.contact import closest
from solvers.contact.mollifier import MOLLIFIED
from solvers.cuda.shared import shared
from solvers.cuda.sums import THREADS
from solvers.cuda.target import cuda

_distance = shared(closest.distance)
_LOW = 0xFFFFF
"""Of a cell's number, the bits that its bucket depends on."""


class Cells(NamedTuple):
    """Primitives by cells. width [m]; place (m, 3): of each; start (buckets + 1,), entries (m,): of buckets, of which
    there is a power of two."""

    width: Any
    place: Any
    start: Any
    entries: Any


class Family(NamedTuple):
    """Two kinds that may meet, by rows of vertices. one (m, k), other (l, j): corners; edges: whether they are edges;
    same: whether both are one, of which each pair is wanted once, the lower number first."""

    one: Any
    other: Any
    edges: Any
    same: Any


@cuda.jit(device=True)
def low_and_high(corners, e, axis, p, q):
    """The extent of a primitive on its way from p to q along an axis."""
    low, high = math.inf, -math.inf
    for a in range(corners.shape[1]):
        i = corners[e, a]
        low, high = min(low, p[i, axis], q[i, axis]), max(high, p[i, axis], q[i, axis])
    return low, high


@cuda.jit(device=True)
def bucket(x, y, z, many):
    """Of a cell."""
    mixed = ((x & _LOW) * 73856093) ^ ((y & _LOW) * 19349663) ^ ((z & _LOW) * 83492791)
    return mixed & (many - 1)


@cuda.jit
def widest(corners, p, q, at, out):
    """The largest extent of all, if it is larger than out[at]."""
    most, e = 0.0, cuda.grid(1)
    while e < corners.shape[0]:
        for axis in range(3):
            low, high = low_and_high(corners, e, axis, p, q)
            most = max(most, high - low)
        e += cuda.gridsize(1)
    cuda.atomic.max(out, at, most)


@cuda.jit
def enter(corners, p, q, cells, count):
    """Write where each primitive is, and count those of each bucket."""
    e = cuda.grid(1)
    while e < corners.shape[0]:
        for axis in range(3):
            low, high = low_and_high(corners, e, axis, p, q)
            cells.place[e, axis] = np.int64(math.floor(0.5 * (low + high) / cells.width))
        at = bucket(cells.place[e, 0], cells.place[e, 1], cells.place[e, 2], count.shape[0])
        cuda.atomic.add(count, at, 1)
        e += cuda.gridsize(1)


@cuda.jit
def starts(count, out):
    """Sums of all counts before each, and of all, to `out` (m + 1,); counts become 0. One block."""
    parts = cuda.shared.array(THREADS, np.int64)
    thread, many = cuda.threadIdx.x, count.shape[0]
    each = (many + THREADS - 1) // THREADS
    begin, end, total = min(thread * each, many), min(thread * each + each, many), 0
    for k in range(begin, end):
        total += count[k]
    parts[thread] = total
    cuda.syncthreads()
    before = 0
    for k in range(thread):
        before += parts[k]
    for k in range(begin, end):
        out[k] = before
        before += count[k]
        count[k] = 0
    if end == many:
        out[many] = before


@cuda.jit
def fill(cells, count):
    """Write the primitives of each bucket, in any order."""
    e = cuda.grid(1)
    while e < cells.place.shape[0]:
        at = bucket(cells.place[e, 0], cells.place[e, 1], cells.place[e, 2], count.shape[0])
        cells.entries[cells.start[at] + cuda.atomic.add(count, at, 1)] = e
        e += cuda.gridsize(1)


@cuda.jit(device=True)
def meets(family, e, f, p, q, reach, share, nearer, x):
    """Whether two primitives share no vertex, and come nearer than `reach`, and a share of their distance at p, by
    their boxes; where `nearer`, at p than `reach` by themselves; x (4,): their vertices are written there."""
    k, j = family.one.shape[1], family.other.shape[1]
    for a in range(k):
        x[a] = family.one[e, a]
        for b in range(j):
            x[k + b] = family.other[f, b]
            if x[a] == x[k + b]:
                return False
    size, apart = 0.0, 0.0
    for axis in range(3):
        low, high = low_and_high(family.one, e, axis, p, q)
        begin, end = low_and_high(family.other, f, axis, p, q)
        size, apart = size + max(high, end) - min(low, begin), max(apart, begin - high, low - end)
    if apart > reach + share * size:
        return False
    return not nearer or _distance(p, x, family.edges) < reach


@cuda.jit(device=True)
def found(family, e, p, q, reach, share, nearer, cells, x, first, out):
    """How many primitives one of the first kind meets; they are written to `out` from `first` on, where that is not
    negative."""
    x0, x1, x2, many = 0, 0, 0, 0
    for axis in range(3):
        low, high = low_and_high(family.one, e, axis, p, q)
        at = np.int64(math.floor(0.5 * (low + high) / cells.width))
        x0, x1, x2 = x1, x2, at
    for number in range(27):
        c0, c1, c2 = x0 + number // 9 - 1, x1 + number // 3 % 3 - 1, x2 + number % 3 - 1
        at = bucket(c0, c1, c2, cells.start.shape[0] - 1)
        for k in range(cells.start[at], cells.start[at + 1]):
            f = cells.entries[k]
            here = cells.place[f, 0] == c0 and cells.place[f, 1] == c1 and cells.place[f, 2] == c2
            if not here or (family.same and f <= e) or not meets(family, e, f, p, q, reach, share, nearer, x):
                continue
            if first >= 0:
                out[first + many] = f
            many += 1
    return many


@cuda.jit
def count_met(family, p, q, reach, share, nearer, cells, count):
    """How many each of the first kind meets, to `count`."""
    x = cuda.local.array(4, np.int64)
    e = cuda.grid(1)
    while e < family.one.shape[0]:
        count[e] = found(family, e, p, q, reach, share, nearer, cells, x, -1, cells.entries)
        e += cuda.gridsize(1)


@cuda.jit(device=True)
def ordered(values, begin, end):
    """Sort a few numbers."""
    for k in range(begin + 1, end):
        value, at = values[k], k
        while at > begin and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value


@cuda.jit
def list_met(family, p, q, reach, share, nearer, cells, start, base, out, vertices):
    """Write what each of the first kind meets (k,), in order, and the vertices of all (k, 4) from row `base` on."""
    x = cuda.local.array(4, np.int64)
    e = cuda.grid(1)
    while e < family.one.shape[0]:
        found(family, e, p, q, reach, share, nearer, cells, x, start[e], out)
        ordered(out, start[e], start[e + 1])
        for k in range(start[e], start[e + 1]):
            many = family.one.shape[1]
            for a in range(many):
                vertices[base + k, a] = family.one[e, a]
            for b in range(family.other.shape[1]):
                vertices[base + k, many + b] = family.other[out[k], b]
        e += cuda.gridsize(1)


@cuda.jit
def count_slots(vertices, count):
    """How many pairs have each row as a corner; rows beyond those counted are left out."""
    k = cuda.grid(1)
    while k < 4 * vertices.shape[0]:
        i = vertices[k // 4, k % 4]
        if i < count.shape[0]:
            cuda.atomic.add(count, i, 1)
        k += cuda.gridsize(1)


@cuda.jit
def list_slots(vertices, start, count, out):
    """Write 4 pair + corner of each row, in any order."""
    k = cuda.grid(1)
    while k < 4 * vertices.shape[0]:
        i = vertices[k // 4, k % 4]
        if i < count.shape[0]:
            out[start[i] + cuda.atomic.add(count, i, 1)] = k
        k += cuda.gridsize(1)


@cuda.jit
def sort_slots(start, out):
    """Bring those of each row in order: sums over them are the same to the bit."""
    i = cuda.grid(1)
    while i < start.shape[0] - 1:
        ordered(out, start[i], start[i + 1])
        i += cuda.gridsize(1)


class Rest(NamedTuple):
    """What pairs of a family have from their rest shape. keys (a,), sorted, share (a,): of those that are near there,
    the proportion in which they keep thickness and range; many, first: the key of the pair of e and f is first + many e
    + f; one_length, other_length: of edges [m], one number of what has none; stiffness (n,): of rows [N/m]."""

    keys: Any
    share: Any
    many: Any
    first: Any
    one_length: Any
    other_length: Any
    stiffness: Any


@cuda.jit
def weigh(family, rest, start, base, met, pairs):
    """Write scale, stiffness and e of what each of the first kind meets (see `solvers.contact.contacts.Pairs`)."""
    e = cuda.grid(1)
    while e < family.one.shape[0]:
        for k in range(start[e], start[e + 1]):
            key, low, high = rest.first + rest.many * e + met[k], 0, rest.keys.shape[0]
            while low < high:
                middle = (low + high) // 2
                if rest.keys[middle] < key:
                    low = middle + 1
                else:
                    high = middle
            known = low < rest.keys.shape[0] and rest.keys[low] == key
            pairs.scale[base + k] = rest.share[low] if known else 1.0
            total, own = 0.0, 0
            for a in range(4):
                i = pairs.vertices[base + k, a]
                if i < rest.stiffness.shape[0]:
                    total += rest.stiffness[i]
                    own += 1
            pairs.stiffness[base + k] = total / own
            apart = rest.one_length[e] * rest.other_length[met[k]] if family.edges else 0.0
            pairs.parallel[base + k] = MOLLIFIED * apart * apart
        e += cuda.gridsize(1)
