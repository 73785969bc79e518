"""In which order an iteration goes through a factor: blocks of subtrees that fit the cache, and those above."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.kernels.springs import aligned
from solvers.linear.inverse import Inverse
from solvers.linear.supernodal import Supernodal
from solvers.linear.supernodes import LANES, WIDTH

BLOCK_BYTES = 1 << 20
"""Of the panels of a block: a core's second cache. From there to 16 MiB all are alike; half of it costs up to 5 %."""


class Order(NamedTuple):
    """A factor, cut into blocks.

    squares, panels, places, chunks, top, leaf, of_group, shift: see `solvers.kernels.step.Plan`; spans (b, 5): the
    columns of its `blocks` without the bundles; slot (n,): the row of each unknown; rows: of a vector.
    """

    squares: NDArray[Any]
    panels: NDArray[Any]
    places: NDArray[np.int32]
    chunks: NDArray[np.int64]
    top: NDArray[np.int64]
    spans: NDArray[np.int64]
    leaf: NDArray[np.bool_]
    of_group: NDArray[np.int64]
    slot: NDArray[np.int64]
    rows: int
    shift: int


def of_supernodal(factor: Supernodal) -> Order:
    """The order for a supernodal factor: each group cut into blocks, the top a block of its own."""
    squares, panels, at = factor.squares, factor.panels, factor.layout
    places, chunks, spans = at.places, at.chunks, at.spans
    top, top_end = spans[-1, -2:].tolist()
    subtree, begin = _subtrees(chunks, places, top, squares.itemsize, panels.itemsize)
    blocks: list[tuple[int, int, bool]] = []
    of_group = [0]
    for first, last in spans[:-1, :2].tolist():
        blocks += _cut(first, last, subtree, begin)
        of_group.append(len(blocks))
    first, last = spans[-1, :2].tolist()
    if last > first:
        blocks.append((first, last, False))
    of_group.append(len(blocks))
    slots = np.append(chunks[:, 6], top_end)
    table = [(slots[first], slots[last], first, last, last) for first, last, _ in blocks]
    slot = np.empty(len(at.by_slot), np.int64)
    slot[at.by_slot[:, 0]] = at.by_slot[:, 1]
    return Order(
        squares,
        panels,
        places,
        chunks,
        np.array([top, top_end, len(spans) - 1]),
        np.array(table, np.int64).reshape(-1, 5),
        np.array([leaf for _, _, leaf in blocks], bool),
        np.array(of_group),
        slot,
        at.rows,
        0,
    )


def of_inverse(factor: Inverse) -> Order:
    """The order for a small inverse: panels of its columns that are only gone down, from right-hand sides behind."""
    inverse = factor.inverse
    n = len(inverse)
    first = np.arange(0, n, WIDTH)
    quads = np.minimum(WIDTH, n - first) // LANES
    panels = [inverse[:, i : i + WIDTH].ravel() for i in first]
    zero = np.zeros(len(first), np.int64)
    return Order(
        np.zeros(1, inverse.dtype),
        np.concatenate(panels),
        np.arange(n, 2 * n, dtype=np.int32),
        np.stack([zero, n * first, zero, zero, zero + n, quads, first], axis=1),
        np.array([2 * n, 2 * n, 1]),
        np.array([[0, n, 0, 0, len(first)]]),
        np.array([True]),
        np.array([0, 1, 1]),
        np.arange(n),
        2 * n,
        n,
    )


def vectors(dtype: Any, rows: int) -> tuple[NDArray[Any], ...]:
    """Three vectors for the iterations, and one of float64 for scratch, of so many rows of four."""
    return *(aligned(4 * rows, dtype) for _ in range(3)), aligned(4 * rows)


def _subtrees(
    chunks: NDArray[np.int64], places: NDArray[np.int32], top: int, square: int, panel: int
) -> tuple[list[int], list[int]]:
    """The bytes of each chunk's subtree and its first chunk; subtrees end at the top."""
    _, _, at, own, below, quads, slot = chunks.T
    above = places[np.minimum(at, len(places) - 1)] if len(places) else np.zeros(len(chunks), np.int64)
    inside = (below > 0) & (above < top)
    parent = np.where(inside, np.searchsorted(slot, above, side="right") - 1, -1).tolist()
    size = ((square * own + panel * below) * quads * LANES).tolist()
    first = list(range(len(chunks)))
    for chunk, above in enumerate(parent):
        if above >= 0:
            size[above] += size[chunk]
            first[above] = min(first[above], first[chunk])
    return size, first


def _cut(begin: int, end: int, size: list[int], first: list[int]) -> list[tuple[int, int, bool]]:
    """The chunks from `begin` to `end` as blocks, each the chunks it spans and whether they are whole subtrees.

    Chunks are in a postorder, so that a subtree is a stretch of them; neighbours join where they still fit.
    """
    blocks: list[tuple[int, int, bool]] = []
    filled = 0
    last = end
    while last > begin:
        chunk = last - 1
        leaf = size[chunk] <= BLOCK_BYTES
        start = first[chunk] if leaf else chunk
        if blocks and blocks[-1][2] == leaf and (not leaf or filled + size[chunk] <= BLOCK_BYTES):
            blocks[-1] = (start, blocks[-1][1], leaf)
            filled += size[chunk]
        else:
            blocks.append((start, last, leaf))
            filled = size[chunk]
        last = start
    return blocks[::-1]
