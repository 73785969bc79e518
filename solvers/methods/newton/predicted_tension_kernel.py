"""Compiled steps of Newton's method with predicted tensions, for springs and quadratic forms.

`springbench.solvers.methods.newton.predicted_tension` describes the method.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.accelerated_descent import AccelerationWindow
from springbench.solvers.kernels.descent_search import exceeds_roundoff
from springbench.solvers.kernels.iteration_loop import REASON_ITERATIONS, RESIDUAL_EACH, check_residual
from springbench.solvers.kernels.line_search_conditions import is_armijo_step
from springbench.solvers.kernels.objective_kernels import (
    change_objective,
    compute_inner_product,
    move_to_targets,
    write_free_gradient,
)
from springbench.solvers.kernels.residual_norm import compute_residual_norm
from springbench.solvers.kernels.spring_hessian import assemble_hessian, linearise_tensions
from springbench.solvers.methods.newton.inertia_shift import (
    MODEL_DECREASE_FRACTION,
    adapt_shift_ratio,
    reduce_shift,
)
from springbench.solvers.methods.newton.newton_kernel import solve_negative
from springbench.solvers.methods.quasi_newton.accelerated_step import AcceleratedStep, iterate_from

QUADRATIC_SLOPE_RATIO = 0.1
"""Near a minimum a Newton step leaves at most this fraction of the slope."""

PREDICTED_PROGRESS_DTYPE = np.dtype(
    [
        ("shift", np.float64),  # multiple of the inertia, infinite to drop negative transverse parts instead
        ("max_shift", np.float64),  # largest finite one
        ("shift_ratio", np.float64),  # of the next reduction
        ("can_reduce", np.int64),  # whether the quadratic model was accurate in the last step
        ("slope", np.float64),  # along the last direction [J], negative
        ("is_trial_due", np.int64),  # whether the exact Hessian is tried next
    ]
)
"""The progress of a solve."""


class Relaxation(NamedTuple):
    """The L-BFGS iterations after a step.

    Attributes:
        step, window: data and state of L-BFGS.
        target: inertial target (n, 3) [m].
        force: external force and constant force of the forms (n, 3) [N].
        pin_targets: target positions of the pins (q, 3) [m].
        num_iterations: number of iterations.
        uses_own_gradient: whether their gradient is used; else it is evaluated again.
    """

    step: AcceleratedStep
    window: AccelerationWindow
    target: NDArray[np.float64]
    force: NDArray[np.float64]
    pin_targets: NDArray[np.float64]
    num_iterations: int
    uses_own_gradient: bool


class StepBudget(NamedTuple):
    """What ends a series of steps.

    Attributes:
        min_gain: decrease per cost [J] that the last steps must exceed.
        newton_cost: cost of a factorisation.
        failure_costs: cost of a factorisation that fails at a supernode, relative to a whole one.
        spent: cost before the first step.
        max_cost: cost at which another method is tried.
    """

    min_gain: float
    newton_cost: float
    failure_costs: NDArray[np.float64]
    spent: float
    max_cost: float


@jit_kernel
def try_full_step(arrays, step_data, exact_pins, tensions, negative_fraction, shift, p, gradient, predicted, q, there):
    """Solve for a direction, and evaluate the full step along it.

    Args:
        arrays: arrays of the system; the direction is written there.
        step_data: data of the step.
        exact_pins: exactly pinned vertices, which are moved to their targets.
        tensions: tensions of the springs in the Hessian (m,) [N].
        negative_fraction: factor of the springs' negative transverse parts.
        shift: multiple of the inertia that is added.
        p: positions (n, 3) [m].
        gradient: gradient there (n, 3) [N].
        predicted: output, tensions linearised for the direction (m,) [N].
        q: output, positions after the full step (n, 3) [m].
        there: output, gradient there (n, 3) [N], if the decrease agrees with the quadratic model.

    Returns:
        The supernode at which the factorisation failed or -1, the slope [J], and the change of the objective [J].
    """
    failed = _find_direction(arrays, tensions, negative_fraction, shift, p, gradient)
    if failed >= 0:
        return failed, 0.0, 0.0
    return failed, *_evaluate_full_step(arrays, step_data, exact_pins, p, gradient, predicted, q, there)


@jit_inner
def _find_direction(arrays, tensions, negative_fraction, shift, p, gradient):
    """Write the direction; return the supernode at which the factorisation failed, or -1."""
    terms, places = arrays.search.objective_terms, arrays.block_indices
    assemble_hessian(terms, places, arrays.constant_blocks, p, tensions, negative_fraction, arrays.values)
    if shift > 0.0:
        for v in places.free_vertices:
            for c in range(3):
                arrays.values[places.diagonal_block[v], c, c] += shift * terms.inertia_diagonal[v]
    return solve_negative(arrays, arrays.factor.schedule, gradient)


@jit_inner
def _evaluate_full_step(arrays, step_data, exact_pins, p, gradient, predicted, q, there):
    """Evaluate the full step along the direction; return the slope and the change of the objective [J]."""
    terms, form = arrays.search.objective_terms, arrays.search.quadratic_form
    slope = compute_inner_product(gradient, arrays.direction)
    linearise_tensions(terms, p, arrays.direction, predicted)
    for v in range(len(p)):
        for c in range(3):
            q[v, c] = p[v, c] + arrays.direction[v, c]
    move_to_targets(exact_pins, q)
    change = change_objective(terms, form, step_data, p, q)
    if change <= MODEL_DECREASE_FRACTION * slope:
        write_free_gradient(terms, form, step_data, exact_pins, q, there)
    return slope, change


@jit_kernel
def run_predicted_steps(
    arrays,
    step_data,
    exact_pins,
    relaxation,
    limits,
    budget,
    compared,
    is_compared,
    tensions,
    predicted,
    p,
    gradient,
    recent,
    decreases,
    costs,
    progress,
):
    """Run full steps, each followed by L-BFGS iterations unless its decrease agrees with the quadratic model.

    They end before a step that needs a line search or a larger shift.

    Args:
        arrays: arrays of the system.
        step_data: data of the step.
        exact_pins: exactly pinned vertices and their targets.
        relaxation: L-BFGS iterations.
        limits: limits of the loop, in steps.
        budget: what ends it.
        compared: positions (n, 3) [m] from which the first decrease is computed.
        is_compared: whether these are not the current positions.
        tensions: predicted tensions (m,) [N], updated.
        predicted: scratch (m,) [N].
        p: positions (n, 3) [m], updated.
        gradient: gradient there (n, 3) [N], updated.
        recent: decrease [J] and cost of the last steps, the last one last (2, k); updated, zero for no step.
        decreases: output, decrease of the objective in each step [J]; its length limits their number.
        costs: output, factorisations in each step.
        progress: progress of the solve (1,), updated.

    Returns:
        Number of steps, and the last residual [J^(1/2)] or NaN.
    """
    now, count, spent, residual, ended = progress[0], 0, budget.spent, np.nan, REASON_ITERATIONS
    while count < min(limits.max_iterations, len(decreases)) and ended == REASON_ITERATIONS:
        fall, cost = _take_step(
            arrays,
            step_data,
            exact_pins,
            relaxation,
            budget,
            compared,
            is_compared and count == 0,
            tensions,
            predicted,
            p,
            gradient,
            now,
        )
        if not fall > 0.0:
            break
        decreases[count], costs[count] = fall, cost
        count += 1
        if limits.residual_mode == RESIDUAL_EACH:
            residual = compute_residual_norm(arrays.search.residual_norm, gradient)
            ended = check_residual(residual, limits)
        cost *= budget.newton_cost
        spent += cost
        if now.is_trial_due == 1 or spent >= budget.max_cost or not _add_recent(recent, fall, cost) > budget.min_gain:
            break
    return count, residual


@jit_inner
def _add_recent(recent, fall, cost):
    """Add a step to the last ones, and return their decrease per cost [J]."""
    last = recent.shape[1] - 1
    for k in range(last):
        recent[0, k], recent[1, k] = recent[0, k + 1], recent[1, k + 1]
    recent[0, last], recent[1, last] = fall, cost
    return recent[0].sum() / recent[1].sum()


@jit_inner
def _take_step(
    arrays, step_data, exact_pins, relaxation, budget, compared, is_compared, tensions, predicted, p, gradient, now
):
    """Do a step if it needs no line search and no larger shift.

    Return the decrease of the objective [J], zero for no step, and the factorisations made.
    """
    search, is_smaller = arrays.search, now.can_reduce == 1 and now.shift > 0.0
    q, there = search.trial_positions, search.trial_gradient
    shift, ratio, cost = now.shift, now.shift_ratio, 1.0
    if is_smaller:
        shift = reduce_shift(now.shift, ratio, now.max_shift)
    failed = _find_shifted_direction(arrays, tensions, shift, p, gradient)
    if is_smaller:
        ratio = adapt_shift_ratio(now.shift, ratio, failed < 0)
        if failed >= 0:
            shift, cost = now.shift, cost + budget.failure_costs[failed]
            failed = _find_shifted_direction(arrays, tensions, shift, p, gradient)
    if failed >= 0:
        return 0.0, cost
    slope, change = _evaluate_full_step(arrays, step_data, exact_pins, p, gradient, predicted, q, there)
    if not exceeds_roundoff(search, p, -slope):
        return 0.0, cost
    is_sufficient = change <= MODEL_DECREASE_FRACTION * slope
    if not is_sufficient:
        _relax_positions(arrays, step_data, exact_pins, relaxation, q, there)
        change = change_objective(search.objective_terms, search.quadratic_form, step_data, p, q)
        if not is_armijo_step(change, 1.0, slope, 0.0):
            return 0.0, cost
    if is_compared:
        change = change_objective(search.objective_terms, search.quadratic_form, step_data, compared, q)
    if not change < 0.0:
        return 0.0, cost
    for v in range(len(p)):
        for c in range(3):
            p[v, c], gradient[v, c] = q[v, c], there[v, c]
    for e in range(len(tensions)):
        tensions[e] += 1.0 * (predicted[e] - tensions[e])
    now.is_trial_due = shift == 0.0 and is_sufficient and slope >= QUADRATIC_SLOPE_RATIO * now.slope
    now.shift, now.shift_ratio, now.slope = shift, ratio, slope
    now.can_reduce = is_sufficient or shift == np.inf
    return -change, cost


@jit_inner
def _find_shifted_direction(arrays, tensions, shift, p, gradient):
    """Write the direction; an infinite shift drops negative transverse parts instead."""
    if shift < np.inf:
        return _find_direction(arrays, tensions, 1.0, shift, p, gradient)
    return _find_direction(arrays, tensions, 0.0, 0.0, p, gradient)


@jit_inner
def _relax_positions(arrays, step_data, exact_pins, relaxation, q, there):
    """Do the L-BFGS iterations from q, and write the positions and the gradient at their end."""
    step, window, target, force, pin_targets, num_iterations, uses_own_gradient = relaxation
    iterate_from(step, window, target, force, pin_targets, num_iterations, q, there)
    if not uses_own_gradient:
        terms, form = arrays.search.objective_terms, arrays.search.quadratic_form
        write_free_gradient(terms, form, step_data, exact_pins, q, there)
