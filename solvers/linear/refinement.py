"""Refinement of a vertex separator by moves of single vertices.

Fiduccia and Mattheyses 1982; for separators: Ashcraft and Liu 1996.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, part
from solvers.linear.separator import SMALLEST_SIDE

_PASSES = 4
_PATIENCE = 60
"""Number of consecutive moves without improvement after which a refinement pass ends."""


class _Cut(NamedTuple):
    """State of a bisected piece during refinement; its vertices have local indices.

    Attributes:
        pointers, neighbours: graph in CSR form.
        piece: vertex of each local index.
        local: local index of each vertex, -1 outside the piece.
        side: side of each vertex, 2 for the separator.
        counts: number of vertices on each side, (3,).
        pull: neighbours that a move of a separator vertex to a side pulls into the separator, (size, 2).
        moved: whether a vertex has moved in this pass.
        separator: local indices; those that may move come first.
        trail: (local index, previous side) of each change.
    """

    pointers: NDArray[np.int64]
    neighbours: NDArray[np.int32]
    piece: NDArray[np.int32]
    local: NDArray[np.int32]
    side: NDArray[np.int8]
    counts: NDArray[np.int64]
    pull: NDArray[np.int64]
    moved: NDArray[np.bool_]
    separator: NDArray[np.int64]
    trail: NDArray[np.int64]


@part
def refine(pointers, neighbours, piece, side, local):
    """Shrink a separator by moving its vertices to a side.

    A move pulls the neighbours on the other side into the separator. A pass moves each vertex at most once, always the
    one that shrinks the separator most (ties: to the smaller side), and then restores the best state encountered.

    Args:
        pointers, neighbours: graph in CSR form.
        piece: vertices of the piece.
        side: side of each vertex, 2 for the separator; updated.
        local: scratch (n,), -1 on entry and on return.
    """
    size = len(piece)
    counts = np.zeros(3, np.int64)
    for i in range(size):
        local[piece[i]] = i
        counts[side[i]] += 1
    cut = _Cut(
        pointers,
        neighbours,
        piece,
        local,
        side,
        counts,
        np.zeros((size, 2), np.int64),
        np.zeros(size, np.bool_),
        np.empty(size, np.int64),
        np.empty((2 * size, 2), np.int64),
    )
    for _ in range(_PASSES):
        if not _improve(cut):
            break
    for i in range(size):
        local[piece[i]] = -1


@inner
def _improve(cut):
    """Run one pass; return whether it shrank the separator or improved the balance."""
    counts, side, piece, moved, pointers = cut.counts, cut.side, cut.piece, cut.moved, cut.pointers
    moved[:] = False
    listed = 0
    for i in range(len(piece)):
        if side[i] == 2:
            cut.separator[listed] = i
            listed += 1
            _count_pull(cut, i)
    best, best_gap, best_at, at, since = counts[2], abs(counts[0] - counts[1]), 0, 0, 0
    while since < _PATIENCE:
        choice, to = _choose(cut, listed)
        if choice < 0:
            break
        i = cut.separator[choice]
        if at + 1 + pointers[piece[i] + 1] - pointers[piece[i]] > len(cut.trail):
            break
        listed -= 1
        cut.separator[choice] = cut.separator[listed]
        moved[i] = True
        at, listed = _move(cut, i, to, at, listed)
        gap = abs(counts[0] - counts[1])
        if counts[2] < best or (counts[2] == best and gap < best_gap):
            best, best_gap, best_at, since = counts[2], gap, at, 0
        else:
            since += 1
    while at > best_at:
        at -= 1
        i, was = cut.trail[at, 0], cut.trail[at, 1]
        counts[side[i]] -= 1
        counts[was] += 1
        side[i] = was
    return best_at > 0


@inner
def _choose(cut, listed):
    """Return the listed vertex whose move shrinks the separator most, -1 for none, and its target side."""
    counts, pull, limit = cut.counts, cut.pull, (1.0 - SMALLEST_SIDE) * len(cut.piece)
    choice, best, to = -1, -(1 << 60), 0
    for k in range(listed):
        i = cut.separator[k]
        for s in range(2):
            if counts[s] + 1 <= limit:
                key = (1 - pull[i, s]) * 2 + (1 if counts[s] < counts[1 - s] else 0)
                if key > best:
                    choice, best, to = k, key, s
    return choice, to


@inner
def _move(cut, i, to, at, listed):
    """Move i out of the separator, and its neighbours on the other side in; return the ends of log and list."""
    side, pull, local = cut.side, cut.pull, cut.local
    at = _put(cut, i, to, at)
    v = cut.piece[i]
    for e in range(cut.pointers[v], cut.pointers[v + 1]):
        j = local[cut.neighbours[e]]
        if j < 0 or j == i:
            continue
        if side[j] == 2:
            pull[j, 1 - to] += 1
        elif side[j] == 1 - to:
            at = _put(cut, j, 2, at)
            _count_pull(cut, j)
            if not cut.moved[j]:
                cut.separator[listed] = j
                listed += 1
            w = cut.piece[j]
            for f in range(cut.pointers[w], cut.pointers[w + 1]):
                k = local[cut.neighbours[f]]
                if k >= 0 and side[k] == 2:
                    pull[k, to] -= 1
    return at, listed


@inner
def _put(cut, i, side, at):
    """Assign a vertex to a side and log the change; return the end of the log."""
    was = cut.side[i]
    cut.trail[at, 0], cut.trail[at, 1] = i, was
    cut.counts[was] -= 1
    cut.counts[side] += 1
    cut.side[i] = side
    return at + 1


@inner
def _count_pull(cut, i):
    """Count i's neighbours on either side."""
    v = cut.piece[i]
    cut.pull[i, 0] = 0
    cut.pull[i, 1] = 0
    for e in range(cut.pointers[v], cut.pointers[v + 1]):
        j = cut.local[cut.neighbours[e]]
        if j >= 0 and cut.side[j] < 2:
            cut.pull[i, 1 - cut.side[j]] += 1
