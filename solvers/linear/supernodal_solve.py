"""Triangular solves with the panels of a supernodal factor.

    forward, children first:    y_below += W y_own
    backward, parents first:    y_own = S y_own + W' y_below

The supernodes form groups of subtrees and a top above them. Each group has its own copy of the top's rows. The forward
pass adds to this copy and the backward pass reads from it, so that groups can be processed in parallel. Copies are
added in the order of the groups. The result is therefore bitwise independent of the number of threads.

`spans` (groups + 1, 6) has for each group, and in its last row for the top, the first and last chunk, the first
and last vertex in either order, and the first and last slot. `by_slot` and `by_vertex` (n, 2) list vertices
and their slots group by group, so that both input and output are written sequentially. `work` has 4 numbers per slot,
followed by the groups' copies. Slots without a vertex remain zero. (Table entries are read one by one: unpacking a row
would create an array first, which costs 20 ns.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from solvers.compiling import inner, inner_in_parallel, kernel
from solvers.linear.team import Team, claim, finish, following, go_on, last, start
from solvers.vectors.intrinsics import ask_for
from solvers.vectors.supernodal import add_forward, set_backward

_AHEAD = 64
"""Prefetch distance, in vertices, for data in another order."""


@inner
def _load(b, order, begin, end, work):
    """Copy the right-hand sides b (n, 3) to rows of `work`."""
    rows = work.reshape(-1, 4)
    for i in range(begin, end):
        ask_for(b, 3 * order[min(i + _AHEAD, end - 1), 0])
        v, k = order[i, 0], order[i, 1]
        for c in range(3):
            rows[k, c] = b[v, c]


@inner
def _store(work, order, begin, end, out):
    """Copy the solution from rows of `work` to out (n, 3)."""
    rows = work.reshape(-1, 4)
    for i in range(begin, end):
        ask_for(work, 4 * order[min(i + _AHEAD, end - 1), 1])
        v, k = order[i, 0], order[i, 1]
        for c in range(3):
            out[v, c] = rows[k, c]


@inner
def forwards(panels, index, chunks, begin, end, work):
    """Perform the forward substitution with the chunks from `begin` to `end`."""
    for k in range(begin, end):
        offset, at, below, quads, first = chunks[k, 1], chunks[k, 2], chunks[k, 4], chunks[k, 5], chunks[k, 6]
        if quads == 4:
            add_forward(panels, offset, index, at, below, work, first, work, 0, 3, 4)
        elif quads == 1:
            add_forward(panels, offset, index, at, below, work, first, work, 0, 3, 1)
        elif quads == 2:
            add_forward(panels, offset, index, at, below, work, first, work, 0, 3, 2)
        else:
            add_forward(panels, offset, index, at, below, work, first, work, 0, 3, 3)


@inner
def backwards(squares, panels, index, chunks, begin, end, work):
    """Perform the backward substitution with the chunks from `end` down to `begin`."""
    for k in range(end - 1, begin - 1, -1):
        start, offset, at, own = chunks[k, 0], chunks[k, 1], chunks[k, 2], chunks[k, 3]
        below, quads, first = chunks[k, 4], chunks[k, 5], chunks[k, 6]
        if quads == 4:
            set_backward(squares, start, own, panels, offset, index, at, below, work, first, 4)
        elif quads == 1:
            set_backward(squares, start, own, panels, offset, index, at, below, work, first, 1)
        elif quads == 2:
            set_backward(squares, start, own, panels, offset, index, at, below, work, first, 2)
        else:
            set_backward(squares, start, own, panels, offset, index, at, below, work, first, 3)


class Factor(NamedTuple):
    """Arrays of a solve, with its work vector (see the module and `Layout`).

    team: shared state of the threads.
    """

    squares: NDArray[Any]
    panels: NDArray[Any]
    places: NDArray[np.int32]
    chunks: NDArray[np.int64]
    spans: NDArray[np.int64]
    by_slot: NDArray[np.uint32]
    by_vertex: NDArray[np.uint32]
    work: NDArray[Any]
    team: Team


@inner
def _ascend(factor, b, group):
    """Perform the forward substitution of a group."""
    spans, work = factor.spans, factor.work
    chunk, chunk_end, begin, end = spans[group, :4]
    top, top_end = spans[-1, 4:]
    _load(b, factor.by_slot, begin, end, work)
    copy = 4 * (top_end + group * (top_end - top))
    for k in range(4 * (top_end - top)):
        work[copy + k] = 0.0
    forwards(factor.panels, factor.places, factor.chunks, chunk, chunk_end, work)


@inner
def _turn(factor, b, out):
    """Perform both substitutions of the top."""
    spans, work = factor.spans, factor.work
    chunk, chunk_end, begin, end, top, top_end = spans[-1]
    _load(b, factor.by_slot, begin, end, work)
    size = 4 * (top_end - top)
    for group in range(len(spans) - 1):
        copy = 4 * top_end + group * size
        for k in range(size):
            work[4 * top + k] += work[copy + k]
    forwards(factor.panels, factor.places, factor.chunks, chunk, chunk_end, work)
    backwards(factor.squares, factor.panels, factor.places, factor.chunks, chunk, chunk_end, work)
    _store(work, factor.by_vertex, begin, end, out)


@inner
def _descend(factor, out, group):
    """Perform the backward substitution of a group."""
    spans, work = factor.spans, factor.work
    chunk, chunk_end, begin, end = spans[group, :4]
    top, top_end = spans[-1, 4:]
    size = 4 * (top_end - top)
    copy = 4 * top_end + group * size
    for k in range(size):
        work[copy + k] = work[4 * top + k]
    backwards(factor.squares, factor.panels, factor.places, factor.chunks, chunk, chunk_end, work)
    _store(work, factor.by_vertex, begin, end, out)


@inner
def _share(factor, b, out, first):
    """Process groups from `first` on that no other thread has claimed, forward and then backward."""
    groups, team = len(factor.spans) - 1, factor.team
    phase = 0
    while phase >= 0:
        for i in range(groups):
            group = (first + i) % groups
            if claim(team, group, phase):
                if phase == 0:
                    _ascend(factor, b, group)
                else:
                    _descend(factor, out, group)
                if last(team):
                    if phase == 0:
                        _turn(factor, b, out)
                        go_on(team, 1)
                    else:
                        finish(team)
        phase = following(team, phase)


@inner_in_parallel
def _side_by_side(squares, panels, places, chunks, spans, by_slot, by_vertex, work, team, b, out, threads):
    for thread in prange(threads):  # which takes no tuple with another in it
        whole = Factor(squares, panels, places, chunks, spans, by_slot, by_vertex, work, team)
        _share(whole, b, out, thread * (len(spans) - 1) // threads)


@inner
def solve(factor, b, out, threads):
    """Solve Q out = b.

    Args:
        factor: the supernodal factor.
        b: right-hand sides (n, 3).
        out: solution (n, 3).
        threads: number of threads, None for one.
    """
    start(factor.team)
    if threads is None:
        _share(factor, b, out, 0)
    else:
        f = factor
        _side_by_side(f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f.team, b, out, threads)


@kernel
def solve_by(squares, panels, places, chunks, spans, by_slot, by_vertex, work, team, b, out, threads):
    """Solve Q out = b from Python with the fields of a `Factor` as separate arguments.

    Arrays are passed faster than a named tuple, which would take a seventh of a solve of 100 vertices.
    """
    solve(Factor(squares, panels, places, chunks, spans, by_slot, by_vertex, work, team), b, out, threads)
