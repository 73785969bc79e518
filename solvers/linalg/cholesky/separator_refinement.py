"""Refinement of a vertex separator by moves of single vertices.

Fiduccia and Mattheyses 1982; for separators: Ashcraft and Liu 1996.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_inner_allocating
from springbench.solvers.linalg.cholesky.vertex_separator import MIN_SIDE_FRACTION

_MAX_PASSES = 4
_MAX_STALLED_MOVES = 60
"""Number of consecutive moves without improvement after which a refinement pass ends."""


class _SeparatorState(NamedTuple):
    """State of a bisected piece during refinement; its vertices have local indices.

    Attributes:
        pointers, neighbours: graph in CSR form.
        piece: vertex of each local index.
        local_index: local index of each vertex, -1 outside the piece.
        side: side of each vertex, 2 for the separator.
        side_counts: number of vertices on each side, (3,).
        pulled_neighbours: neighbours that a move of a separator vertex to a side pulls into the separator, (size, 2).
        is_locked: whether a vertex has moved in this pass.
        separator: local indices; those that may move come first.
        move_log: (local index, previous side) of each change.
    """

    pointers: NDArray[np.int64]
    neighbours: NDArray[np.int32]
    piece: NDArray[np.int32]
    local_index: NDArray[np.int32]
    side: NDArray[np.int8]
    side_counts: NDArray[np.int64]
    pulled_neighbours: NDArray[np.int64]
    is_locked: NDArray[np.bool_]
    separator: NDArray[np.int64]
    move_log: NDArray[np.int64]


@jit_inner_allocating
def refine_separator(pointers, neighbours, piece, side, local):
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
    cut = _SeparatorState(
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
    for _ in range(_MAX_PASSES):
        if not _run_refinement_pass(cut):
            break
    for i in range(size):
        local[piece[i]] = -1


@jit_inner
def _run_refinement_pass(cut):
    """Run one pass; return whether it shrank the separator or improved the balance."""
    counts, side, piece, moved, pointers = cut.side_counts, cut.side, cut.piece, cut.is_locked, cut.pointers
    moved[:] = False
    listed = 0
    for i in range(len(piece)):
        if side[i] == 2:
            cut.separator[listed] = i
            listed += 1
            _count_pulled_neighbours(cut, i)
    best, best_gap, best_at, at, since = counts[2], abs(counts[0] - counts[1]), 0, 0, 0
    while since < _MAX_STALLED_MOVES:
        choice, to = _select_move(cut, listed)
        if choice < 0:
            break
        i = cut.separator[choice]
        if at + 1 + pointers[piece[i] + 1] - pointers[piece[i]] > len(cut.move_log):
            break
        listed -= 1
        cut.separator[choice] = cut.separator[listed]
        moved[i] = True
        at, listed = _apply_move(cut, i, to, at, listed)
        gap = abs(counts[0] - counts[1])
        if counts[2] < best or (counts[2] == best and gap < best_gap):
            best, best_gap, best_at, since = counts[2], gap, at, 0
        else:
            since += 1
    while at > best_at:
        at -= 1
        i, was = cut.move_log[at, 0], cut.move_log[at, 1]
        counts[side[i]] -= 1
        counts[was] += 1
        side[i] = was
    return best_at > 0


@jit_inner
def _select_move(cut, listed):
    """Return the move that shrinks the separator most: list position, -1 for none, and side."""
    counts, pull, limit = cut.side_counts, cut.pulled_neighbours, (1.0 - MIN_SIDE_FRACTION) * len(cut.piece)
    choice, best, to = -1, -(1 << 60), 0
    for k in range(listed):
        i = cut.separator[k]
        for s in range(2):
            if counts[s] + 1 <= limit:
                key = (1 - pull[i, s]) * 2 + (1 if counts[s] < counts[1 - s] else 0)
                if key > best:
                    choice, best, to = k, key, s
    return choice, to


@jit_inner
def _apply_move(cut, i, to, at, listed):
    """Move i out of the separator, and its neighbours on the other side in.

    The results are the new ends of the log and of the list.
    """
    side, pull, local = cut.side, cut.pulled_neighbours, cut.local_index
    at = _assign_side(cut, i, to, at)
    v = cut.piece[i]
    for e in range(cut.pointers[v], cut.pointers[v + 1]):
        j = local[cut.neighbours[e]]
        if j < 0 or j == i:
            continue
        if side[j] == 2:
            pull[j, 1 - to] += 1
        elif side[j] == 1 - to:
            at = _assign_side(cut, j, 2, at)
            _count_pulled_neighbours(cut, j)
            if not cut.is_locked[j]:
                cut.separator[listed] = j
                listed += 1
            w = cut.piece[j]
            for f in range(cut.pointers[w], cut.pointers[w + 1]):
                k = local[cut.neighbours[f]]
                if k >= 0 and side[k] == 2:
                    pull[k, to] -= 1
    return at, listed


@jit_inner
def _assign_side(cut, i, side, at):
    """Assign a vertex to a side and log the change; return the log's end."""
    was = cut.side[i]
    cut.move_log[at, 0], cut.move_log[at, 1] = i, was
    cut.side_counts[was] -= 1
    cut.side_counts[side] += 1
    cut.side[i] = side
    return at + 1


@jit_inner
def _count_pulled_neighbours(cut, i):
    """Count i's neighbours on either side."""
    v = cut.piece[i]
    cut.pulled_neighbours[i, 0] = 0
    cut.pulled_neighbours[i, 1] = 0
    for e in range(cut.pointers[v], cut.pointers[v + 1]):
        j = cut.local_index[cut.neighbours[e]]
        if j >= 0 and cut.side[j] < 2:
            cut.pulled_neighbours[i, 1 - cut.side[j]] += 1
