"""Triangular solves with the panels of a supernodal factor.

    forward, children first:    y_below += W y_own
    backward, parents first:    y_own = S y_own + W' y_below

The supernodes form groups of subtrees and a top above them. Each group has its own copy of the top's rows. The forward
pass adds to this copy and the backward pass reads from it, so that groups can be processed in parallel. Copies are
added in the order of the groups. The result is therefore bitwise independent of the number of threads.

`group_spans` (groups + 1, 6) has for each group, and in its last row for the top, the first and last chunk, the first
and last vertex in either order, and the first and last slot. `order_by_slot` and `order_by_vertex` (n, 2) list vertices
and their slots group by group, so that both input and output are written sequentially. `work` has 4 numbers per slot,
followed by the groups' copies. Slots without a vertex remain zero. (Table entries are read one by one: unpacking a row
would create an array first, which costs 20 ns.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_inner_parallel, jit_kernel
from springbench.solvers.linalg.cholesky.thread_team import (
    ThreadTeam,
    call_in_thread,
    complete_task,
    finish_phases,
    raise_thread_error,
    release_phase,
    reset_team,
    try_claim,
    wait_for_phase,
)
from springbench.solvers.simd.llvm_vectors import prefetch_entry
from springbench.solvers.simd.panel_products import add_panel_product, set_transposed_product

_PREFETCH_DISTANCE = 64
"""Prefetch distance, in vertices, for data in another order."""


@jit_inner
def _load_right_hand_side(b, order, begin, end, work):
    """Copy the right-hand sides b (n, 3) to rows of `work`."""
    rows = work.reshape(-1, 4)
    for i in range(begin, end):
        prefetch_entry(b, 3 * order[min(i + _PREFETCH_DISTANCE, end - 1), 0])
        v, k = order[i, 0], order[i, 1]
        for c in range(3):
            rows[k, c] = b[v, c]


@jit_inner
def _store_solution(work, order, begin, end, out):
    """Copy the solution from rows of `work` to out (n, 3)."""
    rows = work.reshape(-1, 4)
    for i in range(begin, end):
        prefetch_entry(work, 4 * order[min(i + _PREFETCH_DISTANCE, end - 1), 1])
        v, k = order[i, 0], order[i, 1]
        for c in range(3):
            out[v, c] = rows[k, c]


@jit_inner
def forward_substitution(panels, index, chunks, begin, end, work):
    """Perform the forward substitution with the chunks from `begin` to `end`.

    Args:
        panels: W of all chunks, one after the other.
        index: slots of the chunks' rows, `PanelLayout.row_slots`.
        chunks: offsets and sizes of each chunk (c, 7), as in `PanelLayout`.
        begin, end: range of chunks, without `end`.
        work: right-hand side, four numbers per slot, updated.
    """
    for k in range(begin, end):
        offset, at, below, quads, first = chunks[k, 1], chunks[k, 2], chunks[k, 4], chunks[k, 5], chunks[k, 6]
        if quads == 4:
            add_panel_product(panels, offset, index, at, below, work, first, work, 0, 3, 4)
        elif quads == 1:
            add_panel_product(panels, offset, index, at, below, work, first, work, 0, 3, 1)
        elif quads == 2:
            add_panel_product(panels, offset, index, at, below, work, first, work, 0, 3, 2)
        else:
            add_panel_product(panels, offset, index, at, below, work, first, work, 0, 3, 3)


@jit_inner
def backward_substitution(squares, panels, index, chunks, begin, end, work):
    """Perform the backward substitution with the chunks from `end` down to `begin`.

    Args:
        squares: S of all chunks, one after the other.
        panels: W of all chunks, one after the other.
        index: slots of the chunks' rows, `PanelLayout.row_slots`.
        chunks: offsets and sizes of each chunk (c, 7), as in `PanelLayout`.
        begin, end: range of chunks, the last of which, `end` - 1, is first.
        work: result of the forward substitution, four numbers per slot, overwritten with the solution.
    """
    for k in range(end - 1, begin - 1, -1):
        start, offset, at, own = chunks[k, 0], chunks[k, 1], chunks[k, 2], chunks[k, 3]
        below, quads, first = chunks[k, 4], chunks[k, 5], chunks[k, 6]
        if quads == 4:
            set_transposed_product(squares, start, own, panels, offset, index, at, below, work, first, 4)
        elif quads == 1:
            set_transposed_product(squares, start, own, panels, offset, index, at, below, work, first, 1)
        elif quads == 2:
            set_transposed_product(squares, start, own, panels, offset, index, at, below, work, first, 2)
        else:
            set_transposed_product(squares, start, own, panels, offset, index, at, below, work, first, 3)


class SupernodalFactor(NamedTuple):
    """Arrays of a solve, with its work vector, as the module and `PanelLayout` describe.

    thread_team: shared state of the threads.
    """

    inverse_blocks: NDArray[Any]
    panels: NDArray[Any]
    row_slots: NDArray[np.int32]
    chunks: NDArray[np.int64]
    group_spans: NDArray[np.int64]
    order_by_slot: NDArray[np.uint32]
    order_by_vertex: NDArray[np.uint32]
    work: NDArray[Any]
    thread_team: ThreadTeam


@jit_inner
def _forward_group(factor, b, group):
    """Perform the forward substitution of a group."""
    spans, work = factor.group_spans, factor.work
    chunk, chunk_end, begin, end = spans[group, :4]
    top, top_end = spans[-1, 4:]
    _load_right_hand_side(b, factor.order_by_slot, begin, end, work)
    copy = 4 * (top_end + group * (top_end - top))
    for k in range(4 * (top_end - top)):
        work[copy + k] = 0.0
    forward_substitution(factor.panels, factor.row_slots, factor.chunks, chunk, chunk_end, work)


@jit_inner
def _solve_top(factor, b, out):
    """Perform both substitutions of the top."""
    spans, work = factor.group_spans, factor.work
    chunk, chunk_end, begin, end, top, top_end = spans[-1]
    _load_right_hand_side(b, factor.order_by_slot, begin, end, work)
    size = 4 * (top_end - top)
    for group in range(len(spans) - 1):
        copy = 4 * top_end + group * size
        for k in range(size):
            work[4 * top + k] += work[copy + k]
    forward_substitution(factor.panels, factor.row_slots, factor.chunks, chunk, chunk_end, work)
    backward_substitution(factor.inverse_blocks, factor.panels, factor.row_slots, factor.chunks, chunk, chunk_end, work)
    _store_solution(work, factor.order_by_vertex, begin, end, out)


@jit_inner
def _backward_group(factor, out, group):
    """Perform the backward substitution of a group."""
    spans, work = factor.group_spans, factor.work
    chunk, chunk_end, begin, end = spans[group, :4]
    top, top_end = spans[-1, 4:]
    size = 4 * (top_end - top)
    copy = 4 * top_end + group * size
    for k in range(size):
        work[copy + k] = work[4 * top + k]
    backward_substitution(factor.inverse_blocks, factor.panels, factor.row_slots, factor.chunks, chunk, chunk_end, work)
    _store_solution(work, factor.order_by_vertex, begin, end, out)


@jit_inner
def _run_thread(factor, b, out, first):
    """Process groups from `first` on that no other thread has claimed, forward and then backward."""
    groups, team = len(factor.group_spans) - 1, factor.thread_team
    phase = 0
    while phase >= 0:
        for i in range(groups):
            group = (first + i) % groups
            if try_claim(team, group, phase):
                if phase == 0:
                    _forward_group(factor, b, group)
                else:
                    _backward_group(factor, out, group)
                if complete_task(team):
                    if phase == 0:
                        _solve_top(factor, b, out)
                        release_phase(team, 1)
                    else:
                        finish_phases(team)
        phase = wait_for_phase(team, phase)


@jit_inner_parallel
def _run_threads(squares, panels, places, chunks, spans, by_slot, by_vertex, work, team, b, out, threads):
    for thread in prange(threads):  # a parallel loop does not support nested tuples
        whole = SupernodalFactor(squares, panels, places, chunks, spans, by_slot, by_vertex, work, team)
        call_in_thread(team, _run_thread, (whole, b, out, thread * (len(spans) - 1) // threads))


@jit_inner
def solve_supernodal(factor, b, out, threads):
    """Solve Q out = b.

    Args:
        factor: the supernodal factor.
        b: right-hand sides (n, 3).
        out: solution (n, 3).
        threads: number of threads, None for one.
    """
    reset_team(factor.thread_team)
    if threads is None:
        _run_thread(factor, b, out, 0)
    else:
        f = factor
        _run_threads(f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f.thread_team, b, out, threads)
        raise_thread_error(f.thread_team)


@jit_kernel
def solve_from_arrays(squares, panels, places, chunks, spans, by_slot, by_vertex, work, team, b, out, threads):
    """Solve Q out = b from Python, with the fields of a `SupernodalFactor` as arguments.

    Arrays are passed faster than a named tuple, which would take a seventh of a solve of 100 vertices.

    Args:
        squares, panels, places, chunks, spans, by_slot, by_vertex, work, team: fields of the factor in their order.
        b: right-hand sides (n, 3).
        out: solution (n, 3).
        threads: number of threads, None for one.
    """
    solve_supernodal(
        SupernodalFactor(squares, panels, places, chunks, spans, by_slot, by_vertex, work, team), b, out, threads
    )
