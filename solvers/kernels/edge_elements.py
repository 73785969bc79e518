"""Compiled strain limits and dashpots, evaluated edge by edge in addition to the springs.

    E = sum_e k_e/2 |b_e|^2      b = (|v| - t) v/|v| of a limit, with t the nearest length allowed
                                 b = (n.v - o) n of a dashpot

Both are projective: the gradient is A'K b, the projection d = v - b. In block-by-block passes each edge is computed at
both of its ends, as springs are, so that no row adds to the sum of another. In a single pass it is computed once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH
from springbench.solvers.model.step_problem import Positions


class EdgeElements(NamedTuple):
    """Edges by the rows of their ends, strain limits first.

    Attributes:
        end_rows: rows of each edge (m, 2).
        row_starts: first entry of each row (rows + 1,).
        other_row: of each entry, the row of the other end.
        edge_index: of each entry, the edge, ~edge at its second end.
        stiffness: k (m,) [N/m].
        min_length, max_length: minimum and maximum lengths [m] of the limits.
        edge_axis: n of a dashpot, and the direction of a limit at zero length (m, 3).
        offset: o (m,) [m].
    """

    end_rows: NDArray[np.int64]
    row_starts: NDArray[np.int64]
    other_row: NDArray[np.int64]
    edge_index: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    min_length: NDArray[np.float64]
    max_length: NDArray[np.float64]
    edge_axis: Positions
    offset: NDArray[np.float64]

    @classmethod
    def from_edges(
        cls,
        ends: NDArray[np.int64],
        stiffness: NDArray[np.float64],
        low: NDArray[np.float64],
        high: NDArray[np.float64],
        row: NDArray[np.int64],
        rows: int,
    ) -> EdgeElements:
        """Build edges between vertices (m, 2) in rows `row` (n,)."""
        proper = np.flatnonzero(ends[:, 0] != ends[:, 1])
        here, there = row[ends[proper]].T.ravel(), row[ends[proper, ::-1]].T.ravel()
        order = np.argsort(here, kind="stable")
        return cls(
            row[ends].astype(np.int64),
            np.concatenate([[0], np.cumsum(np.bincount(here, minlength=rows))]),
            there[order],
            np.concatenate([proper, ~proper])[order],
            stiffness,
            low,
            high,
            np.zeros((len(ends), 3)),
            np.zeros(len(ends)),
        )


@jit_inner
def _evaluate_entry(edges, row, entry, x):
    """Return v and b of an entry, seen from its own end, and its stiffness."""
    j, e, sign = edges.other_row[entry], edges.edge_index[entry], 1.0
    if e < 0:
        e, sign = ~e, -1.0
    v = x[4 * row] - x[4 * j], x[4 * row + 1] - x[4 * j + 1], x[4 * row + 2] - x[4 * j + 2]
    n = sign * edges.edge_axis[e, 0], sign * edges.edge_axis[e, 1], sign * edges.edge_axis[e, 2]
    if e >= len(edges.min_length):
        scale = n[0] * v[0] + n[1] * v[1] + n[2] * v[2] - edges.offset[e]
        return v, (scale * n[0], scale * n[1], scale * n[2]), edges.stiffness[e]
    length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    scale = length - min(max(length, edges.min_length[e]), edges.max_length[e])
    if length <= ZERO_LENGTH:
        return v, (scale * n[0], scale * n[1], scale * n[2]), edges.stiffness[e]
    scale /= length
    return v, (scale * v[0], scale * v[1], scale * v[2]), edges.stiffness[e]


@jit_inner
def add_edges(edges, begin, end, x, out, shift, correct):
    """Add A'K d, or minus the gradient if `correct`, to rows shifted by `shift`.

    It is that of the rows from `begin` to `end`.
    """
    if edges is None:
        return
    for row in range(begin, end):
        s0 = s1 = s2 = 0.0
        for entry in range(edges.row_starts[row], edges.row_starts[row + 1]):
            v, b, k = _evaluate_entry(edges, row, entry, x)
            if correct:
                s0, s1, s2 = s0 - k * b[0], s1 - k * b[1], s2 - k * b[2]
            else:
                s0, s1, s2 = s0 + k * (v[0] - b[0]), s1 + k * (v[1] - b[1]), s2 + k * (v[2] - b[2])
        at = 4 * (row + shift)
        out[at], out[at + 1], out[at + 2] = out[at] + s0, out[at + 1] + s1, out[at + 2] + s2


@jit_inner
def add_edge_descent(edges, rows, x, out):
    """Add minus the gradient of all edges to the first `rows` rows of `out`, which move; return the energy [J].

    Each edge is computed once and added at both of its ends.
    """
    if edges is None:
        return 0.0
    total, limits = 0.0, len(edges.min_length)
    for e in range(len(edges.stiffness)):
        i, j, k = edges.end_rows[e, 0], edges.end_rows[e, 1], edges.stiffness[e]
        if i == j or (i >= rows and j >= rows):
            continue
        v0, v1, v2 = x[4 * i] - x[4 * j], x[4 * i + 1] - x[4 * j + 1], x[4 * i + 2] - x[4 * j + 2]
        n0, n1, n2 = edges.edge_axis[e, 0], edges.edge_axis[e, 1], edges.edge_axis[e, 2]
        if e >= limits:
            scale = n0 * v0 + n1 * v1 + n2 * v2 - edges.offset[e]
        else:
            squared = v0 * v0 + v1 * v1 + v2 * v2
            if edges.min_length[e] * edges.min_length[e] <= squared <= edges.max_length[e] * edges.max_length[e]:
                continue
            length = np.sqrt(squared)
            scale = length - min(max(length, edges.min_length[e]), edges.max_length[e])
            if length > ZERO_LENGTH:
                n0, n1, n2 = v0 / length, v1 / length, v2 / length
        total += 0.5 * k * scale * scale
        f0, f1, f2 = k * scale * n0, k * scale * n1, k * scale * n2
        if i < rows:
            out[4 * i], out[4 * i + 1], out[4 * i + 2] = out[4 * i] - f0, out[4 * i + 1] - f1, out[4 * i + 2] - f2
        if j < rows:
            out[4 * j], out[4 * j + 1], out[4 * j + 2] = out[4 * j] + f0, out[4 * j + 1] + f1, out[4 * j + 2] + f2
    return total
