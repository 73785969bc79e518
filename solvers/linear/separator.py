"""A small vertex separator of a connected piece of a graph: where a field of distances is cut.

`piece` lists the vertices; `owner[v] == number` tells that v is one of them. A side is 0 or 1, or 2 for the separator.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import part

LANDMARKS = 8
_FEW = 4
"""A sheet shows its directions in the distances from its corners, four of the landmarks; a solid needs all eight."""

TOGETHER = 8
"""Fields are swept so many at a time, as a vector."""


def _fields() -> NDArray[np.int32]:
    """The sums of distances from the landmarks that are tried as coordinates, (blocks, landmarks, TOGETHER).

    The eight corners of a box are its landmarks: of the 35 ways to set four of them against four, three are its
    directions. The first block, for pieces that are flat or long, is content with the first four landmarks.
    """
    few = [[1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1], [1, -1, 0, 0], [0, 0, 1, -1]]
    few += [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    halves = [[1 if i in (0, *three) else -1 for i in range(8)] for three in combinations(range(1, 8), 3)]
    pairs = [[(i == 2 * k) - (i == 2 * k + 1) for i in range(8)] for k in range(4)] + [[1, -1, 1, -1, 1, -1, 0, 0]]
    fields = np.array([[*row, 0, 0, 0, 0] for row in few] + pairs + halves, np.int32)
    return np.ascontiguousarray(fields.reshape(-1, TOGETHER, LANDMARKS).transpose(0, 2, 1))


_FIELDS = _fields()

_SHEET = 1.5
"""A square sheet is cut by the square root of its vertices; more fields are tried where it takes this much more."""

SMALLEST_SIDE = 0.25
"""The least share of the vertices that a side may have."""


@part
def _breadth_first(pointers, neighbours, owner, number, root, dist, queue):
    """Graph distances from `root` within its piece into `dist`, which is -1 there; returns the count of vertices."""
    queue[0] = root
    dist[root] = 0
    head, tail = 0, 1
    while head < tail:
        v = queue[head]
        head += 1
        for e in range(pointers[v], pointers[v + 1]):
            u = neighbours[e]
            if owner[u] == number and dist[u] < 0:
                dist[u] = dist[v] + 1
                queue[tail] = u
                tail += 1
    return tail


@part
def _distances(pointers, neighbours, owner, number, piece, begin, end, dist, queue):
    """Distances of the piece's vertices from landmarks `begin` to `end`, as far apart as may be, into `dist`."""
    far = piece[0]
    if begin == 0:  # the first is where a search from anywhere ends
        for v in piece:
            dist[v, 0] = -1
        far = queue[_breadth_first(pointers, neighbours, owner, number, far, dist[:, 0], queue) - 1]
    for k in range(begin, end):
        farthest = -1
        if k > 0:
            for v in piece:
                nearest = dist[v, 0]
                for i in range(1, k):
                    nearest = min(nearest, dist[v, i])
                if nearest > farthest:
                    farthest, far = nearest, v
        for v in piece:
            dist[v, k] = -1
        _breadth_first(pointers, neighbours, owner, number, far, dist[:, k], queue)


@part
def separate(pointers, neighbours, owner, number, piece, dist, field, queue):
    """The sides (len(piece),) of the best cut of any field, or an empty array where there is none.

    A cut at t parts {field <= t} from the rest; its separator is the boundary of the lower side. Scratch: `dist`
    (n, LANDMARKS), `field` (n, TOGETHER), `queue` (n,).
    """
    size = len(piece)
    best = np.inf
    best_block, best_field, best_cut = -1, 0, 0
    top = np.empty(TOGETHER, np.int32)
    low = np.empty(TOGETHER, np.int32)
    high = np.empty(TOGETHER, np.int32)
    for block in range(len(_FIELDS)):
        if best < _SHEET * np.sqrt(size):
            break
        if block < 2:
            begin, end = (0, _FEW) if block == 0 else (_FEW, LANDMARKS)
            _distances(pointers, neighbours, owner, number, piece, begin, end, dist, queue)
        _combine(dist, _FIELDS[block], piece, field, low, high)
        reach = 0
        for k in range(TOGETHER):
            reach = max(reach, high[k] - low[k])
        count = np.zeros((reach + 2, TOGETHER), np.int32)  # how many have this value
        enter = np.zeros((reach + 2, TOGETHER), np.int32)  # differences of the size of the boundary
        for v in piece:
            for k in range(TOGETHER):
                top[k] = field[v, k]
            for e in range(pointers[v], pointers[v + 1]):
                u = neighbours[e]
                if owner[u] == number:
                    for k in range(TOGETHER):
                        top[k] = max(top[k], field[u, k])
            for k in range(TOGETHER):
                count[field[v, k] - low[k], k] += 1
                enter[field[v, k] - low[k], k] += 1
                enter[top[k] - low[k], k] -= 1
        for k in range(TOGETHER):
            below, boundary = 0, 0
            for cut in range(high[k] - low[k]):
                below += count[cut, k]
                boundary += enter[cut, k]
                left, right = below - boundary, size - below
                if min(left, right) >= SMALLEST_SIDE * (size - boundary):
                    cost = boundary * (1.0 + 2.0 * ((left - right) / size) ** 2)
                    if cost < best:
                        best, best_block, best_field, best_cut = cost, block, k, cut + low[k]
    if best_block < 0 or best > 0.4 * size:
        return np.empty(0, np.int8)
    _combine(dist, _FIELDS[best_block], piece, field, low, high)
    return _sides(pointers, neighbours, owner, number, piece, field[:, best_field], best_cut)


@part
def _sides(pointers, neighbours, owner, number, piece, field, cut):
    """Of each vertex 0 where its field is at most `cut`, 1 where it is more, 2 on the separator."""
    side = np.empty(len(piece), np.int8)
    for i in range(len(piece)):
        v = piece[i]
        side[i] = 1 if field[v] > cut else 0
        if side[i] == 0:
            for e in range(pointers[v], pointers[v + 1]):
                u = neighbours[e]
                if owner[u] == number and field[u] > cut:
                    side[i] = 2
    return side


@part
def _combine(dist, weights, piece, field, low, high):
    """Write weighted sums of distances to `field`, and their least and greatest values to `low` and `high`."""
    low[:] = 2**31 - 1
    high[:] = -(2**31)
    total = np.empty(TOGETHER, np.int32)
    for v in piece:
        total[:] = 0
        for i in range(LANDMARKS):
            d = dist[v, i]
            for k in range(TOGETHER):
                total[k] += weights[i, k] * d
        for k in range(TOGETHER):
            field[v, k] = total[k]
            low[k] = min(low[k], total[k])
            high[k] = max(high[k], total[k])
