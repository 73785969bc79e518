"""The elimination schedule of an iteration over a factor.

It has blocks of subtrees that fit the cache, and the blocks above them.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.cholesky.supernode_amalgamation import COLUMN_LANES, MAX_PANEL_WIDTH
from springbench.solvers.linalg.dense_inverse import DenseInverse
from springbench.solvers.linalg.memory import allocate_aligned

MAX_BLOCK_BYTES = 2 << 20
"""Maximum size of the panels of a block. Sizes up to 8 MiB are equally fast; half of this size costs up to 3 %, a
quarter 8 %."""

VISIT_DOWN, VISIT_UP = 0, 1
"""Offset of a visit from twice the block's index."""


class EliminationSchedule(NamedTuple):
    """A factor in blocks, and their schedule.

    Attributes:
        inverse_blocks, panels, row_slots, chunks, top_range, group_blocks, visit_schedule, visit_starts, row_shift: see
            `springbench.solvers.kernels.local_global_iteration.IterationPlan`.
        block_spans: columns of its block table without the packets (b, 5).
        row_of_unknown: row of each unknown (n,).
        num_rows: number of rows of a vector.
    """

    inverse_blocks: NDArray[Any]
    panels: NDArray[Any]
    row_slots: NDArray[np.int32]
    chunks: NDArray[np.int64]
    top_range: NDArray[np.int64]
    block_spans: NDArray[np.int64]
    group_blocks: NDArray[np.int64]
    visit_schedule: NDArray[np.int64]
    visit_starts: NDArray[np.int64]
    row_of_unknown: NDArray[np.int64]
    num_rows: int
    row_shift: int


def schedule_supernodal(factor: SupernodalCholesky) -> EliminationSchedule:
    """Build the schedule of a supernodal factor.

    Each group is cut into blocks; the top is one block.
    """
    squares, panels, at = factor.inverse_blocks, factor.panels, factor.layout
    places, chunks, spans = at.row_slots, at.chunks, at.group_spans
    top, top_end = spans[-1, -2:].tolist()
    subtree, begin, children = _measure_subtrees(chunks, places, top, squares.itemsize, panels.itemsize)
    blocks: list[tuple[int, int]] = []
    visits: list[int] = []
    of_group, visits_of = [0], [0]
    for first, last in spans[:-1, :2].tolist():
        cut = _cut_blocks(first, last, subtree, begin, children)
        visits += _order_visits(cut, begin, len(blocks))
        blocks += cut
        of_group.append(len(blocks))
        visits_of.append(len(visits))
    first, last = spans[-1, :2].tolist()
    if last > first:
        blocks.append((first, last))
    of_group.append(len(blocks))
    slots = np.append(chunks[:, 6], top_end)
    table = [(slots[first], slots[last], first, last, last) for first, last in blocks]
    slot = np.empty(len(at.order_by_slot), np.int64)
    slot[at.order_by_slot[:, 0]] = at.order_by_slot[:, 1]
    return EliminationSchedule(
        squares,
        panels,
        places,
        chunks,
        np.array([top, top_end, len(spans) - 1]),
        np.array(table, np.int64).reshape(-1, 5),
        np.array(of_group),
        np.array(visits, np.int64),
        np.array(visits_of),
        slot,
        at.num_work_rows,
        0,
    )


def schedule_inverse(factor: DenseInverse) -> EliminationSchedule:
    """Build the schedule of a small inverse.

    It has column panels for one pass; the right-hand sides are stored behind the solutions.
    """
    inverse = factor.inverse_matrix
    n = len(inverse)
    first = np.arange(0, n, MAX_PANEL_WIDTH)
    quads = np.minimum(MAX_PANEL_WIDTH, n - first) // COLUMN_LANES
    tiles = inverse.reshape(-1, COLUMN_LANES, n).swapaxes(1, 2)
    panels = [tiles[:, i : i + MAX_PANEL_WIDTH].ravel() for i in first]
    zero = np.zeros(len(first), np.int64)
    return EliminationSchedule(
        np.zeros(1, inverse.dtype),
        np.concatenate(panels),
        np.arange(n, 2 * n, dtype=np.int32),
        np.stack([zero, n * first, zero, zero, zero + n, quads, first], axis=1),
        np.array([2 * n, 2 * n, 1]),
        np.array([[0, n, 0, 0, len(first)]]),
        np.array([0, 1, 1]),
        np.array([VISIT_DOWN, VISIT_UP]),
        np.array([0, 2]),
        np.arange(n),
        2 * n,
        n,
    )


def allocate_vectors(dtype: Any, rows: int) -> tuple[NDArray[Any], ...]:
    """Allocate three vectors for the iterations, and one of float64 for scratch.

    Args:
        dtype: type of the vectors for the iterations, that of the factor.
        rows: rows of four numbers in each vector.

    Returns:
        Four arrays of zeros (4 rows,).
    """
    return *(allocate_aligned(4 * rows, dtype) for _ in range(3)), allocate_aligned(4 * rows)


def _measure_subtrees(
    chunks: NDArray[np.int64], places: NDArray[np.int32], top: int, square: int, panel: int
) -> tuple[list[int], list[int], list[int]]:
    """Return size [bytes], first chunk and number of children of each chunk's subtree.

    The top is excluded.
    """
    _, _, at, _, below, quads, slot = chunks.T
    above = places[np.minimum(at, len(places) - 1)] if len(places) else np.zeros(len(chunks), np.int64)
    inside = (below > 0) & (above < top)
    parent = np.where(inside, np.searchsorted(slot, above, side="right") - 1, -1).tolist()
    size = ((square * COLUMN_LANES * quads + panel * below) * quads * COLUMN_LANES).tolist()
    first = list(range(len(chunks)))
    children = [0] * len(chunks)
    for chunk, above in enumerate(parent):
        if above >= 0:
            size[above] += size[chunk]
            first[above] = min(first[above], first[chunk])
            children[above] += 1
    return size, first, children


def _cut_blocks(begin: int, end: int, size: list[int], first: list[int], children: list[int]) -> list[tuple[int, int]]:
    """Cut the chunks from `begin` to `end` into blocks: whole subtrees, or paths above them.

    Chunks are in a postorder, so that a subtree is a range of them. Neighbours are merged if they still fit.
    """
    blocks: list[tuple[int, int]] = []
    filled, whole = 0, False
    last = end
    while last > begin:
        chunk = last - 1
        leaf = size[chunk] <= MAX_BLOCK_BYTES
        start = first[chunk] if leaf else chunk
        joins = filled + size[chunk] <= MAX_BLOCK_BYTES if leaf else last < end and children[last] == 1
        if blocks and whole == leaf and joins:
            blocks[-1] = (start, blocks[-1][1])
            filled += size[chunk]
        else:
            blocks.append((start, last))
            filled = size[chunk]
        last, whole = start, leaf
    return blocks[::-1]


def _order_visits(blocks: list[tuple[int, int]], first: list[int], number: int) -> list[int]:
    """Order the blocks of a group for both passes.

    `number` is the index of the first block. The pass down visits each block after those above it. The pass up visits
    them in storage order, after all below.
    """
    begins = [begin for begin, _ in blocks]
    below: list[list[int]] = [[] for _ in blocks]  # by the first block of their subtrees
    for k, (begin, end) in enumerate(blocks):
        below[bisect_right(begins, min(begin, first[end - 1])) - 1].append(k)
    out: list[int] = []
    for k, downs in enumerate(below):
        out += [2 * (number + d) + VISIT_DOWN for d in reversed(downs)] + [2 * (number + k) + VISIT_UP]
    return out
