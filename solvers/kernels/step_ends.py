"""Start and end of a step: conversion of the problem's arrays to the rows of the kernels and back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.kernels.loop import verdict
from solvers.kernels.step import iterate
from solvers.vectors.intrinsics import ask_for
from solvers.vectors.springs import LANES


class VertexRows(NamedTuple):
    """The rows of the vertices, and the constant data of their right-hand side.

    Attributes:
        row: row of each vertex (n,).
        right: offset of its x in the right-hand side (n,).
        inertia: m/dt^2 (n,) [N/m].
        weight: weight of each pin (q,) [N/m], infinite for an exact one.
        pinned: vertex of each pin (q,).
        coupling: entries of Q [N/m] between free and exactly pinned vertices; empty if corrections are solved for.
        coupled: the free vertex of each entry.
        pin: the pin of each entry.
    """

    row: NDArray[np.int64]
    right: NDArray[np.int64]
    inertia: NDArray[np.float64]
    weight: NDArray[np.float64]
    pinned: NDArray[np.int64]
    coupling: NDArray[np.float64]
    coupled: NDArray[np.int64]
    pin: NDArray[np.int64]


_AHEAD = 64
"""Number of vertices by which rows are prefetched, because they lie in another order in memory."""


@inner
def _ask_ahead(rows, v, x):
    ask_for(x, 4 * rows.row[min(v + _AHEAD, len(rows.row) - 1)])


@kernel
def state(rows, target, force, pin_targets, right):
    """Write the right-hand side y = M target/dt^2 + f + w C'C p_pin.

    The exact pins' columns of Q are moved to it.
    """
    for v in range(len(target)):
        ask_for(right, rows.right[min(v + _AHEAD, len(rows.right) - 1)])
        for c in range(3):
            right[rows.right[v] + LANES * c] = rows.inertia[v] * target[v, c] + force[v, c]
    for q in range(len(rows.pinned)):
        if rows.weight[q] < np.inf:
            for c in range(3):
                right[rows.right[rows.pinned[q]] + LANES * c] += rows.weight[q] * pin_targets[q, c]
    for k in range(len(rows.coupling)):
        for c in range(3):
            right[rows.right[rows.coupled[k]] + LANES * c] -= rows.coupling[k] * pin_targets[rows.pin[k], c]


@inner
def pin(rows, pin_targets, x):
    """Write the targets of the exactly pinned vertices."""
    for q in range(len(rows.pinned)):
        if rows.weight[q] == np.inf:
            for c in range(3):
                x[4 * rows.row[rows.pinned[q]] + c] = pin_targets[q, c]


@inner
def place(rows, positions, pin_targets, x):
    """Write positions to the rows of x, with exactly pinned vertices on their targets."""
    for v in range(len(positions)):
        _ask_ahead(rows, v, x)
        for c in range(3):
            x[4 * rows.row[v] + c] = positions[v, c]
    pin(rows, pin_targets, x)


@kernel
def fetch(rows, x, out):
    """Write the rows of x to positions (n, 3)."""
    for v in range(len(out)):
        _ask_ahead(rows, v, x)
        for c in range(3):
            out[v, c] = x[4 * rows.row[v] + c]


@kernel
def start(rows, vectors, p, positions, pin_targets):
    """Write the initial positions to the vectors from which the iterations start."""
    if p is not None:
        place(rows, positions, pin_targets, p)
        return
    pin(rows, pin_targets, vectors[1])
    pin(rows, pin_targets, vectors[2])
    place(rows, positions, pin_targets, vectors[0])


@kernel
def solve(plan, bundles, edges, form, rows, vectors, right, p, given, limits, threads, team, out):
    """Solve a whole step and write the positions to `out`.

    An iteration gets single arguments, because nested tuples cost 3 % of a small step.

    Args:
        plan: the plan.
        bundles: packets of the springs.
        edges: strain limits and dashpots, or None.
        form: packets of |e|_Q^2.
        rows: rows of the vertices.
        vectors: vectors of the iterations.
        right: right-hand side, overwritten.
        p: positions to correct, or None.
        given: target, force, targets of pins and initial guess.
        limits: see `solvers.kernels.loop`.
        threads: number of threads; None for one.
        team: the thread team.
        out: output (n, 3) [m].

    Returns:
        The number of iterations, the residual [J^(1/2)] and the termination reason.
    """
    target, force, pin_targets, guess = given
    state(rows, target, force, pin_targets, right)
    start(rows, vectors, p, guess, pin_targets)
    count, residual, x = iterate(plan, bundles, edges, form, vectors, right, p, limits, threads, team)
    if p is None:
        fetch(rows, x, out)
    else:
        fetch(rows, p, out)
    return count, residual, verdict(residual, limits)
