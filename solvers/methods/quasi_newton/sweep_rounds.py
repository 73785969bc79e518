"""Rounds of L-BFGS that alternate with sweeps of vertex block descent, without Python.

    p <- S^4(L^5(p))     L an iteration of L-BFGS, S a sweep over all vertices

This is a multiplicative composition of two nonlinear solvers (Brune, Knepley, Smith and Tu 2015, "Composing scalable
nonlinear algebraic solvers"). L-BFGS, preconditioned by Q, reduces smooth errors in few iterations, but Q is much
stiffer than the Hessian along springs that turn or are compressed. A sweep uses the Hessian of each vertex, which
reduces such local errors, and smooth ones hardly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.accelerated_descent import AccelerationWindow, accept_trial
from springbench.solvers.kernels.descent_rounds import build_compiled_rounds
from springbench.solvers.kernels.free_components import FreeComponents, centre_components
from springbench.solvers.kernels.iteration_loop import REASON_ITERATIONS
from springbench.solvers.kernels.objective_kernels import compute_max_magnitude
from springbench.solvers.kernels.step_setup import VertexRows, read_positions
from springbench.solvers.methods.quasi_newton.accelerated_step import (
    AcceleratedStep,
    bound_roundoff,
    compute_window_residual,
    evaluate_trial,
    solve_trial,
    start_lowest_solve,
    step_state,
)
from springbench.solvers.methods.vertex_block.vbd import SweepMemory
from springbench.solvers.methods.vertex_block.vbd_sweeps import restart_sweeps, run_unchecked_sweeps, start_sweeps
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.simd.dot_products import ordered_dot

ROUND_SWEEPS = 4
"""Sweeps of a round."""

NOT_STARTED, MOVED = -2.0, -1.0
"""Values of `SweepScratch.omega` before the first sweeps of a solve, and before those after an iteration of L-BFGS."""

CONTINUES, STARTS, STARTS_MEASURED = range(3)
"""Whether rounds continue a solve or start it, and then measure the residual at the initial guess."""


class SweepStep(NamedTuple):
    """The data of sweeps.

    Attributes:
        vertex_rows: rows of the vertices.
        sweep_memory: packets, positions in rows of four [m], right-hand side by packets [N], and scratch.
        free_components: components whose translation only inertia resists.
    """

    vertex_rows: VertexRows
    sweep_memory: SweepMemory
    free_components: FreeComponents


class StepArrays(NamedTuple):
    """The arrays of a solve.

    Attributes:
        target: inertial target (n, 3) [m].
        force: external force and constant force of the forms (n, 3) [N].
        pin_targets: target positions of the pins (q, 3) [m].
        guess: initial guess (n, 3) [m].
        external_force: force of the inertial prediction (n, 3) [N].
        current: positions at the start of the step (n, 3) [m].
        start: output, positions at the start (n, 3) [m].
        positions: output, positions (n, 3) [m].
    """

    target: NDArray[np.float64]
    force: NDArray[np.float64]
    pin_targets: NDArray[np.float64]
    guess: NDArray[np.float64]
    external_force: NDArray[np.float64]
    current: NDArray[np.float64]
    start: NDArray[np.float64]
    positions: NDArray[np.float64]


@jit_inner
def _step_window(state):
    step, window, sweeps, _ = state
    omega = sweeps.sweep_memory.sweep_scratch.omega
    omega[0] = min(omega[0], MOVED)
    return step_state((step, window))


@jit_inner
def _window_residual(state, exact_below):
    """Return the residual [J^(1/2)].

    Above `exact_below` it is the square root of grad g' Q^-1 grad g, which is known. That includes pinned vertices, and
    is not used if any of them are unknowns.
    """
    step, window, _, _ = state
    estimate = np.sqrt(window.window_state[0].correction_squarednorm)
    for q in range(len(step.vertex_rows.pin_weight)):
        if step.vertex_rows.pin_weight[q] < np.inf:
            estimate = np.nan
    return estimate if estimate > exact_below else compute_window_residual((step, window))


@jit_inner
def _copy_vertices(x, row_of_vertex, out, row_in_out):
    """Copy the coordinates of all vertices between vectors with other rows."""
    for v in range(len(row_of_vertex)):
        for c in range(3):
            out[4 * row_in_out[v] + c] = x[4 * row_of_vertex[v] + c]


@jit_inner
def _window_decrease(state):
    return state[1].window_state[0].objective_decrease


@jit_inner
def _sweep_vertices(state):
    """Do a round of sweeps, unless it raises the objective or, within round-off, the residual.

    Sweeps that follow each other continue the extrapolation. They change vertices one by one and thus do not conserve
    momentum, which the translation of free components to their equilibrium restores.
    """
    step, window, sweeps, arrays = state
    packets, rows, right, scratch = sweeps.sweep_memory
    sweep_row, window_row = sweeps.vertex_rows.row_of_vertex, step.vertex_rows.row_of_vertex
    if scratch.omega[0] == NOT_STARTED:
        read_positions(step.vertex_rows, window.position, arrays.positions)
        start_sweeps(
            sweeps.vertex_rows, arrays.target, arrays.force, arrays.pin_targets, arrays.positions, right, scratch, rows
        )
    elif scratch.omega[0] == MOVED:
        _copy_vertices(window.position, window_row, rows, sweep_row)
        restart_sweeps(scratch, rows)
    run_unchecked_sweeps(packets, right, scratch, rows, ROUND_SWEEPS)
    _copy_vertices(scratch.older_positions, sweep_row, window.trial_position, window_row)
    inertia = step.vertex_rows.inertia_diagonal
    centre_components(sweeps.free_components, inertia, arrays.target, arrays.force, window_row, window.trial_position)
    if not _accept_lower_trial(step, window):
        scratch.omega[0] = MOVED


@jit_inner
def _accept_lower_trial(step, window):
    """Accept a lower trial point, and return whether it was accepted.

    The objective is lower there or, within round-off, the residual. The change is a pair of the history like that of an
    iteration.
    """
    now, there = window.window_state[0], evaluate_trial(step, window)
    change, roundoff = there - step.objective_values[0], bound_roundoff(step)
    if change > roundoff:
        return False
    solve_trial(step, window)
    if change >= -roundoff:
        after = ordered_dot(window.trial_descent, step.solution_rows, len(window.direction))
        if after >= now.correction_squarednorm:
            return False
        change = 0.0
    now.objective_decrease -= change
    step.objective_values[0] = there
    accept_trial(window, step.solution_rows)
    return True


_iterate_rounds = build_compiled_rounds(_step_window, _window_residual, _window_decrease, _sweep_vertices)


@jit_kernel
def run_sweep_rounds(
    step: AcceleratedStep,
    window: AccelerationWindow,
    sweeps: SweepStep,
    arrays: StepArrays,
    start: Any,
    unpinned_trace: Any,
    rounds: Any,
    limits: Any,
):
    """Run rounds of iterations (`springbench.solvers.kernels.descent_rounds`) and write the positions.

    Args:
        step: data of the system; its vectors and objective values are updated.
        window: state of the solve, updated.
        sweeps: data of the sweeps; its arrays of the solve are updated.
        arrays: arrays of the solve.
        start: CONTINUES, STARTS or STARTS_MEASURED: whether the solve starts first, and whether the residual at the
            guess is computed.
        unpinned_trace: sum of the diagonal of Q over the unpinned vertices [N/m], for the residual's round-off.
        rounds: state of the rounds (1,) of type ROUND_STATE_DTYPE, updated.
        limits: limits of the loop, in rounds. A start without rounds does not compute the last residual.

    Returns:
        Number of rounds, last residual [J^(1/2)], termination reason, and the residual at the guess or NaN.
    """
    at_guess, count, residual, ended = np.nan, 0, np.nan, REASON_ITERATIONS
    if start != CONTINUES:
        sweeps.sweep_memory.sweep_scratch.omega[0] = NOT_STARTED
        at_guess, decrease = start_lowest_solve(
            step,
            window,
            arrays.target,
            arrays.force,
            arrays.pin_targets,
            arrays.guess,
            arrays.external_force,
            arrays.current,
            start == STARTS_MEASURED,
            arrays.start,
        )
        rounds[0].earlier_decrease = decrease
        rounds[0].residual_floor = EPS * compute_max_magnitude(arrays.start) * np.sqrt(unpinned_trace)
    if start == CONTINUES or limits.max_iterations > 0:
        count, residual, ended = _iterate_rounds((step, window, sweeps, arrays), rounds, limits)
    read_positions(step.vertex_rows, window.position, arrays.positions)
    return count, residual, ended, at_guess
