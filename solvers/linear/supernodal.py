"""A sparse Cholesky factorisation made to be solved with thousands of times, three right-hand sides at a time.

    Q = L L';  supernode J with rows B below:  S = L_JJ^-T L_JJ^-1,  W = -L_BJ L_JJ^-1
    Q x = b:   forwards b_B += W b_J;  backwards x_J = S b_J + W' x_B

A solve is then multiply-adds alone, over panels W that lie in the order in which they are read, upwards and then
downwards. Whatever W is rounded to, a solve applies (I + W)' S (I + W), which is symmetric and positive definite as
long as S is: so W may be float16, and S is not less than float32. For springs W has no entry above 1: it says what
part of a vertex's force each neighbour takes on.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.linear.supernodal_factor import Matrix, Panels, factorise, keep_sums
from solvers.linear.supernodal_solve import Factor, solve_by
from solvers.linear.supernodes import LANES, WIDTH
from solvers.linear.symbolic import Symbolic, structure
from solvers.linear.team import Team
from solvers.memory import aligned
from solvers.problem import NotPositiveDefinite, Positions

Precision = Literal["float64", "float32", "float16"]

_SPARE = LANES - 1
"""Names that a supernode's list of rows has behind the last one, copies of that: for rows of zeros that fill a tile."""

_WORTH_THREADS = 4e6
"""Bytes of panels from which a single solve gains by waking a second thread (a sheet of 110 vertices a side)."""


class Layout(NamedTuple):
    """Where the panels of a factor lie. A supernode is cut into chunks of at most WIDTH columns, a panel each.

    chunks (c, 7): of each the offsets of its S, of its W and of the slots of its rows in `places`, its columns
    without padding, its rows below with padding, its padded columns in LANES, its first slot; chunk_of (s + 1,): the
    first chunk of each supernode; places: of each supernode the slots of its columns, of the rows below, in a group's
    own copy where they are in the top, and the last one again for rows that fill up a tile; by_slot, by_vertex, spans:
    see `supernodal_solve` (unsigned: no test of the sign when indexing); squares, panels: entries in all S and in all
    W, which lie as `supernodal_vectors` reads them; rows: of four numbers, of the work vector.
    """

    chunks: NDArray[np.int64]
    chunk_of: NDArray[np.int64]
    places: NDArray[np.int32]
    by_slot: NDArray[np.uint32]
    by_vertex: NDArray[np.uint32]
    spans: NDArray[np.int64]
    squares: int
    panels: int
    rows: int

    @classmethod
    def of(cls, s: Symbolic) -> Layout:
        """The layout of a factor of this structure."""
        width, below = s.width.astype(np.int64), np.diff(s.row_start)
        chunk_of, node, done, own, rows, quads = _chunks(width, below)
        squares, panels = LANES**2 * quads**2, rows * quads * LANES
        base = np.concatenate([[0], np.cumsum(width + below + _SPARE)])
        columns = [
            np.cumsum(squares) - squares,
            np.cumsum(panels) - panels,
            base[node] + done + own,
            own,
            rows,
            quads,
            s.first[node] + done,
        ]
        used = np.flatnonzero(s.vertex >= 0)
        parts = np.stack([width, below, np.full(len(width), _SPARE)], axis=1)
        kind = np.repeat(np.tile([0, 1, 2], len(width)), parts.ravel())
        places = np.empty(base[-1], np.int32)
        places[kind == 0] = used
        places[kind == 1] = s.rows
        places[kind == 2] = np.repeat(places[base[1:] - _SPARE - 1], _SPARE)

        bounds = s.group_start
        slots = s.first[bounds]
        ends = np.stack([chunk_of[bounds], np.searchsorted(used, slots), slots], axis=1)
        spans = np.stack([ends[:-1], ends[1:]], axis=2).reshape(-1, 6)
        vertex = np.concatenate([np.sort(s.vertex[used[i:j]]) for i, j in spans[:, 2:4]])
        top, end = spans[-1, 4:]
        for g, (begin, stop) in enumerate(pairwise(base[bounds[:-1]])):
            part = places[begin:stop]
            part[part >= top] += (g + 1) * (end - top)
        filled = spans[:-1, 0] < spans[:-1, 1]
        filled[0] = True  # one group at least, though everything be in the top
        spans = spans[np.append(filled, True)]
        rows_of_work = int(end + (len(spans) - 1) * (end - top))
        return cls(
            np.stack(columns, axis=1),
            chunk_of,
            places,
            np.stack([s.vertex[used], used], axis=1).astype(np.uint32),
            np.stack([vertex, s.slot[vertex]], axis=1).astype(np.uint32),
            np.ascontiguousarray(spans, np.int64),
            int(squares.sum()),
            int(panels.sum()),
            rows_of_work,
        )


def _chunks(width: NDArray[np.int64], below: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """`chunk_of`, and of each chunk its supernode, the columns before it there, its own, its rows below, its quads."""
    many = -(-width // WIDTH)
    chunk_of = np.concatenate([[0], np.cumsum(many)])
    node = np.repeat(np.arange(len(width)), many)
    done = (np.arange(len(node)) - chunk_of[node]) * WIDTH
    own = np.minimum(WIDTH, width[node] - done)
    rows = width[node] - done - own + below[node]
    return chunk_of, node, done, own, -(-rows // LANES) * LANES, -(-own // LANES)


def stored(s: Symbolic) -> tuple[int, int]:
    """The entries in all S and in all W of a factor of this structure."""
    *_, rows, quads = _chunks(s.width.astype(np.int64), np.diff(s.row_start))
    return int(LANES**2 * quads @ quads), int(LANES * rows @ quads)


def _rounded(entries: NDArray[Any], dtype: np.dtype) -> NDArray[Any]:
    """The same where they are of this type already."""
    if entries.dtype == dtype:
        return entries
    out = aligned(len(entries), dtype)
    out[:] = entries
    return out


class Supernodal:
    """A supernodal Cholesky factorisation of a sparse symmetric positive definite Q.

    nonzeros: entries of L, diagonal included, before supernodes are padded; panel_bytes: of all S and W; flops:
    additions and multiplications a solve, padding included; shares: the part of the entries in each group of
    subtrees that a thread may do, and last in the top that one does alone; squares, panels,
    layout: all S, all W (float16 seen as uint16), and where they lie. `precision` is that of the panels; the
    factorisation is in float64, the solve in float64 for panels in that and in float32 for others. Solves of one
    factor share its work vector: they are done one at a time.
    """

    def __init__(self, Q: csr_array, *, precision: Precision = "float64", symbolic: Symbolic | None = None) -> None:
        """symbolic: the factor's structure, where it is known. Raises NotPositiveDefinite, with a vertex at fault."""
        if not np.isfinite(Q.data).all():
            rows = np.repeat(np.arange(len(Q.indptr) - 1), np.diff(Q.indptr))
            v = rows[~np.isfinite(Q.data)][0]
            raise NotPositiveDefinite(f"Q is not finite in row {v}: a stiffness, a mass or a pin weight there is not")
        pointers = np.asarray(Q.indptr, np.int64)
        neighbours = np.asarray(Q.indices, np.int32)
        s = symbolic or structure(pointers, neighbours)
        layout = Layout.of(s)
        squares, panels = aligned(layout.squares), aligned(layout.panels)
        into = Panels(layout.chunk_of, layout.chunks, squares, panels)
        v = factorise(Matrix(pointers, neighbours, Q.data), s, into)
        if v >= 0:
            raise NotPositiveDefinite(
                f"Q = A'KA + M/dt^2 + w C'C is not positive definite in floating point at vertex {v}: nothing "
                "determines its position, or stiffnesses, masses and pin weights lie too far apart or are negative"
            )
        self.nonzeros: int | None = s.nonzeros
        work = aligned(4 * layout.rows, np.float64 if precision == "float64" else np.float32)
        if precision == "float16":
            keep_sums(panels, panels - panels.astype(np.float16), layout.chunks)
        squares, panels = _rounded(squares, work.dtype), _rounded(panels, np.dtype(precision))
        if precision == "float16":
            panels = panels.view(np.uint16)  # which Numba has arrays of
        self.panel_bytes = squares.nbytes + panels.nbytes
        below, quads = layout.chunks[:, 4:6].T
        entries = LANES * quads * (LANES * quads + 2 * below)
        self.flops = int(2 * 3 * entries.sum())
        self.shares = [float(entries[a:e].sum() / max(1, entries.sum())) for a, e in layout.spans[:, :2]]
        self.squares, self.panels, self.layout = squares, panels, layout
        lists = layout.places, layout.chunks, layout.spans, layout.by_slot, layout.by_vertex
        self._factor = Factor(squares, panels, *lists, work, Team.of(len(self.shares) - 1))

    def solve(self, b: Positions, out: Positions) -> None:
        """Write Q^-1 b, shape (n, 3), to `out`; b is left as it is and must not be `out`."""
        solve_by(*self._factor, b, out, self.threads())

    def threads(self) -> int | None:
        """Of a solve, None for one."""
        threads = min(numba.get_num_threads(), len(self.shares) - 1)
        return threads if threads > 1 and self.panel_bytes >= _WORTH_THREADS else None
