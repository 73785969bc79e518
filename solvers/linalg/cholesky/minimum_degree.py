"""Halo minimum degree ordering of a small piece of a graph.

The vertices around the piece (its halo) count in degrees but are not eliminated.

The elimination graph is stored as a bit matrix with one row per vertex of the piece. Eliminating v merges v's row into
those of its neighbours. Degrees are exact, without a quotient graph, which is faster at a hundred vertices.
"""

from __future__ import annotations

import numpy as np
from springbench.solvers.jit.kernel_compilation import cached_njit, jit_inner_allocating


@jit_inner_allocating
def _popcount(word):
    """Return the number of ones in a 64-bit word (Warren, Hacker's Delight, section 5-1)."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@jit_inner_allocating
def order_subgraph(pointers, neighbours, piece, local):
    """Sort a piece of a graph into minimum degree order.

    Args:
        pointers, neighbours: graph in CSR form.
        piece: vertices of the piece, reordered in place.
        local: scratch (n,), -1 on entry and on return.
    """
    size = len(piece)
    members = size
    halo = []
    for i in range(size):
        local[piece[i]] = i
    for v in piece:
        for e in range(pointers[v], pointers[v + 1]):
            u = neighbours[e]
            if local[u] < 0:
                local[u] = members
                members += 1
                halo.append(u)
    words = (members + 63) // 64
    rows = np.zeros((size, words), np.uint64)
    degree = np.zeros(size, np.int64)
    for i in range(size):
        v = piece[i]
        for e in range(pointers[v], pointers[v + 1]):
            j = local[neighbours[e]]
            rows[i, j >> 6] |= np.uint64(1) << np.uint64(j & 63)
        rows[i, i >> 6] |= np.uint64(1) << np.uint64(i & 63)
        for w in range(words):
            degree[i] += _popcount(rows[i, w])
    for i in range(size):
        local[piece[i]] = -1
    for u in halo:
        local[u] = -1

    vertices = piece.copy()
    gone = members + 1
    for place in range(size):
        best = 0
        for i in range(size):
            if degree[i] < degree[best]:
                best = i
        piece[place] = vertices[best]
        degree[best] = gone
        rows[best, best >> 6] &= ~(np.uint64(1) << np.uint64(best & 63))
        for w in range((size + 63) // 64):
            word = rows[best, w]
            while word != 0:
                lowest = word & (~word + np.uint64(1))
                word ^= lowest
                i = w * 64 + _popcount(lowest - np.uint64(1))
                if i >= size:  # the remaining bits are those of the halo
                    break
                rows[i, best >> 6] &= ~(np.uint64(1) << np.uint64(best & 63))
                degree[i] = 0
                for k in range(words):
                    rows[i, k] |= rows[best, k]
                    degree[i] += _popcount(rows[i, k])


@cached_njit()
def minimum_degree_order(pointers, neighbours, order):
    """Sort all vertices of a graph into minimum degree order.

    Args:
        pointers, neighbours: graph in CSR form.
        order: all vertices (n,), reordered in place.
    """
    order_subgraph(pointers, neighbours, order, np.full(len(order), -1, np.int32))
