"""Sparse Cholesky factorisation optimised for thousands of solves, with three right-hand sides at a time.

    Q = L L';  supernode J with rows B below:  S = L_JJ^-T L_JJ^-1,  W = -L_BJ L_JJ^-1
    Q x = b:   forward b_B += W b_J;  backward x_J = S b_J + W' x_B

A solve thus consists of multiply-adds only, with panels W stored in the order of access, upwards and then downwards.
However W is rounded, a solve applies (I + W)' S (I + W), which is symmetric and positive definite as long as S is. W
may therefore be float16, while S is at least float32. For springs no entry of W exceeds 1: it is the fraction of a
vertex's force that each neighbour takes on.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky
from springbench.solvers.linalg.cholesky.inverse_panels import preserve_column_sums, write_inverse_panels
from springbench.solvers.linalg.cholesky.supernode_amalgamation import COLUMN_LANES, MAX_PANEL_WIDTH
from springbench.solvers.linalg.cholesky.symbolic_factorisation import SymbolicFactor, analyse_graph
from springbench.solvers.linalg.cholesky.thread_team import ThreadTeam
from springbench.solvers.linalg.cholesky.triangular_solve import SupernodalFactor, solve_from_arrays
from springbench.solvers.linalg.matrix_errors import build_definiteness_error, require_finite_rows
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.model.step_problem import Positions

Precision = Literal["float64", "float32", "float16"]

_NUM_PADDING_ROWS = COLUMN_LANES - 1
"""Number of copies of the last row at the end of a supernode's row list, for zero rows that complete a tile."""

_MIN_THREADED_BYTES = 4e6
"""Bytes of panels beyond which a second thread speeds up a single solve (a sheet of 110 vertices a side)."""


class PanelLayout(NamedTuple):
    """Memory layout of the panels of a factor.

    A supernode is divided into chunks of at most MAX_PANEL_WIDTH columns, with a panel each.

    Attributes:
        chunks: (c, 7), of each chunk the offsets of its S, of its W and of its rows in `row_slots`, its columns without
            padding, its rows below with padding, its padded columns divided by COLUMN_LANES, and its first slot.
        first_chunk: first chunk of each supernode, (s + 1,).
        row_slots: of each supernode the slots of its columns and of the rows below, then copies of the last one for
            rows that complete a tile; slots of the top refer to the group's own copy.
        order_by_slot, order_by_vertex: vertices and their slots, group by group in either order (n, 2); unsigned, so
            that indexing needs no test of the sign.
        group_spans: ranges of chunks, vertices and slots of each group, and of the top (groups + 1, 6).
        num_inverse_entries, num_panel_entries: entries of all S and of all W, stored as `panel_products` reads them.
        num_work_rows: rows of four numbers in the work vector.
    """

    chunks: NDArray[np.int64]
    first_chunk: NDArray[np.int64]
    row_slots: NDArray[np.int32]
    order_by_slot: NDArray[np.uint32]
    order_by_vertex: NDArray[np.uint32]
    group_spans: NDArray[np.int64]
    num_inverse_entries: int
    num_panel_entries: int
    num_work_rows: int

    @classmethod
    def from_symbolic(cls, s: SymbolicFactor) -> PanelLayout:
        """Build the layout of a symbolic factor."""
        width, below = s.num_columns.astype(np.int64), np.diff(s.row_start)
        chunk_of, node, done, own, rows, quads = _cut_chunks(width, below)
        squares, panels = COLUMN_LANES**2 * quads**2, rows * quads * COLUMN_LANES
        base = np.concatenate([[0], np.cumsum(width + below + _NUM_PADDING_ROWS)])
        columns = [
            np.cumsum(squares) - squares,
            np.cumsum(panels) - panels,
            base[node] + done + own,
            own,
            rows,
            quads,
            s.first_slot[node] + done,
        ]
        used = np.flatnonzero(s.vertex_of_slot >= 0)
        parts = np.stack([width, below, np.full(len(width), _NUM_PADDING_ROWS)], axis=1)
        kind = np.repeat(np.tile([0, 1, 2], len(width)), parts.ravel())
        places = np.empty(base[-1], np.int32)
        places[kind == 0] = used
        places[kind == 1] = s.rows
        places[kind == 2] = np.repeat(places[base[1:] - _NUM_PADDING_ROWS - 1], _NUM_PADDING_ROWS)

        bounds = s.group_start
        slots = s.first_slot[bounds]
        ends = np.stack([chunk_of[bounds], np.searchsorted(used, slots), slots], axis=1)
        spans = np.stack([ends[:-1], ends[1:]], axis=2).reshape(-1, 6)
        vertex = np.concatenate([np.sort(s.vertex_of_slot[used[i:j]]) for i, j in spans[:, 2:4]])
        top, end = spans[-1, 4:]
        for g, (begin, stop) in enumerate(pairwise(base[bounds[:-1]])):
            part = places[begin:stop]
            part[part >= top] += (g + 1) * (end - top)
        filled = spans[:-1, 0] < spans[:-1, 1]
        filled[0] = True  # at least one group, even if all supernodes are in the top
        spans = spans[np.append(filled, True)]
        rows_of_work = int(end + (len(spans) - 1) * (end - top))
        return cls(
            np.stack(columns, axis=1),
            chunk_of,
            places,
            np.stack([s.vertex_of_slot[used], used], axis=1).astype(np.uint32),
            np.stack([vertex, s.slot_of_vertex[vertex]], axis=1).astype(np.uint32),
            np.ascontiguousarray(spans, np.int64),
            int(squares.sum()),
            int(panels.sum()),
            rows_of_work,
        )


def _cut_chunks(width: NDArray[np.int64], below: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Return `first_chunk`, and per chunk: supernode, preceding columns, own columns, rows below, column quads."""
    many = -(-width // MAX_PANEL_WIDTH)
    chunk_of = np.concatenate([[0], np.cumsum(many)])
    node = np.repeat(np.arange(len(width)), many)
    done = (np.arange(len(node)) - chunk_of[node]) * MAX_PANEL_WIDTH
    own = np.minimum(MAX_PANEL_WIDTH, width[node] - done)
    rows = width[node] - done - own + below[node]
    return chunk_of, node, done, own, -(-rows // COLUMN_LANES) * COLUMN_LANES, -(-own // COLUMN_LANES)


def count_stored_entries(s: SymbolicFactor) -> tuple[int, int]:
    """Return the number of entries of all S and of all W."""
    *_, rows, quads = _cut_chunks(s.num_columns.astype(np.int64), np.diff(s.row_start))
    return int(COLUMN_LANES**2 * quads @ quads), int(COLUMN_LANES * rows @ quads)


def _cast_entries(entries: NDArray[Any], dtype: np.dtype) -> NDArray[Any]:
    """Return the entries in a type; the same array if they have it already."""
    if entries.dtype == dtype:
        return entries
    out = allocate_aligned(len(entries), dtype)
    out[:] = entries
    return out


class SupernodalCholesky:
    """Supernodal Cholesky factorisation of a sparse symmetric positive definite Q.

    The factorisation is in float64. Solves are in float64 for float64 panels, and in float32 for others. Solves of one
    factor share its work vector, so that they cannot run concurrently.

    Attributes:
        nonzeros: entries of L including the diagonal, before padding of supernodes.
        factor_bytes: bytes of all S and W.
        flops: additions and multiplications of a solve, including padding.
        work_shares: fraction of the entries in each group of subtrees, which threads process in parallel, and last in
            the top, which one thread processes.
        inverse_blocks, panels, layout: all S, all W (float16 viewed as uint16), and their layout.
    """

    def __init__(
        self, Q: csr_array, *, precision: Precision = "float64", symbolic_factor: SymbolicFactor | None = None
    ) -> None:
        """Factorise a matrix.

        Args:
            Q: symmetric positive definite matrix (n, n).
            precision: precision of the panels.
            symbolic_factor: the symbolic factor, if it is known.

        Raises:
            NotPositiveDefinite: with a vertex at fault.
        """
        require_finite_rows(Q)
        pointers = np.asarray(Q.indptr, np.int64)
        neighbours = np.asarray(Q.indices, np.int32)
        s = symbolic_factor or analyse_graph(pointers, neighbours)
        layout = PanelLayout.from_symbolic(s)
        cholesky = BlockCholesky(Q, block_size=1, symbolic_factor=s)
        if not cholesky.factorise(np.asarray(Q.data, np.float64).reshape(-1, 1, 1)):
            raise build_definiteness_error(int(cholesky.failed_vertex))
        squares, panels = allocate_aligned(layout.num_inverse_entries), allocate_aligned(layout.num_panel_entries)
        write_inverse_panels(
            cholesky.fronts, cholesky.panels, s.postorder, layout.first_chunk, layout.chunks, squares, panels
        )
        del cholesky  # free its memory before the panels are copied
        self.nonzeros: int | None = s.nonzeros
        work = allocate_aligned(4 * layout.num_work_rows, np.float64 if precision == "float64" else np.float32)
        if precision == "float16":
            preserve_column_sums(panels, panels - panels.astype(np.float16), layout.chunks)
        squares, panels = _cast_entries(squares, work.dtype), _cast_entries(panels, np.dtype(precision))
        if precision == "float16":
            panels = panels.view(np.uint16)  # Numba has arrays of uint16, but not of float16
        self.factor_bytes = squares.nbytes + panels.nbytes
        below, quads = layout.chunks[:, 4:6].T
        entries = COLUMN_LANES * quads * (COLUMN_LANES * quads + 2 * below)
        self.flops = int(2 * 3 * entries.sum())
        self.work_shares = [float(entries[a:e].sum() / max(1, entries.sum())) for a, e in layout.group_spans[:, :2]]
        self.inverse_blocks, self.panels, self.layout = squares, panels, layout
        lists = layout.row_slots, layout.chunks, layout.group_spans, layout.order_by_slot, layout.order_by_vertex
        self._factor = SupernodalFactor(
            squares, panels, *lists, work, ThreadTeam.from_task_count(len(self.work_shares) - 1)
        )
        self._solve_in_thread = TypedKernel(solve_from_arrays)

    def solve(self, b: Positions, out: Positions) -> None:
        """Solve with the factor: write Q^-1 b.

        Args:
            b: right-hand side (n, 3), which is not modified.
            out: output (n, 3), another array than `b`.
        """
        threads = self.choose_num_threads()
        is_usual = threads is None and b.flags.c_contiguous and out.flags.c_contiguous
        solve = self._solve_in_thread.call if is_usual else solve_from_arrays
        solve(*self._factor, b, out, threads)

    def choose_num_threads(self) -> int | None:
        """Return the number of threads of a solve, None for one."""
        threads = min(numba.get_num_threads(), len(self.work_shares) - 1)
        return threads if threads > 1 and self.factor_bytes >= _MIN_THREADED_BYTES else None


def embed_factor(factor: SupernodalCholesky, free: NDArray[np.int64]) -> SupernodalFactor:
    """Embed a factor over the free vertices into vectors of all vertices.

    Args:
        factor: float64 factor of Q's free rows and columns (f, f).
        free: the free vertices (f,).

    Returns:
        Factor with a work vector and thread team of its own; a solve neither reads nor writes the other vertices.
    """
    at = factor.layout
    by_slot, by_vertex = (
        np.stack([free[order[:, 0]], order[:, 1]], axis=1).astype(np.uint32)
        for order in (at.order_by_slot, at.order_by_vertex)
    )
    lists = at.row_slots, at.chunks, at.group_spans, by_slot, by_vertex
    return SupernodalFactor(
        factor.inverse_blocks,
        factor.panels,
        *lists,
        np.zeros(4 * at.num_work_rows),
        ThreadTeam.from_task_count(len(at.group_spans) - 1),
    )
