"""Rounds of L-BFGS that alternate with sweeps of vertex block descent, without Python.

    p <- S^5(L^10(p))     L an iteration of L-BFGS, S a sweep over all vertices

This is a multiplicative composition of two nonlinear solvers (Brune, Knepley, Smith and Tu 2015, "Composing scalable
nonlinear algebraic solvers"). L-BFGS, preconditioned by Q, reduces smooth errors in few iterations, but Q is much
stiffer than the Hessian along springs that turn or are compressed. A sweep uses the Hessian of each vertex, which
reduces such local errors, and smooth ones hardly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.accelerated_descent import AccelerationWindow, accept_trial
from springbench.solvers.kernels.descent_rounds import build_compiled_rounds
from springbench.solvers.kernels.step_setup import VertexRows, read_positions
from springbench.solvers.methods.quasi_newton.accelerated_step import (
    AcceleratedStep,
    bound_roundoff,
    compute_window_residual,
    evaluate_trial,
    solve_trial,
    step_state,
)
from springbench.solvers.methods.vertex_block.vbd import SweepMemory
from springbench.solvers.methods.vertex_block.vbd_sweeps import run_iterations, start_sweeps
from springbench.solvers.simd.dot_products import ordered_dot

ROUND_SWEEPS = 5
"""Sweeps of a round."""

NOT_STARTED = -1.0
"""Chebyshev factor before the first round of sweeps after an iteration of L-BFGS."""


class SweepStep(NamedTuple):
    """The data of sweeps, and the arrays of a solve.

    Attributes:
        vertex_rows: rows of the vertices.
        spectral_radius: spectral radius of Chebyshev's extrapolation.
        sweep_memory: packets, positions in rows of four [m], right-hand side by packets [N], and scratch.
    """

    vertex_rows: VertexRows
    spectral_radius: float
    sweep_memory: SweepMemory


@jit_inner
def _step_window(state):
    step, window, sweeps, _, _ = state
    sweeps.sweep_memory.sweep_scratch.omega[0] = NOT_STARTED
    return step_state((step, window))


@jit_inner
def _window_residual(state):
    step, window, _, _, _ = state
    return compute_window_residual((step, window))


@jit_inner
def _window_decrease(state):
    return state[1].window_state[0].objective_decrease


@jit_inner
def _sweep_vertices(state):
    """Do a round of sweeps, unless it raises the objective or, within round-off, the residual.

    Sweeps that follow each other continue Chebyshev's extrapolation.
    """
    step, window, sweeps, step_arrays, out = state
    packets, rows, right, scratch = sweeps.sweep_memory
    if scratch.omega[0] == NOT_STARTED:
        read_positions(step.vertex_rows, window.position, out)
        target, force, pin_targets = step_arrays
        start_sweeps(sweeps.vertex_rows, target, force, pin_targets, out, right, scratch, rows)
    run_iterations(packets, None, None, right, sweeps.spectral_radius, scratch, rows, ROUND_SWEEPS)
    source, destination = sweeps.vertex_rows.row_of_vertex, step.vertex_rows.row_of_vertex
    for v in range(len(source)):
        for c in range(3):
            window.trial_position[4 * destination[v] + c] = rows[4 * source[v] + c]
    if not _accept_lower_trial(step, window):
        scratch.omega[0] = NOT_STARTED


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
    step_arrays: Any,
    rounds: Any,
    limits: Any,
    out: Any,
):
    """Run rounds of iterations (`springbench.solvers.kernels.descent_rounds`) and write the positions to `out`.

    Args:
        step: data of the system; its vectors and objective values are updated.
        window: state of the solve, from `accelerated_step.start_solve`; updated.
        sweeps: data of the sweeps; its arrays of the solve are updated.
        step_arrays: inertial target [m] and external force [N], (n, 3), and targets of the pins (q, 3) [m].
        rounds: state of the rounds (1,) of type ROUND_STATE_DTYPE, updated.
        limits: limits of the loop, in rounds.
        out: positions (n, 3) [m].

    Returns:
        Number of rounds, last residual [J^(1/2)] and termination reason.
    """
    answer = _iterate_rounds((step, window, sweeps, step_arrays, out), rounds, limits)
    read_positions(step.vertex_rows, window.position, out)
    return answer
