"""Compiled steps of Newton's method with predicted tensions, for springs and quadratic forms.

`springbench.solvers.methods.newton.predicted_tension` describes the method.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.accelerated_descent import AccelerationWindow
from springbench.solvers.kernels.descent_search import exceeds_roundoff, move_to_trial
from springbench.solvers.kernels.iteration_loop import REASON_ITERATIONS, check_residual, needs_residual
from springbench.solvers.kernels.line_search_conditions import MAX_HALVINGS, is_armijo_step
from springbench.solvers.kernels.objective_kernels import (
    change_objective,
    compute_inner_product,
    compute_product_with_displacement,
    move_to_targets,
    try_step,
    write_free_gradient,
)
from springbench.solvers.kernels.residual_norm import compute_residual_norm
from springbench.solvers.kernels.spring_hessian import assemble_hessian, linearise_tensions
from springbench.solvers.methods.newton.inertia_shift import (
    FIRST_SHIFT_RATIO,
    MODEL_DECREASE_FRACTION,
    adapt_shift_ratio,
    increase_shift,
    reduce_shift,
)
from springbench.solvers.methods.newton.newton_kernel import NewtonArrays, solve_negative
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


class LocalRelaxation(NamedTuple):
    """The L-BFGS iterations after a step.

    Attributes:
        step, window: data and state of L-BFGS.
        negative_pairs: pairs of negative stiffness (k, 2), and its absolute value (k,) [N/m].
        target: inertial target (n, 3) [m].
        force: external force and constant force of the forms (n, 3) [N].
        pin_targets: target positions of the pins (q, 3) [m].
        num_iterations: number of iterations.
        uses_own_gradient: whether their gradient is used; else it is evaluated again.
    """

    step: AcceleratedStep
    window: AccelerationWindow
    negative_pairs: tuple[NDArray[np.int64], NDArray[np.float64]]
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


class _PredictedState(NamedTuple):
    """The state of a solve; the attributes are those of `run_predicted_steps`."""

    arrays: NewtonArrays
    step_data: Any
    exact_pins: Any
    relaxation: LocalRelaxation
    failure_costs: NDArray[np.float64]
    tensions: NDArray[np.float64]
    predicted: NDArray[np.float64]
    p: NDArray[np.float64]
    gradient: NDArray[np.float64]
    progress: NDArray[Any]


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
    """Run steps of Newton's method with predicted tensions.

    The first that does not decrease the objective is the last one.

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
        decreases: output, decrease of the objective in each step [J], zero in the last one if the positions did not
            change; its length limits their number.
        costs: output, factorisations in each step.
        progress: progress of the solve (1,), updated.

    Returns:
        Number of steps that changed the positions, number of all steps, and the last residual [J^(1/2)] or NaN.
    """
    state = _PredictedState(
        arrays, step_data, exact_pins, relaxation, budget.failure_costs, tensions, predicted, p, gradient, progress
    )
    now, count, spent, residual, ended = progress[0], 0, budget.spent, np.nan, REASON_ITERATIONS
    while count < min(limits.max_iterations, len(decreases)) and ended == REASON_ITERATIONS:
        decreases[count], costs[count] = _take_step(state, compared, is_compared and count == 0)
        if decreases[count] == 0.0:
            return count, count + 1, residual
        if needs_residual(limits, count + 1):
            residual = compute_residual_norm(arrays.search.residual_norm, gradient)
            ended = check_residual(residual, limits)
        cost = budget.newton_cost * costs[count]
        gain, spent, count = _add_recent(recent, decreases[count], cost), spent + cost, count + 1
        if now.is_trial_due == 1 or spent >= budget.max_cost or gain <= budget.min_gain:
            break
    return count, count, residual


@jit_inner
def _add_recent(recent, decrease, cost):
    """Add a step to the last ones, and return their decrease per cost [J]."""
    last = recent.shape[1] - 1
    for k in range(last):
        recent[0, k], recent[1, k] = recent[0, k + 1], recent[1, k + 1]
    recent[0, last], recent[1, last] = decrease, cost
    return recent[0].sum() / recent[1].sum()


@jit_inner
def _take_step(state, compared, is_compared):
    """Do a step; return the decrease of the objective [J], or zero, and the factorisations made."""
    now, search, d, length = state.progress[0], state.arrays.search, state.arrays.direction, 1.0
    p, gradient, q, there = state.p, state.gradient, search.trial_positions, search.trial_gradient
    terms, tensions = (search.objective_terms, search.quadratic_form, state.step_data), state.tensions
    before, is_found, cost = now.slope, *_find_direction(state)
    now.is_trial_due = 1
    if not is_found:
        return 0.0, cost
    now.slope = slope = compute_inner_product(gradient, d)
    if not exceeds_roundoff(search, p, -slope):
        return 0.0, cost
    linearise_tensions(search.objective_terms, p, d, state.predicted)
    for v in range(len(p)):
        for c in range(3):
            q[v, c] = p[v, c] + d[v, c]
    move_to_targets(state.exact_pins, q)
    change = change_objective(*terms, p, q)
    is_sufficient = change <= MODEL_DECREASE_FRACTION * slope
    if is_sufficient:
        write_free_gradient(*terms, state.exact_pins, q, there)
    else:
        _relax_positions(state)
        change = change_objective(*terms, p, q)
        if not is_armijo_step(change, 1.0, slope, 0.0):
            if not _search_rounded(state, slope):
                return 0.0, cost
            length = project_displacement(p, q, d)
            _relax_positions(state)
            change = change_objective(*terms, p, q)
    now.can_reduce = is_sufficient or now.shift == np.inf
    for e in range(len(tensions)):
        tensions[e] += length * (state.predicted[e] - tensions[e])
    if is_compared:
        change = change_objective(*terms, compared, q)
    if not change < 0.0:
        now.is_trial_due = not is_compared
        return 0.0, cost
    now.is_trial_due = now.shift == 0.0 and is_sufficient and slope >= QUADRATIC_SLOPE_RATIO * before
    move_to_trial(search, p, gradient)
    return -change, cost


@jit_inner
def _find_direction(state):
    """Find the direction for the smallest shift that has a factor, as `InertiaShift` does.

    Return whether there is one, and the factorisations made.
    """
    now, failure_costs, cost = state.progress[0], state.failure_costs, 1.0
    if now.can_reduce == 1 and now.shift > 0.0:
        less = reduce_shift(now.shift, now.shift_ratio, now.max_shift)
        failed = _solve_shifted(state, less)
        now.shift_ratio = adapt_shift_ratio(now.shift, now.shift_ratio, failed < 0)
        if failed < 0:
            now.shift = less
            return True, cost
        cost += failure_costs[failed]
    failed = _solve_shifted(state, now.shift)
    while failed >= 0 and now.shift < np.inf:
        cost += failure_costs[failed]
        now.shift, now.shift_ratio = increase_shift(now.shift, now.max_shift), FIRST_SHIFT_RATIO
        failed = _solve_shifted(state, now.shift)
    if failed >= 0:
        return False, cost - 1.0 + failure_costs[failed]
    return True, cost


@jit_inner
def _solve_shifted(state, shift):
    """Write the direction; return the supernode at which the factorisation failed, or -1.

    An infinite shift drops negative transverse parts instead.
    """
    arrays, is_finite = state.arrays, shift < np.inf
    terms, places, negative_fraction = arrays.search.objective_terms, arrays.block_indices, 1.0 if is_finite else 0.0
    assemble_hessian(terms, places, arrays.constant_blocks, state.p, state.tensions, negative_fraction, arrays.values)
    if is_finite and shift > 0.0:
        for v in places.free_vertices:
            for c in range(3):
                arrays.values[places.diagonal_block[v], c, c] += shift * terms.inertia_diagonal[v]
    return solve_negative(arrays, arrays.factor.schedule, state.gradient)


@jit_inner
def _relax_positions(state):
    """Do the L-BFGS iterations, which move the trial point."""
    search, r = state.arrays.search, state.relaxation
    q, there = search.trial_positions, search.trial_gradient
    iterate_from(r.step, r.window, r.negative_pairs, r.target, r.force, r.pin_targets, r.num_iterations, q, there)
    if not r.uses_own_gradient:
        write_free_gradient(search.objective_terms, search.quadratic_form, state.step_data, state.exact_pins, q, there)


@jit_inner
def _search_rounded(state, slope):
    """Find the first of the step sizes 1, 1/2, ... at which the objective decreases enough.

    A decrease is also sufficient for the slope along the rounded displacement. Return whether there is one.
    """
    search, step_size, p, gradient = state.arrays.search, 1.0, state.p, state.gradient
    terms = search.objective_terms, search.quadratic_form, state.step_data, state.exact_pins
    q, there, d = search.trial_positions, search.trial_gradient, state.arrays.direction
    for _ in range(MAX_HALVINGS if slope < 0.0 else 0):
        change, is_sufficient = try_step(*terms, p, d, step_size, slope, 0.0, q, there)
        if not is_sufficient and change < 0.0:
            rounded_slope = compute_product_with_displacement(gradient, p, q)
            is_sufficient = rounded_slope < 0.0 and is_armijo_step(change, 1.0, rounded_slope, 0.0)
        if is_sufficient:
            return True
        step_size *= 0.5
    return False


@jit_kernel
def project_displacement(p, q, d):
    """Return the displacement from p to q along d, as a multiple of d.

    Args:
        p, q: positions (n, 3) [m].
        d: direction (n, 3) [m].
    """
    return compute_product_with_displacement(d, p, q) / compute_inner_product(d, d)
