"""Small vertex separator of a connected piece, as a level set of graph distances.

`piece` lists the vertices; `owner[v] == number` marks v as one of them. A side is 0 or 1, or 2 for the separator.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner_allocating

NUM_LANDMARKS = 8
_NUM_FLAT_LANDMARKS = 4
"""Distances from four landmarks, the corners of a sheet, resolve its directions; a solid needs all eight landmarks."""

FIELDS_PER_BLOCK = 8
"""Fields that are processed at a time, as a vector."""


def _build_fields() -> NDArray[np.int32]:
    """Return the weights of the distance sums used as coordinates, (blocks, landmarks, FIELDS_PER_BLOCK).

    The landmarks of a box are its eight corners. Of the 35 partitions into four and four of them, three correspond to
    its directions. The first block, for flat or long pieces, uses only the first four landmarks.
    """
    few = [[1, -1, 1, -1], [1, -1, -1, 1], [1, 1, -1, -1], [1, -1, 0, 0], [0, 0, 1, -1]]
    few += [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    halves = [[1 if i in (0, *three) else -1 for i in range(8)] for three in combinations(range(1, 8), 3)]
    pairs = [[(i == 2 * k) - (i == 2 * k + 1) for i in range(8)] for k in range(4)] + [[1, -1, 1, -1, 1, -1, 0, 0]]
    fields = np.array([[*row, 0, 0, 0, 0] for row in few] + pairs + halves, np.int32)
    return np.ascontiguousarray(fields.reshape(-1, FIELDS_PER_BLOCK, NUM_LANDMARKS).transpose(0, 2, 1))


_FIELD_WEIGHTS = _build_fields()

_SHEET_FACTOR = 1.5
"""Further fields are tried if a separator exceeds this times the square root of the size, that of a square sheet."""

MIN_SIDE_FRACTION = 0.25
"""Minimum fraction of the vertices on a side."""


@jit_inner_allocating
def _breadth_first_search(pointers, neighbours, owner, number, root, dist, queue):
    """Write graph distances from `root` within its piece to `dist`, initially -1.

    The result is the number of vertices reached.
    """
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


@jit_inner_allocating
def _landmark_distances(pointers, neighbours, owner, number, piece, begin, end, dist, queue):
    """Write distances from landmarks `begin` to `end` to `dist`.

    The landmarks are chosen as far apart as possible.
    """
    far = piece[0]
    if begin == 0:  # the first landmark is the last vertex of a search from any vertex
        for v in piece:
            dist[v, 0] = -1
        far = queue[_breadth_first_search(pointers, neighbours, owner, number, far, dist[:, 0], queue) - 1]
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
        _breadth_first_search(pointers, neighbours, owner, number, far, dist[:, k], queue)


@jit_inner_allocating
def find_separator(pointers, neighbours, owner, number, piece, dist, field, queue):
    """Return the sides of the best cut of any field.

    A cut at t separates {field <= t} from the rest; its separator is the boundary of the lower side.

    Args:
        pointers, neighbours: graph in CSR form.
        owner: piece of each vertex (n,).
        number: number of this piece.
        piece: its vertices.
        dist, field, queue: scratch, (n, NUM_LANDMARKS), (n, FIELDS_PER_BLOCK) and (n,).

    Returns:
        Sides (len(piece),); empty if there is no suitable cut.
    """
    size = len(piece)
    best = np.inf
    best_block, best_field, best_cut = -1, 0, 0
    top = np.empty(FIELDS_PER_BLOCK, np.int32)
    low = np.empty(FIELDS_PER_BLOCK, np.int32)
    high = np.empty(FIELDS_PER_BLOCK, np.int32)
    for block in range(len(_FIELD_WEIGHTS)):
        if best < _SHEET_FACTOR * np.sqrt(size):
            break
        if block < 2:
            begin, end = (0, _NUM_FLAT_LANDMARKS) if block == 0 else (_NUM_FLAT_LANDMARKS, NUM_LANDMARKS)
            _landmark_distances(pointers, neighbours, owner, number, piece, begin, end, dist, queue)
        _combine_distances(dist, _FIELD_WEIGHTS[block], piece, field, low, high)
        reach = 0
        for k in range(FIELDS_PER_BLOCK):
            reach = max(reach, high[k] - low[k])
        count = np.zeros((reach + 2, FIELDS_PER_BLOCK), np.int32)  # number of vertices with a value
        enter = np.zeros((reach + 2, FIELDS_PER_BLOCK), np.int32)  # differences of the size of the boundary
        for v in piece:
            for k in range(FIELDS_PER_BLOCK):
                top[k] = field[v, k]
            for e in range(pointers[v], pointers[v + 1]):
                u = neighbours[e]
                if owner[u] == number:
                    for k in range(FIELDS_PER_BLOCK):
                        top[k] = max(top[k], field[u, k])
            for k in range(FIELDS_PER_BLOCK):
                count[field[v, k] - low[k], k] += 1
                enter[field[v, k] - low[k], k] += 1
                enter[top[k] - low[k], k] -= 1
        for k in range(FIELDS_PER_BLOCK):
            below, boundary = 0, 0
            for cut in range(high[k] - low[k]):
                below += count[cut, k]
                boundary += enter[cut, k]
                left, right = below - boundary, size - below
                if min(left, right) >= MIN_SIDE_FRACTION * (size - boundary):
                    cost = boundary * (1.0 + 2.0 * ((left - right) / size) ** 2)
                    if cost < best:
                        best, best_block, best_field, best_cut = cost, block, k, cut + low[k]
    if best_block < 0 or best > 0.4 * size:
        return np.empty(0, np.int8)
    _combine_distances(dist, _FIELD_WEIGHTS[best_block], piece, field, low, high)
    return _assign_sides(pointers, neighbours, owner, number, piece, field[:, best_field], best_cut)


@jit_inner_allocating
def _assign_sides(pointers, neighbours, owner, number, piece, field, cut):
    """Return the side of each vertex.

    It is 0 up to the cut, 1 above it, and 2 on the separator.
    """
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


@jit_inner_allocating
def _combine_distances(dist, weights, piece, field, low, high):
    """Write weighted sums of distances to `field`; `low` and `high`: their minima and maxima."""
    low[:] = 2**31 - 1
    high[:] = -(2**31)
    total = np.empty(FIELDS_PER_BLOCK, np.int32)
    for v in piece:
        total[:] = 0
        for i in range(NUM_LANDMARKS):
            d = dist[v, i]
            for k in range(FIELDS_PER_BLOCK):
                total[k] += weights[i, k] * d
        for k in range(FIELDS_PER_BLOCK):
            field[v, k] = total[k]
            low[k] = min(low[k], total[k])
            high[k] = max(high[k], total[k])
