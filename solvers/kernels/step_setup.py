"""Conversion of a step's arrays to the rows of the kernels and back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.iteration_loop import check_residual
from springbench.solvers.kernels.local_global_iteration import run_iterations
from springbench.solvers.simd.llvm_vectors import prefetch_entry
from springbench.solvers.simd.spring_packets import LANES


class VertexRows(NamedTuple):
    """The rows of the vertices, and the constant data of their right-hand side.

    Attributes:
        row_of_vertex: row of each vertex (n,).
        right_hand_side_offset: offset of its x in the right-hand side (n,).
        inertia_diagonal: m/dt^2 (n,) [N/m].
        pin_weight: weight of each pin (q,) [N/m], infinite for an exact one.
        pinned_vertices: vertex of each pin (q,).
        pin_coupling: entries of Q [N/m] between free and exactly pinned vertices; empty if corrections are solved for.
        coupled_vertices: the free vertex of each entry.
        coupled_pins: the pin of each entry.
    """

    row_of_vertex: NDArray[np.int64]
    right_hand_side_offset: NDArray[np.int64]
    inertia_diagonal: NDArray[np.float64]
    pin_weight: NDArray[np.float64]
    pinned_vertices: NDArray[np.int64]
    pin_coupling: NDArray[np.float64]
    coupled_vertices: NDArray[np.int64]
    coupled_pins: NDArray[np.int64]


_PREFETCH_DISTANCE = 64
"""Number of vertices by which rows are prefetched, because they lie in another order in memory."""


@jit_inner
def _prefetch_row(rows, v, x):
    prefetch_entry(x, 4 * rows.row_of_vertex[min(v + _PREFETCH_DISTANCE, len(rows.row_of_vertex) - 1)])


@jit_kernel
def write_right_hand_side(rows, target, force, pin_targets, right):
    """Write the right-hand side y = M target/dt^2 + f + w C'C p_pin.

    The exact pins' columns of Q are moved to it.

    Args:
        rows: rows of the vertices.
        target: inertial target (n, 3) [m].
        force: external force (n, 3) [N].
        pin_targets: targets of all pins (q, 3) [m].
        right: output by packets, eight x, y, z [N] and stiffnesses [N/m] each; the stiffnesses are constant.
    """
    for v in range(len(target)):
        prefetch_entry(
            right, rows.right_hand_side_offset[min(v + _PREFETCH_DISTANCE, len(rows.right_hand_side_offset) - 1)]
        )
        for c in range(3):
            right[rows.right_hand_side_offset[v] + LANES * c] = rows.inertia_diagonal[v] * target[v, c] + force[v, c]
    for q in range(len(rows.pinned_vertices)):
        if rows.pin_weight[q] < np.inf:
            for c in range(3):
                right[rows.right_hand_side_offset[rows.pinned_vertices[q]] + LANES * c] += (
                    rows.pin_weight[q] * pin_targets[q, c]
                )
    for k in range(len(rows.pin_coupling)):
        for c in range(3):
            right[rows.right_hand_side_offset[rows.coupled_vertices[k]] + LANES * c] -= (
                rows.pin_coupling[k] * pin_targets[rows.coupled_pins[k], c]
            )


@jit_inner
def write_exact_pins(rows, pin_targets, x):
    """Write the targets of the exactly pinned vertices.

    Args:
        rows: rows of the vertices.
        pin_targets: targets of all pins (q, 3) [m].
        x: rows of four [m], updated.
    """
    for q in range(len(rows.pinned_vertices)):
        if rows.pin_weight[q] == np.inf:
            for c in range(3):
                x[4 * rows.row_of_vertex[rows.pinned_vertices[q]] + c] = pin_targets[q, c]


@jit_inner
def write_positions(rows, positions, pin_targets, x):
    """Write positions to rows, with exactly pinned vertices on their targets.

    Args:
        rows: rows of the vertices.
        positions: positions (n, 3) [m].
        pin_targets: targets of all pins (q, 3) [m].
        x: output in rows of four [m].
    """
    for v in range(len(positions)):
        _prefetch_row(rows, v, x)
        for c in range(3):
            x[4 * rows.row_of_vertex[v] + c] = positions[v, c]
    write_exact_pins(rows, pin_targets, x)


@jit_kernel
def read_positions(rows, x, out):
    """Read the rows of the vertices.

    Args:
        rows: rows of the vertices.
        x: rows of four, such as positions [m].
        out: output by vertices (n, 3).
    """
    for v in range(len(out)):
        _prefetch_row(rows, v, x)
        for c in range(3):
            out[v, c] = x[4 * rows.row_of_vertex[v] + c]


@jit_kernel
def init_vectors(rows, vectors, p, positions, pin_targets):
    """Write the initial positions to the vectors from which the iterations start.

    Args:
        rows: rows of the vertices.
        vectors: vectors of the iterations in rows of four, updated if p is None.
        p: output in rows of four [m], positions to correct, or None.
        positions: initial guess (n, 3) [m].
        pin_targets: targets of all pins (q, 3) [m].
    """
    if p is not None:
        write_positions(rows, positions, pin_targets, p)
        return
    write_exact_pins(rows, pin_targets, vectors[1])
    write_exact_pins(rows, pin_targets, vectors[2])
    write_positions(rows, positions, pin_targets, vectors[0])


@jit_kernel
def solve_step(plan, packets, form, rows, vectors, right, p, step_arrays, limits, threads, team, out):
    """Solve a whole step and write the positions to `out`.

    An iteration gets single arguments, because nested tuples cost 3 % of a small step.

    Args:
        plan: the plan.
        packets: packets of the springs and edges.
        form: packets of |e|_Q^2.
        rows: rows of the vertices.
        vectors: vectors of the iterations.
        right: right-hand side, overwritten.
        p: positions to correct, or None.
        step_arrays: target, force, targets of pins and initial guess.
        limits: maximum number of iterations, and residuals that end them (`LoopLimits`).
        threads: number of threads; None for one.
        team: the thread team.
        out: output (n, 3) [m].

    Returns:
        The number of iterations, the residual [J^(1/2)] and the termination reason.
    """
    target, force, pin_targets, guess = step_arrays
    write_right_hand_side(rows, target, force, pin_targets, right)
    init_vectors(rows, vectors, p, guess, pin_targets)
    count, residual, x = run_iterations(plan, packets, form, vectors, right, p, limits, threads, team)
    if p is None:
        read_positions(rows, x, out)
    else:
        read_positions(rows, p, out)
    return count, residual, check_residual(residual, limits)
