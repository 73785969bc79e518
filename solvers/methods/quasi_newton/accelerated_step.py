"""A whole accelerated step over the rows of a factor, without Python.

It supports springs and spring-like energies. The plan is that of `springbench.solvers.kernels.local_global_iteration`,
which corrects positions within the solve. Here a solve is separate, because the acceptance of a trial depends on its
objective.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.accelerated_descent import (
    TRIAL_AGAIN,
    TRIAL_STALLED,
    AccelerationWindow,
    accept_trial,
    assess_trial,
    init_window,
    propose_trial,
)
from springbench.solvers.kernels.edge_elements import sum_squared_stretch
from springbench.solvers.kernels.iteration_loop import build_compiled_loop
from springbench.solvers.kernels.local_global_iteration import IterationPlan
from springbench.solvers.kernels.objective_kernels import place_pinned, predict_positions
from springbench.solvers.kernels.spring_local_step import SpringPackets, squared_norm
from springbench.solvers.kernels.spring_objective import ObjectiveWeights, value_and_descent
from springbench.solvers.kernels.step_setup import VertexRows, read_positions, write_positions, write_right_hand_side
from springbench.solvers.linalg.cholesky.triangular_solve import backward_substitution, forward_substitution

TERM_ROUNDOFF = 4.0 * np.finfo(np.float64).eps
"""A bound on the relative rounding error of one term of a sum. The bound on the whole sum adds up those of its terms.
The true errors partly cancel, so that for n terms the bound is about sqrt(n) times too large."""


class AcceleratedStep(NamedTuple):
    """The plan, packets, objective weights and rows of a system, with vectors of all rows.

    The vectors are y, the solution (in the factor's type) and scratch (zero except in unknown rows). The objective
    values (3,) [J] are the objective at the position, the scale of its cancellation, and its initial negative part.

    The objective is a sum of squares a^2/2, where each a is a difference of two numbers of size A and so has the error
    eps A. The sum has the error eps (sum of a A), at most eps sqrt(2 g size), with size the sum of A^2. If some squares
    have a negative sign, g is the sum of the absolute terms.
    """

    iteration_plan: IterationPlan
    spring_packets: SpringPackets
    norm_packets: SpringPackets
    objective_weights: ObjectiveWeights
    vertex_rows: VertexRows
    right_hand_side: NDArray[np.float64]
    solution_rows: NDArray[Any]
    displacement_rows: NDArray[np.float64]
    objective_values: NDArray[np.float64]


@jit_kernel
def start_solve(step: AcceleratedStep, window: AccelerationWindow, target, force, pin_targets, guess):
    """Start the solve of a step at a guess.

    Args:
        step: data of the system; its vectors and objective values are overwritten.
        window: state of the solve, initialised at the start.
        target: inertial target (n, 3) [m].
        force: external force and constant force of the forms (n, 3) [N].
        pin_targets: target positions of the pins (q, 3) [m].
        guess: initial guess (n, 3) [m].

    Returns:
        The residual [J^(1/2)] at the guess.
    """
    _evaluate_guess(step, window, target, force, pin_targets, guess)
    _start_window(step, window)
    return compute_window_residual((step, window))


@jit_inner
def iterate_from(step, window, negative_pairs, target, force, pin_targets, num_iterations, p, gradient):
    """Do iterations from positions, at most up to the first that finds no descent.

    Args:
        step: data of the system; its vectors and objective values are overwritten.
        window: state of the solve, initialised at the positions.
        negative_pairs: pairs of negative stiffness (k, 2), and its absolute value (k,) [N/m].
        target: inertial target (n, 3) [m].
        force: external force and constant force of the forms (n, 3) [N].
        pin_targets: target positions of the pins (q, 3) [m].
        num_iterations: number of iterations.
        p: positions (n, 3) [m], updated.
        gradient: output, gradient there (n, 3) [N].
    """
    _evaluate_guess(step, window, target, force, pin_targets, p)
    _start_window(step, window)
    step.objective_values[2] = 0.5 * sum_squared_stretch(*negative_pairs, p)
    for _ in range(num_iterations):
        if not step_state((step, window)):
            break
    read_positions(step.vertex_rows, window.position, p)
    read_positions(step.vertex_rows, window.descent, gradient)
    for v in range(len(gradient)):
        for c in range(3):
            gradient[v, c] = -gradient[v, c]


@jit_inner
def start_lowest_solve(step, window, target, force, pin_targets, guess, external_force, current, measures_guess, out):
    """Start the solve at the point with the lowest objective.

    The points are the guess and, if it is the current positions, the inertial target and the inertial prediction.

    Args:
        step: data of the system; its vectors and objective values are overwritten.
        window: state of the solve, initialised at the start.
        target: inertial target (n, 3) [m].
        force: external force and constant force of the forms (n, 3) [N].
        pin_targets: target positions of the pins (q, 3) [m].
        guess: initial guess (n, 3) [m].
        external_force: force of the inertial prediction (n, 3) [N].
        current: positions at the start of the step (n, 3) [m].
        measures_guess: whether the residual at the guess is computed.
        out: output (n, 3) [m], the positions at the start.

    Returns:
        The residual [J^(1/2)] at the guess, NaN if it is not computed, and the decrease of the objective from there to
        the start [J].
    """
    rows, size, at_guess = step.vertex_rows, len(window.direction), np.nan
    _evaluate_guess(step, window, target, force, pin_targets, guess)
    if measures_guess:
        _start_window(step, window)
        at_guess = compute_window_residual((step, window))
    _copy_trial(window)
    before = step.objective_values[0]
    if not _differs(guess.flat, current.flat, guess.size):
        for v in range(len(out)):
            for c in range(3):
                out[v, c] = target[v, c]
        place_pinned(rows.pinned_vertices, pin_targets, out)
        _move_if_lower(step, window, pin_targets, out)
        predict_positions(rows.inertia_diagonal, target, external_force, rows.pinned_vertices, pin_targets, out)
        _move_if_lower(step, window, pin_targets, out)
    for k in range(size):
        window.trial_position[k], window.trial_descent[k] = window.position[k], window.descent[k]
    read_positions(rows, window.trial_position, out)
    decrease = before - step.objective_values[0]
    if decrease > 0.0 or not measures_guess:
        _start_window(step, window)
    return at_guess, decrease


@jit_inner
def _move_if_lower(step, window, pin_targets, p):
    """Move to positions p (n, 3) [m] if they lower the objective."""
    write_positions(step.vertex_rows, p, pin_targets, window.trial_position)
    if not _differs(window.trial_position, window.position, len(window.direction)):
        return
    there = evaluate_trial(step, window)
    if there < step.objective_values[0]:
        step.objective_values[0] = there
        _copy_trial(window)


@jit_inner
def _copy_trial(window):
    """Copy the trial point to the current point."""
    for k in range(len(window.direction)):
        window.position[k], window.descent[k] = window.trial_position[k], window.trial_descent[k]


@jit_inner
def _differs(one, other, size):
    """Return whether any of the first entries of two vectors differ."""
    differs = False
    for k in range(size):
        differs |= one[k] != other[k]
    return differs


@jit_inner
def _evaluate_guess(step, window, target, force, pin_targets, guess):
    """Write the right-hand side of a step, and evaluate the guess as a trial."""
    write_right_hand_side(step.vertex_rows, target, force, pin_targets, step.right_hand_side)
    write_positions(step.vertex_rows, guess, pin_targets, window.trial_position)
    step.objective_values[0] = evaluate_trial(step, window)


@jit_inner
def _start_window(step, window):
    """Start the window at the trial point."""
    total = step.objective_weights.energy_scale
    for k in range(len(window.direction)):
        total += step.iteration_plan.anchor_stiffness[k // 4] * window.trial_position[k] ** 2
    step.objective_values[1] = total
    solve_trial(step, window)
    init_window(window, step.solution_rows)
    window.window_state[0].objective_decrease = 0.0


@jit_inner
def step_state(state):
    """Do one iteration of a state (step, window); return whether a trial was accepted."""
    step, window = state
    now, there, verdict = window.window_state[0], 0.0, TRIAL_AGAIN
    propose_trial(window)
    while verdict == TRIAL_AGAIN:
        there = evaluate_trial(step, window)
        now.objective_change, now.roundoff = there - step.objective_values[0], bound_roundoff(step)
        verdict = assess_trial(window)
    if verdict == TRIAL_STALLED:
        return False
    step.objective_values[0] = there
    solve_trial(step, window)
    accept_trial(window, step.solution_rows)
    return True


@jit_inner
def bound_roundoff(step):
    """Return the bound on the rounding error of the objective [J]."""
    before, size = abs(step.objective_values[0]) + 2.0 * step.objective_values[2], step.objective_values[1]
    return TERM_ROUNDOFF * (before + np.sqrt(2.0 * before * size))


@jit_inner
def solve_trial(step, window):
    """Write the plain correction at the trial point to the solution rows [m].

    Args:
        step: data of the system.
        window: state of the solve, with the descent at its trial point.
    """
    _solve_rows(step.iteration_plan, window.trial_descent, len(window.direction), step.solution_rows)


@jit_inner
def evaluate_trial(step, window):
    """Write minus the gradient at the trial point [N], and return the objective there [J].

    Args:
        step: data of the system.
        window: state of the solve, with a trial point.
    """
    return value_and_descent(
        step.spring_packets, step.objective_weights, window.trial_position, step.right_hand_side, window.trial_descent
    )


@jit_inner
def compute_window_residual(state):
    """Return |c|_Q [J^(1/2)] over the unpinned vertices."""
    step, window = state
    for i in range(len(window.correction) // 4):
        for k in range(4 * i, 4 * i + 3):
            step.displacement_rows[k] = step.iteration_plan.unpinned_mask[i] * window.correction[k]
    return np.sqrt(
        squared_norm(
            step.norm_packets,
            0,
            len(step.norm_packets.packet_start) - 1,
            step.displacement_rows,
            step.iteration_plan.norm_diagonal,
        )
    )


_iterate_loop = build_compiled_loop(step_state, compute_window_residual)


@jit_kernel
def run_solve(step: AcceleratedStep, window: AccelerationWindow, limits, out):
    """Run the iteration loop (`springbench.solvers.kernels.iteration_loop`) and write the positions to `out`.

    Args:
        step: data of the system; its vectors and objective values are updated.
        window: state of the solve, from `start_solve`; updated.
        limits: limits of the loop, in iterations.
        out: positions (n, 3) [m].

    Returns:
        Number of iterations, last residual [J^(1/2)] and termination reason.
    """
    answer = _iterate_loop((step, window), limits)
    read_positions(step.vertex_rows, window.position, out)
    return answer


@jit_inner
def _solve_rows(plan, b, size, x):
    """Solve Q x = b in rows: groups forwards, the top, groups backwards."""
    top, top_end, groups = plan.top_range
    copied = 4 * (top_end - top)
    for k in range(size):
        x[4 * plan.row_shift + k] = b[k]
    for group in range(groups):
        copy = 4 * top + (group + 1) * copied
        for k in range(copied):
            x[copy + k] = 0.0
        for block in range(plan.group_blocks[group], plan.group_blocks[group + 1]):
            _, _, _, _, chunk, end, _ = plan.block_table[block]
            forward_substitution(plan.panels, plan.row_slots, plan.chunks, chunk, end, x)
    for k in range(4 * top, 4 * top + copied):
        for group in range(groups):
            x[k] += x[k + (group + 1) * copied]
    for block in range(plan.group_blocks[-2], plan.group_blocks[-1]):
        _, _, _, _, chunk, middle, end = plan.block_table[block]
        forward_substitution(plan.panels, plan.row_slots, plan.chunks, chunk, middle, x)
        backward_substitution(plan.inverse_blocks, plan.panels, plan.row_slots, plan.chunks, chunk, end, x)
    for group in range(groups):
        copy = 4 * top + (group + 1) * copied
        for k in range(copied):
            x[copy + k] = x[4 * top + k]
        for block in range(plan.group_blocks[group + 1] - 1, plan.group_blocks[group] - 1, -1):
            _, _, _, _, chunk, _, end = plan.block_table[block]
            backward_substitution(plan.inverse_blocks, plan.panels, plan.row_slots, plan.chunks, chunk, end, x)
