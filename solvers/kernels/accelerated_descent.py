"""Accelerated descent: a direction from the last correction and previous differences, and its acceptance.

    c_k = -Q^-1 grad g(p_k) = LG(p_k) - p_k                       the plain correction, a local-global iteration
    d   = scale c_k - sum over j of (a_j s_j + b_j w_j)           the accelerated direction
    s_j = p_(j+1) - p_j,   y_j = grad g(p_(j+1)) - grad g(p_j),   w_j = Q^-1 y_j = c_j - c_(j+1)

A method is defined by its coefficients (`acceleration_coefficients`), which it computes from inner products of the
window's vectors. An iteration tries p + d, then shorter steps, then the plain correction with decreasing lengths, until
one descends enough (`springbench.solvers.kernels.line_search_conditions`). For projective energies Q majorises the
Hessian, so that the plain correction is accepted at full length. Vectors are flat and independent of the meaning of
their entries; entries of vertices that do not move are zero.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.acceleration_coefficients import compute_coefficients
from springbench.solvers.kernels.line_search_conditions import is_approximate_wolfe_step, is_armijo_step
from springbench.solvers.simd.dot_products import ordered_dot, ordered_dot_pair

_WOLFE_FRACTION = 0.1
TRIAL_AGAIN, TRIAL_ACCEPTED, TRIAL_STALLED = 0, 1, 2
"""The result of `assess_trial`: evaluate the next trial, accept it, or stop because round-off prevents descent."""

CACHE_BLOCK = 512
"""Entries per block, so that the data of all pairs stay in the first-level cache."""

_MAX_HALVINGS = 40

WINDOW_STATE_DTYPE = np.dtype(
    [
        ("coefficient_rule", np.int64),  # of `acceleration_coefficients`
        ("max_retries", np.int64),  # shorter steps along d before the plain correction
        ("num_pairs", np.int64),  # pairs in the window
        ("newest_pair", np.int64),  # index of the latest one
        ("num_rejected_trials", np.int64),  # trials rejected in this iteration
        ("is_plain", np.int64),  # whether the trial is along c
        ("objective_change", np.float64),  # g(trial) - g(p) [J]
        ("roundoff", np.float64),  # bound of the round-off of this change [J]
        ("objective_decrease", np.float64),  # decrease of g since the start, without changes below round-off [J]
        ("step_size", np.float64),  # t
        ("slope", np.float64),  # grad g(p) d [J]
        ("correction_squarednorm", np.float64),  # |c|_Q^2 [J]
        ("correction_scale", np.float64),  # factor of c in d
        ("spectral_radius", np.float64),  # estimated convergence factor of the plain iteration, for Chebyshev
        ("chebyshev_weight", np.float64),  # omega
        ("polynomial_degree", np.int64),  # degree of the Chebyshev polynomial
        ("reference_squarednorm", np.float64),  # |c|_Q^2 at the start of this polynomial [J]
    ]
)
"""The state of an iteration."""


class AccelerationWindow(NamedTuple):
    """The state of a solve with m history pairs and N entries per vector.

    Attributes:
        step_history, image_history: s and w (m N,).
        position, trial_position: p and p + t d, N entries and possibly more that do not move.
        descent, trial_descent: -grad g at p and at the trial.
        correction, direction: c and d (N,).
        block_scratch: scratch.
        sy, wy: s_i y_j for i not younger than j, and w_i y_j (m, m).
        sg, wg: s_i grad g(p) and w_i grad g(p) (m,).
        a, b: coefficients (m,).
        window_state: scalars of the iteration.

    The arrays s, w, c and d have the precision of the factor.
    """

    step_history: NDArray[Any]
    image_history: NDArray[Any]
    position: NDArray[np.float64]
    trial_position: NDArray[np.float64]
    descent: NDArray[np.float64]
    trial_descent: NDArray[np.float64]
    correction: NDArray[Any]
    direction: NDArray[Any]
    block_scratch: NDArray[np.float64]
    sy: NDArray[np.float64]
    wy: NDArray[np.float64]
    sg: NDArray[np.float64]
    wg: NDArray[np.float64]
    a: NDArray[np.float64]
    b: NDArray[np.float64]
    window_state: NDArray[Any]


@jit_kernel
def init_window(window, correction):
    """Initialise the window at the trial point, without a history.

    Args:
        window: state of the solve; its trial position and descent are known.
        correction: plain correction c at the trial point, at least N entries.
    """
    now = window.window_state[0]
    now.num_pairs, now.newest_pair, now.spectral_radius, now.polynomial_degree = 0, -1, 0.0, 0
    size = len(window.correction)
    for k in range(len(window.position)):
        window.position[k] = window.trial_position[k]
    for k in range(size):
        window.descent[k], window.correction[k] = window.trial_descent[k], correction[k]
    now.correction_squarednorm = ordered_dot(window.descent, window.correction, size)


@jit_kernel
def propose_trial(window):
    """Propose the first trial of an iteration."""
    now = window.window_state[0]
    now.is_plain, now.num_rejected_trials = compute_coefficients(window), 0
    _combine_history(window)


@jit_kernel
def shorten_trial(window, fraction):
    """Shorten the trial to a fraction of its length.

    Args:
        window: state of the solve; its step size and trial position are updated.
        fraction: ratio of the new step size to the present one.
    """
    _set_trial(window, fraction * window.window_state[0].step_size)


@jit_kernel
def assess_trial(window):
    """Accept, replace or reject a trial whose change, round-off and gradient are known.

    Returns:
        TRIAL_ACCEPTED, TRIAL_AGAIN for the next trial, or TRIAL_STALLED.
    """
    now = window.window_state[0]
    even = abs(now.objective_change) <= now.roundoff < np.inf
    if even:
        there = -ordered_dot(window.direction, window.trial_descent, len(window.direction))
        enough = now.slope <= 0.0 and is_approximate_wolfe_step(there, now.slope, _WOLFE_FRACTION)
        excess = 0.5 * now.step_size * (there - now.slope)
    else:
        enough = is_armijo_step(now.objective_change, now.step_size, min(0.0, now.slope), 0.0)
        excess = now.objective_change - now.step_size * now.slope
    if enough:
        now.objective_decrease -= 0.0 if even else now.objective_change
        return TRIAL_ACCEPTED
    now.num_rejected_trials += 1
    if now.is_plain and (even or now.num_rejected_trials > _MAX_HALVINGS):
        return TRIAL_STALLED
    if now.is_plain or (now.num_rejected_trials <= now.max_retries and now.slope < 0.0):
        # Minimum of the interpolating parabola, safeguarded against too short or too long steps.
        least = -0.5 * now.slope * now.step_size / excess if excess > 0.0 else 0.5
        _set_trial(window, now.step_size * min(max(least, 0.1), 0.5))
        return TRIAL_AGAIN
    now.is_plain, now.num_pairs, now.polynomial_degree, now.num_rejected_trials = (
        1,
        now.num_pairs if now.max_retries == 0 else 0,
        0,
        0,
    )
    for k in range(len(window.direction)):
        window.direction[k] = window.correction[k]
    now.slope = -now.correction_squarednorm
    _set_trial(window, 1.0)
    return TRIAL_AGAIN


@jit_kernel
def accept_trial(window, correction):
    """Accept the trial point, and add the pair of this step to the history.

    Args:
        window: state of the solve; the oldest pair is replaced if the history is full.
        correction: plain correction c at the trial point, at least N entries.
    """
    now, m = window.window_state[0], len(window.a)
    new = (now.newest_pair + 1) % m
    now.num_pairs = min(now.num_pairs + 1, m)
    for j in range(m):
        # The product with a gradient difference is the difference of the products with the gradients.
        window.sy[j, new], window.wy[j, new] = -window.sg[j], -window.wg[j]
        window.sg[j] = window.wg[j] = 0.0
    window.sy[new, new] = window.wy[new, new] = 0.0
    now.correction_squarednorm = 0.0
    size = len(window.direction)
    for begin in range(0, size, CACHE_BLOCK):
        end = min(size, begin + CACHE_BLOCK)
        step = window.step_history[new * size + begin : new * size + end]
        image = window.image_history[new * size + begin : new * size + end]
        y = window.block_scratch[: end - begin]
        _replace_difference(window.trial_position[begin:end], window.position[begin:end], step, 1.0)
        _replace_difference(correction[begin:end], window.correction[begin:end], image, -1.0)
        _replace_difference(window.trial_descent[begin:end], window.descent[begin:end], y, -1.0)
        now.correction_squarednorm += ordered_dot(window.descent[begin:end], window.correction[begin:end], end - begin)
        sy, wy = ordered_dot_pair(step, image, y, end - begin)
        window.sy[new, new] += sy
        window.wy[new, new] += wy
        for back in range(now.num_pairs):
            j = (new - back + m) % m
            sg, wg = ordered_dot_pair(
                window.step_history[j * size + begin : j * size + end],
                window.image_history[j * size + begin : j * size + end],
                window.descent[begin:end],
                end - begin,
            )
            window.sg[j] -= sg
            window.wg[j] -= wg
    for j in range(m):
        if j != new:
            window.sy[j, new] += window.sg[j]
            window.wy[j, new] += window.wg[j]
        window.wy[new, j] = window.wy[j, new]
    now.newest_pair = new


@jit_inner
def _set_trial(window, length):
    window.window_state[0].step_size = length
    size = len(window.direction)
    _move_along(window.position[:size], length, window.direction, window.trial_position[:size])


@jit_inner
def _move_along(position, length, direction, trial):
    for k in range(len(trial)):
        trial[k] = position[k] + length * direction[k]


@jit_inner
def _combine_history(window):
    """Compute the direction from the coefficients, its slope, and a trial at full length."""
    now, size, m = window.window_state[0], len(window.direction), len(window.a)
    slope = 0.0
    for begin in range(0, size, CACHE_BLOCK):
        end = min(size, begin + CACHE_BLOCK)
        direction = window.block_scratch[: end - begin]
        _set_scaled(direction, now.correction_scale, window.correction[begin:end])
        for back in range(now.num_pairs):
            j = (now.newest_pair - back + m) % m
            _subtract_pair(
                direction,
                window.a[j],
                window.step_history[j * size + begin : j * size + end],
                window.b[j],
                window.image_history[j * size + begin : j * size + end],
            )
        _set_scaled(window.direction[begin:end], 1.0, direction)
        slope -= ordered_dot(window.direction[begin:end], window.descent[begin:end], end - begin)
        _move_along(window.position[begin:end], 1.0, window.direction[begin:end], window.trial_position[begin:end])
    now.slope, now.step_size = slope, 1.0


@jit_inner
def _replace_difference(new, old, change, sign):
    """Replace old entries by new ones, and write the change times `sign`."""
    for k in range(len(new)):
        change[k] = sign * (new[k] - old[k])
        old[k] = new[k]


@jit_inner
def _set_scaled(out, scale, c):
    for k in range(len(out)):
        out[k] = scale * c[k]


@jit_inner
def _subtract_pair(out, a, s, b, w):
    for k in range(len(out)):
        out[k] -= a * s[k] + b * w[k]
