"""Multifrontal Cholesky factorisation of a matrix of 3 x 3 blocks (Duff and Reid 1983).

A front is the dense matrix of a supernode's columns and of the rows below. Its columns become a panel of L; the
remainder is an update of its parent (`springbench.solvers.linalg.cholesky.block_front`). Updates are stored on two
stacks that
alternate between the levels of the tree. Each update is thus computed in its place, while those of its children are
read.

Two ranges of rows are aligned to whole vectors: those of a panel's columns, and those below. There is no other padding.
Entries above the diagonal are never read; the diagonal contains the inverses of L's entries.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.linalg.cholesky.block_front import (
    DenseFront,
    eliminate_front,
    round_up_rows_inner,
    subtract_front_update,
)
from springbench.solvers.simd.front_tiles import (
    TILE_COLUMNS,
    TILE_ROWS,
    add_vector,
    backward_solve_tile,
    forward_solve_tile,
)


class FrontalStructure(NamedTuple):
    """Structure of a factor with n vertices and s supernodes in postorder.

    Attributes:
        member_start: first member of each supernode, (s + 1,).
        member_vertices: vertices of each supernode's columns, followed by those of the rows below.
        num_columns: number of columns in vertices, (s,).
        parent_position: of each member below, its position among the parent's members.
        parent: (s,), -1 for a root.
        stack_index: stack of each update, 0 or 1, (s,).
        panel_start: first entry of each panel, (s + 1,).
        block_start: first matrix block of each supernode, (s + 1,).
        block_index: matrix blocks in the order of supernodes, (b,).
        entry_offset: target of each of them in the panels, (b,).
        diagonal_block: diagonal block of each vertex, (n,).
    """

    member_start: NDArray[np.int64]
    member_vertices: NDArray[np.int64]
    num_columns: NDArray[np.int64]
    parent_position: NDArray[np.int64]
    parent: NDArray[np.int64]
    stack_index: NDArray[np.int64]
    panel_start: NDArray[np.int64]
    block_start: NDArray[np.int64]
    block_index: NDArray[np.int64]
    entry_offset: NDArray[np.int64]
    diagonal_block: NDArray[np.int64]


class FactorisationScratch(NamedTuple):
    """Scratch memory of a factorisation with n vertices and s supernodes.

    Attributes:
        front: one vector longer than the largest front.
        stacks: updates, (2, size).
        pending_supernodes: supernodes on each stack, preceded by their number, (2, s + 1).
        stack_sizes: number of entries in use on each stack, and the number of fronts eliminated, (3,).
        min_pivots: thresholds, (TILE_COLUMNS,).
        triangles: factors of the tiles of a panel block, (., TILE_COLUMNS, TILE_COLUMNS).
        runs: (2, n + 1).
    """

    front: NDArray[np.float64]
    stacks: NDArray[np.float64]
    pending_supernodes: NDArray[np.int64]
    stack_sizes: NDArray[np.int64]
    min_pivots: NDArray[np.float64]
    triangles: NDArray[np.float64]
    runs: NDArray[np.int64]


@jit_kernel
def factorise_blocks(fronts, values, panels, x, scratch):
    """Factorise a matrix of blocks, and write L to the panels.

    Args:
        fronts: structure of the factor.
        values: blocks (b, 3, 3).
        panels: output.
        x: right-hand sides (n, 3), or empty; overwritten with L^-1 x while each panel is in cache.
        scratch: scratch memory.

    Returns:
        Whether the matrix is positive definite.
    """
    stacks, waiting, filled = scratch.stacks, scratch.pending_supernodes, scratch.stack_sizes
    filled[:] = 0
    waiting[:, 0] = 0
    for s in range(len(fronts.num_columns)):
        _, own, below, head, stride = _front_sizes(fronts, s)
        side = fronts.stack_index[s]
        to = DenseFront(own, head, stride, panels, fronts.panel_start[s], stacks[side], filled[side], stride - head)
        panels[to.panel_offset : fronts.panel_start[s + 1]] = 0.0
        to.update_buffer[to.update_offset : to.update_offset + 3 * below * to.update_stride] = 0.0
        _scatter_blocks(fronts, s, values, panels, stride)
        other = 1 - side
        while waiting[other, 0] > 0 and fronts.parent[waiting[other, waiting[other, 0]]] == s:
            c = waiting[other, waiting[other, 0]]
            waiting[other, 0] -= 1
            rows = fronts.member_start[c + 1] - fronts.member_start[c] - fronts.num_columns[c]
            filled[other] -= 3 * rows * round_up_rows_inner(3 * rows)
            _extend_add(fronts, c, stacks[other], filled[other], to, scratch.runs)
        if not eliminate_front(fronts, s, values, panels, stride, scratch.min_pivots, scratch.triangles):
            return False
        filled[2] = s + 1
        if len(x) > 0:
            _forward_substitution(fronts, s, panels, x, scratch.front)
        subtract_front_update(to, 3 * below)
        if fronts.parent[s] >= 0:
            waiting[side, 0] += 1
            waiting[side, waiting[side, 0]] = s
            filled[side] += 3 * below * to.update_stride
    return True


@jit_inner
def _scatter_blocks(fronts, supernode, values, panels, stride):
    """Copy the matrix blocks below the diagonal to the panel of a supernode."""
    for k in range(fronts.block_start[supernode], fronts.block_start[supernode + 1]):
        e, at = fronts.block_index[k], fronts.entry_offset[k]
        for j in range(3):
            for i in range(3):
                panels[at + j * stride + i] = values[e, j, i]


@jit_inner
def _extend_add(fronts, child, source, at, to, runs):
    """Add the update of a child, stored in `source`, to its parent's front, in runs of consecutive members."""
    own, first = to.num_columns, fronts.member_start[child] + fronts.num_columns[child]
    rows = fronts.member_start[child + 1] - first
    height = round_up_rows_inner(3 * rows)
    count = 0
    for k in range(rows):
        q = fronts.parent_position[first + k]
        if k == 0 or q != fronts.parent_position[first + k - 1] + 1 or q == own:
            runs[0, count] = k
            runs[1, count] = 3 * q if q < own else to.below_offset + 3 * (q - own)
            count += 1
    runs[0, count] = rows
    run = 0
    for b in range(rows):
        if runs[0, run + 1] == b:
            run += 1
        q = fronts.parent_position[first + b]
        for j in range(3):
            start = at + (3 * b + j) * height
            if q < own:
                _add_runs(runs, run, count, b, source, start, to.panels, to.panel_offset + (3 * q + j) * to.stride)
            else:
                column = to.update_offset + (3 * (q - own) + j) * to.update_stride - to.below_offset
                _add_runs(runs, run, count, b, source, start, to.update_buffer, column)


@jit_inner
def _add_runs(runs, run, count, b, source, start, target, column):
    """Add the rows of a column, from member b on."""
    for k in range(run, count):
        a = max(b, runs[0, k])
        to = column + runs[1, k] + 3 * (a - runs[0, k])
        add_vector(source, start + 3 * a, target, to, 3 * (runs[0, k + 1] - a))


@jit_inner
def _forward_substitution(fronts, supernode, panels, x, front):
    """Perform the forward substitution with the panel of a supernode; children precede parents."""
    first, own, below, head, stride = _front_sizes(fronts, supernode)
    front[: stride + TILE_ROWS] = 0.0
    _gather_vertices(x, fronts.member_vertices, first, own, front, 0)
    for tile in range(0, 3 * own, TILE_COLUMNS):
        columns, corner = min(TILE_COLUMNS, 3 * own - tile), fronts.panel_start[supernode] + tile * stride + tile
        strips = (stride - tile - columns + TILE_ROWS - 1) // TILE_ROWS
        if columns == 6:
            forward_solve_tile(panels, corner, stride, front, tile, strips, 6)
        else:
            forward_solve_tile(panels, corner, stride, front, tile, strips, 3)
    _scatter_vertices(front, 0, x, fronts.member_vertices, first, own)
    for k in range(below):
        for c in range(3):
            x[fronts.member_vertices[first + own + k], c] += front[head + 3 * k + c]


@jit_kernel
def solve_blocks(fronts, panels, x, front, forward_done):
    """Overwrite x with H^-1 x.

    Args:
        fronts: structure of the factor.
        panels: factor L.
        x: right-hand sides (n, 3), overwritten.
        front: scratch, one vector longer than the largest front.
        forward_done: whether `factorise_blocks` has performed the forward substitution.
    """
    if not forward_done:
        for s in range(len(fronts.num_columns)):
            _forward_substitution(fronts, s, panels, x, front)
    for s in range(len(fronts.num_columns) - 1, -1, -1):
        first, own, below, head, stride = _front_sizes(fronts, s)
        front[: stride + TILE_ROWS] = 0.0
        _gather_vertices(x, fronts.member_vertices, first, own, front, 0)
        _gather_vertices(x, fronts.member_vertices, first + own, below, front, head)
        for tile in range((3 * own - 1) // TILE_COLUMNS * TILE_COLUMNS, -1, -TILE_COLUMNS):
            columns, corner = min(TILE_COLUMNS, 3 * own - tile), fronts.panel_start[s] + tile * stride + tile
            strips = (stride - tile - columns + TILE_ROWS - 1) // TILE_ROWS
            if columns == 6:
                backward_solve_tile(panels, corner, stride, front, tile, strips, 6)
            else:
                backward_solve_tile(panels, corner, stride, front, tile, strips, 3)
        _scatter_vertices(front, 0, x, fronts.member_vertices, first, own)


@jit_inner
def _front_sizes(fronts, supernode):
    """Return first member, columns and rows below in vertices, and begin and end of those rows in the panel."""
    first, own = fronts.member_start[supernode], fronts.num_columns[supernode]
    below, head = fronts.member_start[supernode + 1] - first - own, round_up_rows_inner(3 * own)
    return first, own, below, head, head + round_up_rows_inner(3 * below)


@jit_inner
def _gather_vertices(x, members, first, count, front, at):
    for k in range(count):
        for c in range(3):
            front[at + 3 * k + c] = x[members[first + k], c]


@jit_inner
def _scatter_vertices(front, at, x, members, first, count):
    for k in range(count):
        for c in range(3):
            x[members[first + k], c] = front[at + 3 * k + c]
