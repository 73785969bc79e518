"""Sparse Cholesky factorisation of a matrix of 3 x 3 blocks, analysed once and factorised repeatedly.

    H x = b,   H symmetric, 3n x 3n, with a block for each entry of a graph of n vertices

The elimination order and the supernodes are those of the graph. A failed factorisation is a regular result and no
error: H is not positive definite.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers import memory
from solvers.linear.block_factor import Fronts, Scratch, factorise, solve
from solvers.linear.block_front import DEPTH, whole
from solvers.linear.symbolic import Symbolic, structure
from solvers.problem import Unsupported
from solvers.vectors.block import ROWS, TILE

_NOTHING = np.empty((0, 3))


class BlockCholesky:
    """Cholesky factorisation of H for one pattern of blocks.

    Factorisations and solves share their arrays, so that they cannot run concurrently.

    Attributes:
        nonzeros: entries of L, including the diagonal.
        flops: multiplications and additions of a factorisation, without padding.
    """

    def __init__(self, graph: csr_array) -> None:
        """Analyse a graph.

        Args:
            graph: pattern (n, n), symmetric, with an entry for each block including the diagonal.

        Raises:
            Unsupported: if the factor does not fit in memory.
        """
        pointers, neighbours = np.asarray(graph.indptr, np.int64), np.asarray(graph.indices, np.int32)
        symbolic = structure(pointers, neighbours)
        self.nonzeros = 9 * symbolic.nonzeros - 3 * (len(pointers) - 1)
        self._fronts = _fronts(pointers, neighbours, symbolic)
        f = self._fronts
        below = np.diff(f.start) - f.own
        w, h = 3.0 * f.own, 3.0 * below
        self.flops = float((w * (w * w / 3.0 + w * h + h * h)).sum())
        room = _room(f, 3 * below * whole(3 * below))
        n, supernodes = len(pointers) - 1, len(f.own)
        needs, free = 8.0 * (f.panel[-1] + 2 * room), memory.of_machine()
        if needs > free:
            raise Unsupported(
                f"a factor of the Hessian has {self.nonzeros:,} entries and takes {memory.in_words(needs)} of memory, "
                f"where {memory.in_words(free)} may be taken; take numba or newton-cg, or a coarser mesh"
            )
        self._panels = np.zeros(f.panel[-1] + ROWS)
        waiting, filled, runs = (np.zeros(k, np.int64) for k in ((2, supernodes + 1), 2, (2, n + 1)))
        front = np.zeros(int((whole(3 * f.own) + whole(3 * below)).max(initial=0)) + ROWS)
        stacks, triangles = np.zeros((2, room)), np.zeros((DEPTH // TILE, TILE, TILE))
        self._scratch = Scratch(front, stacks, waiting, filled, np.zeros(TILE), triangles, runs)

    def factorise(self, values: NDArray[np.float64]) -> bool:
        """Factorise H, with blocks (b, 3, 3) in the graph's order.

        Returns:
            Whether H is positive definite.
        """
        return factorise(self._fronts, values, self._panels, _NOTHING, self._scratch)

    def solve(self, b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return H^-1 b, both (n, 3), with the last factorisation."""
        x = np.array(b, order="C")
        solve(self._fronts, self._panels, x, self._scratch.front, False)
        return x

    def solve_anew(self, values: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Factorise H and return H^-1 b, faster than in two calls.

        Args:
            values: blocks (b, 3, 3) in the graph's order.
            b: right-hand sides (n, 3).

        Returns:
            Solution (n, 3); None if H is not positive definite.
        """
        x = np.array(b, order="C")
        if not factorise(self._fronts, values, self._panels, x, self._scratch):
            return None
        solve(self._fronts, self._panels, x, self._scratch.front, True)
        return x


def _fronts(pointers: NDArray[np.int64], neighbours: NDArray[np.int32], symbolic: Symbolic) -> Fronts:
    """Build the fronts of a symbolic factor, with supernodes renumbered in the order of their elimination."""
    s, sequence = symbolic, symbolic.sequence
    number = np.empty(len(sequence) + 1, np.int64)
    number[sequence] = np.arange(len(sequence))
    number[-1] = -1
    parent = number[s.parent[sequence]]
    own = s.width[sequence].astype(np.int64)
    first, rows = s.first.tolist(), s.row_start.tolist()
    lists = [
        s.vertex[np.append(np.arange(first[k], first[k] + s.width[k]), s.rows[rows[k] : rows[k + 1]])]
        for k in sequence.tolist()
    ]
    start = np.concatenate([[0], np.cumsum([len(x) for x in lists])]).astype(np.int64)
    members = np.concatenate([s.vertex[:0], *lists]).astype(np.int64)
    within = np.full(len(members), -1)
    stack = np.zeros(len(own), np.int64)
    place = np.empty(len(pointers) - 1, np.int64)
    for k in range(len(own) - 1, -1, -1):
        above = parent[k]
        if above >= 0:
            stack[k] = 1 - stack[above]
            list_ = members[start[above] : start[above + 1]]
            place[list_] = np.arange(len(list_))
            within[start[k] + own[k] : start[k + 1]] = place[members[start[k] + own[k] : start[k + 1]]]
    below = np.diff(start) - own
    heights = whole(3 * own) + whole(3 * below)
    panel = np.concatenate([[0], np.cumsum(3 * own * heights)])
    entered = _entered(pointers, neighbours.astype(np.int64), s.slot, start, members, own, heights, panel)
    return Fronts(start, members, own, within, parent, stack, panel, *entered)


def _entered(
    pointers: NDArray[np.int64],
    u: NDArray[np.int64],
    rank: NDArray[np.int32],
    start: NDArray[np.int64],
    members: NDArray[np.int64],
    own: NDArray[np.int64],
    heights: NDArray[np.int64],
    panel: NDArray[np.int64],
) -> tuple[NDArray[np.int64], ...]:
    """Return `entered`, `block`, `entry` and `diagonal` of the fronts.

    A block (v, u), with u not eliminated before v, is stored in the column of v in its supernode's panel, in row u.
    """
    n = len(pointers) - 1
    v = np.repeat(np.arange(n), np.diff(pointers))
    node = np.repeat(np.arange(len(own)), np.diff(start))
    place = np.arange(len(members)) - start[node]
    mine = place < own[node]
    home, column = np.empty((2, n), np.int64)
    home[members[mine]], column[members[mine]] = node[mine], place[mine]
    block = np.flatnonzero(rank[u] >= rank[v])
    block = block[np.argsort(home[v[block]], kind="stable")]
    at = home[v[block]]
    key = node * n + members
    order = np.argsort(key)
    row = place[order[np.searchsorted(key[order], at * n + u[block])]]
    row = np.where(row < own[at], 3 * row, whole(3 * own[at]) + 3 * (row - own[at]))
    entry = panel[at] + 3 * column[v[block]] * heights[at] + row
    return np.searchsorted(at, np.arange(len(own) + 1)), block, entry, np.flatnonzero(u == v)


def _room(fronts: Fronts, sizes: NDArray[np.int64]) -> int:
    """Return the required size of each stack for updates of the given sizes."""
    top, most = [0, 0], 0
    waiting: dict[int, int] = {}  # what waits for a supernode
    for k, (above, side, size) in enumerate(zip(fronts.parent, fronts.stack, sizes, strict=True)):
        most = max(most, top[side] + size)
        top[1 - side] -= waiting.pop(k, 0)
        if above >= 0:
            top[side] += size
            waiting[above] = waiting.get(above, 0) + size
    return int(most)
