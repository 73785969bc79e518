"""Multifrontal Cholesky factorisation of a matrix of 3 x 3 blocks (Duff and Reid 1983).

A front is the dense matrix of a supernode's columns and of the rows below. Its columns become a panel of L; the
remainder is an update of its parent (`solvers.linear.block_front`). Updates are stored on two stacks that
alternate between the levels of the tree. Each update is thus computed in its place, while those of its children are
read.

Two ranges of rows are aligned to whole vectors: those of a panel's columns, and those below. There is no other padding.
Entries above the diagonal are never read; the diagonal contains the inverses of L's entries.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.linear.block_front import Dense, eliminate, rows_of, update
from solvers.vectors.block import ROWS, TILE, add, solve_columns, solve_rows


class Fronts(NamedTuple):
    """Structure of a factor with n vertices and s supernodes in postorder.

    Attributes:
        start: first member of each supernode, (s + 1,).
        members: vertices of each supernode's columns, followed by those of the rows below.
        own: number of columns in vertices, (s,).
        within: of each member below, its position among the parent's members.
        parent: (s,), -1 for a root.
        stack: stack of each update, 0 or 1, (s,).
        panel: first entry of each panel, (s + 1,).
        entered: first matrix block of each supernode, (s + 1,).
        block: matrix blocks in the order of supernodes, (b,).
        entry: target of each of them in the panels, (b,).
        diagonal: diagonal block of each vertex, (n,).
    """

    start: NDArray[np.int64]
    members: NDArray[np.int64]
    own: NDArray[np.int64]
    within: NDArray[np.int64]
    parent: NDArray[np.int64]
    stack: NDArray[np.int64]
    panel: NDArray[np.int64]
    entered: NDArray[np.int64]
    block: NDArray[np.int64]
    entry: NDArray[np.int64]
    diagonal: NDArray[np.int64]


class Scratch(NamedTuple):
    """Scratch memory of a factorisation with n vertices and s supernodes.

    Attributes:
        front: one vector longer than the largest front.
        stacks: updates, (2, size).
        waiting: supernodes on each stack, preceded by their number, (2, s + 1).
        filled: number of entries in use on each stack, (2,).
        least: thresholds, (TILE,).
        triangles: factors of the tiles of a panel block, (., TILE, TILE).
        runs: (2, n + 1).
    """

    front: NDArray[np.float64]
    stacks: NDArray[np.float64]
    waiting: NDArray[np.int64]
    filled: NDArray[np.int64]
    least: NDArray[np.float64]
    triangles: NDArray[np.float64]
    runs: NDArray[np.int64]


@kernel
def factorise(fronts, values, panels, x, scratch):
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
    stacks, waiting, filled = scratch.stacks, scratch.waiting, scratch.filled
    filled[:] = 0
    waiting[:, 0] = 0
    for s in range(len(fronts.own)):
        _, own, below, head, stride = _sizes(fronts, s)
        side = fronts.stack[s]
        to = Dense(own, head, stride, panels, fronts.panel[s], stacks[side], filled[side], stride - head)
        panels[to.base : fronts.panel[s + 1]] = 0.0
        to.update[to.begin : to.begin + 3 * below * to.size] = 0.0
        _enter(fronts, s, values, panels, stride)
        other = 1 - side
        while waiting[other, 0] > 0 and fronts.parent[waiting[other, waiting[other, 0]]] == s:
            c = waiting[other, waiting[other, 0]]
            waiting[other, 0] -= 1
            rows = fronts.start[c + 1] - fronts.start[c] - fronts.own[c]
            filled[other] -= 3 * rows * rows_of(3 * rows)
            _extend(fronts, c, stacks[other], filled[other], to, scratch.runs)
        if not eliminate(fronts, s, values, panels, stride, scratch.least, scratch.triangles):
            return False
        if len(x) > 0:
            _forwards(fronts, s, panels, x, scratch.front)
        update(to, 3 * below)
        if fronts.parent[s] >= 0:
            waiting[side, 0] += 1
            waiting[side, waiting[side, 0]] = s
            filled[side] += 3 * below * to.size
    return True


@inner
def _enter(fronts, s, values, panels, stride):
    """Copy the matrix blocks below the diagonal to the panel of a supernode."""
    for k in range(fronts.entered[s], fronts.entered[s + 1]):
        e, at = fronts.block[k], fronts.entry[k]
        for j in range(3):
            for i in range(3):
                panels[at + j * stride + i] = values[e, j, i]


@inner
def _extend(fronts, c, source, at, to, runs):
    """Add the update of a child, stored in `source`, to its parent's front, in runs of consecutive members."""
    own, first = to.own, fronts.start[c] + fronts.own[c]
    rows = fronts.start[c + 1] - first
    height = rows_of(3 * rows)
    count = 0
    for k in range(rows):
        q = fronts.within[first + k]
        if k == 0 or q != fronts.within[first + k - 1] + 1 or q == own:
            runs[0, count] = k
            runs[1, count] = 3 * q if q < own else to.head + 3 * (q - own)
            count += 1
    runs[0, count] = rows
    run = 0
    for b in range(rows):
        if runs[0, run + 1] == b:
            run += 1
        q = fronts.within[first + b]
        for j in range(3):
            start = at + (3 * b + j) * height
            if q < own:
                _add_runs(runs, run, count, b, source, start, to.panels, to.base + (3 * q + j) * to.stride)
            else:
                column = to.begin + (3 * (q - own) + j) * to.size - to.head
                _add_runs(runs, run, count, b, source, start, to.update, column)


@inner
def _add_runs(runs, run, count, b, source, start, target, column):
    """Add the rows of a column, from member b on."""
    for k in range(run, count):
        a = max(b, runs[0, k])
        to = column + runs[1, k] + 3 * (a - runs[0, k])
        add(source, start + 3 * a, target, to, 3 * (runs[0, k + 1] - a))


@inner
def _forwards(fronts, s, panels, x, front):
    """Perform the forward substitution with the panel of a supernode; children precede parents."""
    first, own, below, head, stride = _sizes(fronts, s)
    front[: stride + ROWS] = 0.0
    _gather(x, fronts.members, first, own, front, 0)
    for tile in range(0, 3 * own, TILE):
        columns, corner = min(TILE, 3 * own - tile), fronts.panel[s] + tile * stride + tile
        strips = (stride - tile - columns + ROWS - 1) // ROWS
        if columns == 6:
            solve_columns(panels, corner, stride, front, tile, strips, 6)
        else:
            solve_columns(panels, corner, stride, front, tile, strips, 3)
    _scatter(front, 0, x, fronts.members, first, own)
    for k in range(below):
        for c in range(3):
            x[fronts.members[first + own + k], c] += front[head + 3 * k + c]


@kernel
def solve(fronts, panels, x, front, begun):
    """Overwrite x with H^-1 x.

    Args:
        fronts: structure of the factor.
        panels: factor L.
        x: right-hand sides (n, 3), overwritten.
        front: scratch, one vector longer than the largest front.
        begun: whether `factorise` has performed the forward substitution.
    """
    if not begun:
        for s in range(len(fronts.own)):
            _forwards(fronts, s, panels, x, front)
    for s in range(len(fronts.own) - 1, -1, -1):
        first, own, below, head, stride = _sizes(fronts, s)
        front[: stride + ROWS] = 0.0
        _gather(x, fronts.members, first, own, front, 0)
        _gather(x, fronts.members, first + own, below, front, head)
        for tile in range((3 * own - 1) // TILE * TILE, -1, -TILE):
            columns, corner = min(TILE, 3 * own - tile), fronts.panel[s] + tile * stride + tile
            strips = (stride - tile - columns + ROWS - 1) // ROWS
            if columns == 6:
                solve_rows(panels, corner, stride, front, tile, strips, 6)
            else:
                solve_rows(panels, corner, stride, front, tile, strips, 3)
        _scatter(front, 0, x, fronts.members, first, own)


@inner
def _sizes(fronts, s):
    """Return first member, columns and rows below in vertices, and begin and end of those rows in the panel."""
    first, own = fronts.start[s], fronts.own[s]
    below, head = fronts.start[s + 1] - first - own, rows_of(3 * own)
    return first, own, below, head, head + rows_of(3 * below)


@inner
def _gather(x, members, first, count, front, at):
    for k in range(count):
        for c in range(3):
            front[at + 3 * k + c] = x[members[first + k], c]


@inner
def _scatter(front, at, x, members, first, count):
    for k in range(count):
        for c in range(3):
            x[members[first + k], c] = front[at + 3 * k + c]
