"""The multifrontal Cholesky factorisation (Duff and Reid 1983) of a matrix of 3 x 3 blocks, and a solve with it.

A front is the dense matrix of a supernode's columns and of the rows below. Its columns are a panel of L in the end, the
rest is an update of its parent (`solvers.linear.block_front`). Updates wait on two stacks that take turns from level to
level of the tree, so that each is made where it waits, while those of its children are read.

Rows begin at whole vectors: those of a panel's columns, and those below, which is all the padding there is. What lies
above the diagonal is never read; on it are the inverses of L's entries.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.linear.block_front import Dense, eliminate, rows_of, update
from solvers.vectors.block import ROWS, TILE, add, solve_columns, solve_rows


class Fronts(NamedTuple):
    """The structure of a factor over n vertices, s supernodes in a postorder.

    start (s + 1,), members: of each supernode the vertices of its columns, and then of the rows below; own (s,): how
    many are columns; within: of each member below its place among the parent's; parent (s,), -1 for a root;
    stack (s,): which of the two its update waits on; panel (s + 1,): where its panel begins; entered (s + 1,): the
    first of its matrix's blocks in `block` (b,), which go to `entry` (b,); diagonal (n,): that of each vertex.
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
    """What a factorisation writes to beside its panels, for n vertices and s supernodes.

    front: a vector longer than the largest front; stacks (2, room): of updates, the numbers in use counted in filled
    (2,); waiting (2, s + 1): supernodes on each, their count first; least (TILE,), triangles (., TILE, TILE) of so many
    columns as are multiplied together, runs (2, n + 1).
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
    """Write L to `panels` from the blocks of the matrix, values (b, 3, 3); returns whether it is positive definite.

    x (n, 3), or nothing: overwritten with L^-1 x while each panel is at hand.
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
    """Put the matrix's blocks below the diagonal into the panel of a supernode."""
    for k in range(fronts.entered[s], fronts.entered[s + 1]):
        e, at = fronts.block[k], fronts.entry[k]
        for j in range(3):
            for i in range(3):
                panels[at + j * stride + i] = values[e, j, i]


@inner
def _extend(fronts, c, source, at, to, runs):
    """Add the update of a child c, which waits in `source`, to its parent's front, in runs of members that are
    neighbours in both."""
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
    """Add the rows from member b on of a column."""
    for k in range(run, count):
        a = max(b, runs[0, k])
        to = column + runs[1, k] + 3 * (a - runs[0, k])
        add(source, start + 3 * a, target, to, 3 * (runs[0, k + 1] - a))


@inner
def _forwards(fronts, s, panels, x, front):
    """The solve's pass over the panel of a supernode, children first."""
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
    """Overwrite x (n, 3) with H^-1 x; front: scratch, a vector longer than the largest front.

    begun: whether `factorise` has done the first half.
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
    """The first member of a supernode, its columns and rows below in vertices, and where those rows begin and end."""
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
