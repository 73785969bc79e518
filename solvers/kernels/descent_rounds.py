"""Rounds of a first-order method, ended when Newton's method is predicted to gain more.

After a segment of iterations, rounds of sweeps of another first-order method may follow, where there is one.

    q = D_k / D_(k-1),   remaining decrease = q D_k + q^2 D_k + ... = D_k q / (1 - q)
    switch if that per cost of Newton's method exceeds q D_k per round, i.e. if  1 / (1 - q) > cost of two Newton steps
    unless  q >= 1  or  log(r_k / limit) / log(r_(k-1) / r_k) <= cost of a Newton step

D_k is the decrease of the objective in the k-th group of rounds, and r_k the residual after it: no switch pays if the
rounds reach the limit of the residual within the cost of one Newton step. Growing decreases indicate that the objective
is not convex here, where Newton's method gains little. It is assumed to need two steps, one of which leads to where the
other converges. Costs are counted in groups, from the numbers of entries and operations, and not measured by a clock:
equal solves then make equal decisions. Once a Newton step has been measured, its decrease per cost replaces the
prediction.

A round ends with a check, which costs c iterations. Rounds of s iterations cost c/s per iteration, and the last one
makes s/2 iterations superfluous. With n iterations, n c/s + s/2 is minimal for s = sqrt(2 c n). Rounds have twice that
length: this costs a quarter more than the minimum, and halves the number of rounds, which limits of iterations count.
If there are sweeps and a check costs less than an iteration, a round also has at most one iteration more than a
sixteenth of those before it, so that a solve of few iterations does not end much later than it could. There are no
sweeps where springs are so stiff that residuals near the tolerance are round-off, which more checks would meet more
often.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.extending import register_jitable
from springbench.solvers.jit.kernel_compilation import jit_closure, jit_inner_options
from springbench.solvers.kernels.iteration_loop import (
    REASON_ITERATIONS,
    REASON_STALLED,
    RESIDUAL_EACH,
    RESIDUAL_LAST,
    LoopLimits,
    build_unchecked_steps,
    check_residual,
)

REASON_SWITCH = 4
"""The termination reason of rounds after which another method is predicted to gain more."""

GROUP_ITERATIONS = 10
"""Iterations of a group of rounds, whose decrease is measured."""

SEGMENT_ITERATIONS = 5
"""Iterations of a segment, after which sweeps may follow."""

PROBE_ITERATIONS = 4
"""Iterations before the suitability of the method is assessed."""

_MAX_ROUND_FRACTION = 1.0 / 16.0
"""Length of a round in addition to one iteration, as a fraction of the iterations before it; for checks that cost less
than an iteration."""

_MAX_RESIDUAL_GROWTH = 1.5
"""Largest ratio of residuals after the very first iterations at which the method is considered suitable. Stiff springs
increase residuals: with 0.5, cloth of k dt²/m up to 5e5 takes twice as long. With 2, stiffer cloth ends in a higher
minimum."""

_NEAR_ITERATIONS = 4
"""Smallest number of iterations at the end of a segment over which their decrease is averaged."""

_SWEEP_RESIDUAL_RATIO = 10.0**-0.5
"""Largest ratio of residuals at which more sweeps follow in any case: that of a tenth of the objective."""

_NEWTON_STEPS = 2.0
"""Number of Newton steps that the remaining decrease is assumed to take."""

ROUND_STATE_DTYPE = np.dtype(
    [
        ("num_iterations", np.int64),  # since the start
        ("group_end", np.int64),  # iterations at the end of the group
        ("is_unsuited", np.int64),  # whether the residual grew too much in the first iterations
        ("initial_residual", np.float64),  # [J^(1/2)]; negative: not yet known
        ("group_start", np.float64),  # decrease of the objective before the group [J]
        ("group_residual", np.float64),  # residual before the group [J^(1/2)]; 0: not known
        ("gain", np.float64),  # decrease in the last group [J]; infinite before the first
        ("gain_ratio", np.float64),  # over the decrease in the group before; 1 before the second
        ("rival_gain", np.float64),  # decrease of the other methods per cost of a group [J]; 0: not measured
        ("trial_iteration", np.float64),  # iterations from which on a prediction counts
        ("newton_cost", np.float64),  # cost of a Newton step in groups
        ("check_cost", np.float64),  # cost of the end of a round in iterations
        ("sweep_cost", np.int64),  # cost of a round of sweeps in iterations; 0: there are none
        ("is_sweeping", np.int64),  # whether the next round consists of sweeps
        ("segment_end", np.int64),  # iterations after which sweeps may follow
        ("segment_residual", np.float64),  # residual at the last choice [J^(1/2)]; 0: not known
        ("late_start", np.int64),  # iterations from which the decrease per iteration is averaged
        ("late_decrease", np.float64),  # decrease of the objective there [J]
        ("late_rate", np.float64),  # decrease per iteration at the end of the last segment [J]; infinite before that
        ("near_fraction", np.float64),  # largest decrease per iteration over that so far at which sweeps may follow
        ("earlier_decrease", np.float64),  # decrease from the initial guess to the start of these rounds [J]
        ("residual_floor", np.float64),  # residual that rounded positions leave [J^(1/2)]
    ]
)
"""The state of the rounds of a solve."""


@register_jitable(**jit_inner_options)
def round_size(now):
    """Return the number of iterations of the next round, up to the next decision."""
    left = (PROBE_ITERATIONS if now.num_iterations < PROBE_ITERATIONS else now.group_end) - now.num_iterations
    size = int(0.5 + 2.0 * np.sqrt(2.0 * now.check_cost * now.num_iterations))
    if now.sweep_cost > 0:
        left = min(left, now.segment_end - now.num_iterations)
        if now.check_cost < 1.0:
            size = min(size, 1 + int(_MAX_ROUND_FRACTION * now.num_iterations))
    return max(1, min(left, size))


@register_jitable(**jit_inner_options)
def _choose_sweeps(now, decrease, residual):
    """Decide whether the next round consists of sweeps."""
    if now.is_sweeping == 1:
        is_better = decrease - now.late_decrease > now.late_rate * now.sweep_cost
        continues = is_better or residual < _SWEEP_RESIDUAL_RATIO * now.segment_residual
    else:
        now.late_rate = (decrease - now.late_decrease) / (now.num_iterations - now.late_start)
        continues = now.late_rate <= now.near_fraction * (now.earlier_decrease + decrease)
    now.is_sweeping = 1 if continues else 0
    now.segment_end, now.segment_residual = now.num_iterations + SEGMENT_ITERATIONS, residual


@register_jitable(**jit_inner_options)
def _assess_round(now, decrease, residual, residual_limit):
    """Return REASON_SWITCH if another method is predicted to gain more, else REASON_ITERATIONS."""
    if (
        now.num_iterations == PROBE_ITERATIONS
        and now.is_sweeping == 0
        and residual > _MAX_RESIDUAL_GROWTH * now.initial_residual
    ):
        now.is_unsuited = 1
        return REASON_SWITCH
    if now.num_iterations < now.group_end:
        return REASON_ITERATIONS
    before, gain, last_residual = now.gain, decrease - now.group_start, now.group_residual
    now.gain, now.group_start, now.group_residual = gain, decrease, residual
    now.group_end = now.num_iterations + GROUP_ITERATIONS
    now.gain_ratio = gain / before if 0.0 < before < np.inf else 1.0
    if 0.0 < residual_limit < residual < last_residual:
        left = np.log(residual / residual_limit) / np.log(last_residual / residual)  # groups
        if left <= now.newton_cost:
            return REASON_ITERATIONS
    if gain <= 0.0 or gain < now.rival_gain:
        return REASON_SWITCH
    if now.num_iterations < now.trial_iteration or gain >= before:
        return REASON_ITERATIONS
    return REASON_SWITCH if _NEWTON_STEPS * now.newton_cost * (before - gain) < before else REASON_ITERATIONS


def build_rounds(
    run_unchecked: Callable[..., Any],
    residual: Callable[..., Any],
    decrease: Callable[..., Any],
    sweep: Callable[..., Any],
) -> Callable[..., Any]:
    """Build the loop over rounds of a state.

    Args:
        run_unchecked: function of the state and a number of iterations that does them and returns how many succeeded.
        residual: function of the state and a residual r that returns the residual [J^(1/2)]; above r it may be an
            estimate.
        decrease: function of the state that returns the decrease of the objective since the start [J].
        sweep: function of the state that does a round of sweeps.

    Returns:
        A function (state, rounds, limits), `rounds` of `ROUND_STATE_DTYPE` (1,) and limits in rounds. It returns the
        number of rounds, the last residual and the termination reason. Without a limit of the residual, it is computed
        only where a decision needs it, after the last round if the mode is RESIDUAL_LAST, and by a call for no rounds;
        else it is nan. The floor of the limits and that of the rounds end the loop.
    """

    def iterate(state: Any, rounds: Any, limits: Any) -> Any:
        now, count, found, ended = rounds[0], 0, np.nan, REASON_ITERATIONS
        if limits.max_iterations == 0:
            return 0, residual(state, np.inf), REASON_ITERATIONS
        floor = max(limits.residual_floor, now.residual_floor)
        needs_last = limits.residual_mode == RESIDUAL_LAST
        residual_limit = limits.residual_limit if limits.residual_mode == RESIDUAL_EACH else 0.0
        limits = LoopLimits(limits.max_iterations, residual_limit, floor, RESIDUAL_EACH)
        exact_below = 2.0 * max(limits.residual_limit, floor)
        if now.initial_residual < 0.0:
            now.initial_residual = now.group_residual = now.segment_residual = residual(state, exact_below)
        while ended == REASON_ITERATIONS and count < limits.max_iterations:
            count += 1
            size = now.sweep_cost if now.is_sweeping == 1 else round_size(now)
            is_done = True
            if now.is_sweeping == 1:
                sweep(state)
            else:
                is_done = run_unchecked(state, size) == size
            now.num_iterations += size
            total = decrease(state)
            ends_segment = now.sweep_cost > 0 and (now.is_sweeping == 1 or now.num_iterations >= now.segment_end)
            is_assessed = now.num_iterations == PROBE_ITERATIONS or now.num_iterations >= now.group_end
            is_last, found = needs_last and count == limits.max_iterations, np.nan
            if limits.residual_limit > 0.0 or ends_segment or is_assessed or is_last or not is_done:
                found = residual(state, np.inf if is_last else exact_below)
                ended = check_residual(found, limits)
            if ends_segment:
                _choose_sweeps(now, total, found)
            if ends_segment or now.num_iterations <= now.segment_end - _NEAR_ITERATIONS:
                now.late_start, now.late_decrease = now.num_iterations, total
            if ended == REASON_ITERATIONS:
                ended = _assess_round(now, total, found, limits.residual_limit) if is_done else REASON_STALLED
        return count, found, ended

    return iterate


def build_compiled_rounds(
    step_state: Callable[..., Any],
    residual: Callable[..., Any],
    decrease: Callable[..., Any],
    sweep: Callable[..., Any],
) -> Any:
    """Build the loop over rounds for kernels, from inner functions of the state.

    Args:
        step_state: does an iteration and returns whether it succeeded.
        residual: returns the residual [J^(1/2)]; it takes a second argument, as in `build_rounds`.
        decrease: returns the decrease of the objective since the start [J].
        sweep: does a round of sweeps.

    Returns:
        The function of `build_rounds`, compiled.
    """

    return jit_closure(build_rounds(build_unchecked_steps(step_state), residual, decrease, sweep))


def init_rounds(
    newton_cost: float,
    check_cost: float,
    sweep_cost: int = 0,
    near_fraction: float = 0.0,
    *,
    starts_sweeping: bool = False,
) -> Any:
    """Return the state of rounds at their start, (1,).

    Args:
        newton_cost: cost of a Newton step, in groups.
        check_cost: cost of the end of a round, in iterations.
        sweep_cost: cost of a round of sweeps, in iterations; 0 for no sweeps.
        near_fraction: largest decrease of the objective per iteration, as a fraction of that since the start, at which
            sweeps may follow.
        starts_sweeping: whether the first round consists of sweeps.
    """
    initial = np.zeros(1, ROUND_STATE_DTYPE)
    initial["group_end"], initial["segment_end"] = GROUP_ITERATIONS, SEGMENT_ITERATIONS
    initial["initial_residual"], initial["gain"], initial["gain_ratio"] = -1.0, np.inf, 1.0
    initial["late_rate"] = np.inf
    initial["newton_cost"], initial["check_cost"] = newton_cost, check_cost
    initial["sweep_cost"], initial["near_fraction"], initial["is_sweeping"] = sweep_cost, near_fraction, starts_sweeping
    return initial


def restart_rounds(rounds: Any, earlier_decrease: float) -> None:
    """Begin a group and a segment of a method that starts again, after another one.

    Args:
        rounds: state of the rounds (1,), updated.
        earlier_decrease: decrease of the objective from the initial guess to the new start [J].
    """
    count = rounds["num_iterations"]
    rounds["group_end"], rounds["segment_end"] = count + GROUP_ITERATIONS, count + SEGMENT_ITERATIONS
    rounds["group_start"], rounds["gain"], rounds["gain_ratio"], rounds["group_residual"] = 0.0, np.inf, 1.0, 0.0
    rounds["is_sweeping"], rounds["earlier_decrease"] = 0, earlier_decrease
    rounds["late_start"], rounds["late_decrease"] = count, 0.0
