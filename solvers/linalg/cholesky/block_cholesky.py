"""Sparse Cholesky factorisation of a matrix of 3 x 3 blocks, analysed once and factorised repeatedly.

    H x = b,   H symmetric, 3n x 3n, with a block for each entry of a graph of n vertices

The elimination order and the supernodes are those of the graph. A failed factorisation is a regular result and no
error: H is not positive definite.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.linalg import memory
from springbench.solvers.linalg.cholesky.block_front import PANEL_DEPTH, round_up_rows
from springbench.solvers.linalg.cholesky.block_multifrontal import (
    FactorisationScratch,
    FrontalStructure,
    factorise_blocks,
    solve_blocks,
)
from springbench.solvers.linalg.cholesky.factorisation_schedule import FactorisationSchedule, plan_schedule
from springbench.solvers.linalg.cholesky.symbolic_factorisation import SymbolicFactor, analyse_graph
from springbench.solvers.linalg.cholesky.thread_team import ThreadTeam
from springbench.solvers.model.step_problem import Unsupported
from springbench.solvers.simd.front_tiles import TILE_COLUMNS, TILE_ROWS

_NO_RIGHT_HAND_SIDE = np.empty((0, 3))

_MIN_THREADED_FLOPS = 5e6
"""Operations of a factorisation from which a second thread pays off."""

_MIN_FACTORISATION = 0.2
"""Cost of assembling a matrix whose factorisation fails at once, as a fraction of a factorisation."""


class _Workspace(NamedTuple):
    """What a number of threads needs: its schedule, scratch memory and shared state, and their number or None."""

    schedule: FactorisationSchedule
    scratch: FactorisationScratch
    team: ThreadTeam
    threads: int | None


class BlockCholesky:
    """Cholesky factorisation of H for one pattern of blocks.

    Factorisations and solves share their arrays, so that they cannot run concurrently. They use Numba's number of
    threads; the result does not depend on it.

    Attributes:
        nonzeros: entries of L, including the diagonal.
        flops: multiplications and additions of a factorisation, without padding.
        num_factorisations: factorisations so far; one that fails counts by the operations before it fails.
    """

    def __init__(self, graph: csr_array) -> None:
        """Analyse a graph.

        Args:
            graph: pattern (n, n), symmetric, with an entry for each block including the diagonal.

        Raises:
            Unsupported: if the factor does not fit in memory.
        """
        pointers, neighbours = np.asarray(graph.indptr, np.int64), np.asarray(graph.indices, np.int32)
        symbolic = analyse_graph(pointers, neighbours)
        self.nonzeros = 9 * symbolic.nonzeros - 3 * (len(pointers) - 1)
        self._frontal_structure = _build_frontal_structure(pointers, neighbours, symbolic)
        f = self._frontal_structure
        below = np.diff(f.member_start) - f.num_columns
        w, h = 3.0 * f.num_columns, 3.0 * below
        self._flops = w * (w * w / 3.0 + w * h + h * h)
        self._update_sizes = (3 * below + 1) * round_up_rows(3 * below)
        self.flops = float(self._flops.sum())
        self.num_factorisations = 0.0
        schedule, updates = self._plan(1)
        needs, free = 8.0 * (f.panel_start[-1] + updates), memory.compute_memory_limit()
        if needs > free:
            raise Unsupported(
                f"a factor of the Hessian has {self.nonzeros:,} entries and takes "
                f"{memory.format_bytes(needs)} of memory, "
                f"where {memory.format_bytes(free)} may be taken; take numba or newton-cg, or a coarser mesh"
            )
        self._panels = np.zeros(f.panel_start[-1] + TILE_ROWS)
        self._workspaces = {1: self._allocate(schedule, updates, 1)}

    def _plan(self, threads: int) -> tuple[FactorisationSchedule, int]:
        """Return the schedule for a number of threads, and the entries of its updates."""
        f = self._frontal_structure
        return plan_schedule(f.parent, self._flops, 3 * f.num_columns, self._update_sizes, PANEL_DEPTH, threads)

    def _allocate(self, schedule: FactorisationSchedule, updates: int, threads: int) -> _Workspace:
        f, groups = self._frontal_structure, len(schedule.group_start) - 2
        members = np.diff(f.member_start)
        rows = round_up_rows(3 * f.num_columns) + round_up_rows(3 * (members - f.num_columns))
        scratch = FactorisationScratch(
            np.zeros((threads, int(rows.max(initial=0)) + TILE_ROWS)),
            np.zeros(updates),
            np.zeros(groups + 1, np.int64),
            np.zeros((threads, TILE_COLUMNS)),
            np.zeros((threads, PANEL_DEPTH // TILE_COLUMNS, TILE_COLUMNS, TILE_COLUMNS)),
            np.zeros((threads, 2, int(members.max(initial=0)) + 1), np.int64),
        )
        return _Workspace(schedule, scratch, ThreadTeam.from_task_count(groups), threads if threads > 1 else None)

    def _current_workspace(self) -> _Workspace:
        """Return the workspace for Numba's number of threads, one if a second does not pay off."""
        threads = numba.get_num_threads() if self.flops >= _MIN_THREADED_FLOPS else 1
        if threads not in self._workspaces:
            self._workspaces[threads] = self._allocate(*self._plan(threads), threads)
        return self._workspaces[threads]

    def factorise(self, values: NDArray[np.float64]) -> bool:
        """Factorise H, with blocks (b, 3, 3) in the graph's order.

        Returns:
            Whether H is positive definite.
        """
        return self._factorise(values, _NO_RIGHT_HAND_SIDE)

    def _factorise(self, values: NDArray[np.float64], x: NDArray[np.float64]) -> bool:
        schedule, scratch, team, threads = self._current_workspace()
        failed = factorise_blocks(self._frontal_structure, schedule, values, self._panels, x, scratch, team, threads)
        done = 1.0 if failed < 0 else float(self._flops[:failed].sum()) / self.flops
        self.num_factorisations += max(_MIN_FACTORISATION, done)
        return failed < 0

    def solve(self, b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return H^-1 b, both (n, 3), with the last factorisation."""
        x = np.array(b, order="C")
        schedule, scratch, team, threads = self._current_workspace()
        solve_blocks(self._frontal_structure, schedule, self._panels, x, scratch, team, threads)
        return x

    def factorise_and_solve(self, values: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Factorise H and return H^-1 b, faster than in two calls.

        Args:
            values: blocks (b, 3, 3) in the graph's order.
            b: right-hand sides (n, 3).

        Returns:
            Solution (n, 3); None if H is not positive definite.
        """
        x = np.array(b, order="C")
        return x if self._factorise(values, x) else None


def _build_frontal_structure(
    pointers: NDArray[np.int64], neighbours: NDArray[np.int32], symbolic: SymbolicFactor
) -> FrontalStructure:
    """Build the fronts of a symbolic factor, with supernodes renumbered in the order of their elimination."""
    s, sequence = symbolic, symbolic.postorder
    number = np.empty(len(sequence) + 1, np.int64)
    number[sequence] = np.arange(len(sequence))
    number[-1] = -1
    parent = number[s.parent[sequence]]
    own = s.num_columns[sequence].astype(np.int64)
    first, rows = s.first_slot.tolist(), s.row_start.tolist()
    lists = [
        s.vertex_of_slot[np.append(np.arange(first[k], first[k] + s.num_columns[k]), s.rows[rows[k] : rows[k + 1]])]
        for k in sequence.tolist()
    ]
    start = np.concatenate([[0], np.cumsum([len(x) for x in lists])]).astype(np.int64)
    members = np.concatenate([s.vertex_of_slot[:0], *lists]).astype(np.int64)
    within = np.full(len(members), -1)
    child, sibling = np.full((2, len(own)), -1)
    place = np.empty(len(pointers) - 1, np.int64)
    for k in range(len(own) - 1, -1, -1):
        above = parent[k]
        if above >= 0:
            list_ = members[start[above] : start[above + 1]]
            place[list_] = np.arange(len(list_))
            within[start[k] + own[k] : start[k + 1]] = place[members[start[k] + own[k] : start[k + 1]]]
    for k, above in enumerate(parent.tolist()):
        if above >= 0:
            sibling[k], child[above] = child[above], k
    below = np.diff(start) - own
    heights = round_up_rows(3 * own) + round_up_rows(3 * below)
    panel = np.concatenate([[0], np.cumsum(3 * own * heights)])
    entered = _locate_blocks(
        pointers, neighbours.astype(np.int64), s.slot_of_vertex, start, members, own, heights, panel
    )
    return FrontalStructure(start, members, own, within, parent, child, sibling, panel, *entered)


def _locate_blocks(
    pointers: NDArray[np.int64],
    u: NDArray[np.int64],
    rank: NDArray[np.int32],
    start: NDArray[np.int64],
    members: NDArray[np.int64],
    own: NDArray[np.int64],
    heights: NDArray[np.int64],
    panel: NDArray[np.int64],
) -> tuple[NDArray[np.int64], ...]:
    """Return `block_start`, `block_index`, `entry_offset` and `diagonal_block` of the fronts.

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
    row = np.where(row < own[at], 3 * row, round_up_rows(3 * own[at]) + 3 * (row - own[at]))
    entry = panel[at] + 3 * column[v[block]] * heights[at] + row
    return np.searchsorted(at, np.arange(len(own) + 1)), block, entry, np.flatnonzero(u == v)
