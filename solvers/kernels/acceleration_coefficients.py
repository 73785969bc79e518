"""Coefficients of accelerated directions d = scale c - sum over j of (a_j s_j + b_j w_j), by method.

The notation is that of `springbench.solvers.kernels.accelerated_descent`; each method's own module cites its source.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from springbench.solvers.jit.kernel_compilation import cached_njit, jit_inner_options

# At a minimum all products may be zero. Quotients are then nan, and the resulting trial is rejected.
jit_inner_numpy: Any = cached_njit(**jit_inner_options, error_model="numpy")

CHEBYSHEV_RULE, ANDERSON_RULE, LBFGS_RULE = 0, 1, 2

_MIN_CURVATURE_RATIO = 1e-2
"""Smallest ratio of s y to w y of a pair that L-BFGS stores; for a positive Hessian s y is not below w y."""

_DEPENDENCE_TOLERANCE = 1e-12
"""Anderson's method ignores the independent part of a difference below this fraction of its square."""

_RESTART_EXPONENT = 0.75
"""Chebyshev's estimate is updated if the residual ratio exceeds this power of the predicted one."""

_MAX_SPECTRAL_RADIUS = 1.0 - 1e-7


@jit_inner_numpy
def compute_coefficients(window):
    """Set scale, a and b; return 1 if they give the plain correction, else 0."""
    now = window.window_state[0]
    for j in range(len(window.a)):
        window.a[j] = window.b[j] = 0.0
    now.correction_scale = 1.0
    if now.coefficient_rule == LBFGS_RULE:
        return _lbfgs_coefficients(window, now)
    if now.coefficient_rule == ANDERSON_RULE:
        return _anderson_coefficients(window, now)
    return _chebyshev_coefficients(window, now)


@jit_inner_numpy
def _lbfgs_coefficients(window, now):
    """Run the two-loop recursion (Nocedal 1980) on inner products (Byrd, Nocedal, Schnabel 1994).

    H0 = scale Q^-1 has the curvature of the newest pair along Q^-1 y. Q itself is too stiff, with steps half as long.
    """
    a, b, m = window.a, window.b, len(window.a)
    new = now.newest_pair
    if now.num_pairs > 0 and not window.sy[new, new] > _MIN_CURVATURE_RATIO * window.wy[new, new]:
        now.newest_pair = (new - 1 + m) % m
        now.num_pairs -= 1
    first = now.newest_pair - now.num_pairs + 1 + m
    if now.num_pairs > 0:
        now.correction_scale = window.sy[now.newest_pair, now.newest_pair] / window.wy[now.newest_pair, now.newest_pair]
    for back in range(now.num_pairs):
        i = (now.newest_pair - back + m) % m
        total = window.sg[i]
        for later in range(back):
            j = (now.newest_pair - later + m) % m
            total += window.sy[i, j] * b[j]
        b[i] = -total / window.sy[i, i]
    for nth in range(now.num_pairs):
        i = (first + nth) % m
        total = -now.correction_scale * window.wg[i] - window.sy[i, i] * b[i]
        for other in range(now.num_pairs):
            j = (first + other) % m
            total -= now.correction_scale * window.wy[i, j] * b[j]
        for before in range(nth):
            j = (first + before) % m
            total -= window.sy[j, i] * a[j]
        a[i] = total / window.sy[i, i]
    for j in range(m):
        b[j] *= now.correction_scale
    return 1 if now.num_pairs == 0 else 0


@jit_inner_numpy
def _anderson_coefficients(window, now):
    """Set a = -b = argmin |c - W a|_Q by the normal equations.

    Of dependent differences the newest ones are used.
    """
    a, m, L = window.a, len(window.a), window.sy
    for nth in range(now.num_pairs):
        i = (now.newest_pair - nth + m) % m
        left = window.wy[i, i]
        total = window.wg[i]
        for other in range(nth):
            j = (now.newest_pair - other + m) % m
            entry = window.wy[i, j]
            for before in range(other):
                k = (now.newest_pair - before + m) % m
                entry -= L[i, k] * L[j, k]
            L[i, j] = entry / L[j, j] if L[j, j] > 0.0 else 0.0
            left -= L[i, j] ** 2
            total -= L[i, j] * a[j]
        L[i, i] = np.sqrt(left) if left > _DEPENDENCE_TOLERANCE * window.wy[i, i] else 0.0
        a[i] = total / L[i, i] if L[i, i] > 0.0 else 0.0
    for nth in range(now.num_pairs - 1, -1, -1):
        i = (now.newest_pair - nth + m) % m
        total = a[i]
        for other in range(nth + 1, now.num_pairs):
            j = (now.newest_pair - other + m) % m
            total -= L[j, i] * a[j]
        a[i] = total / L[i, i] if L[i, i] > 0.0 else 0.0
    for j in range(m):
        window.b[j] = -a[j]
    return 1 if now.num_pairs == 0 else 0


@jit_inner_numpy
def _chebyshev_coefficients(window, now):
    """Set the coefficients of p_(k+1) - p_k = weight gamma c + (weight - 1) s."""
    if now.polynomial_degree > 0 and now.reference_squarednorm > 0.0:
        _estimate_radius(now)
    sigma = now.spectral_radius / (2.0 - now.spectral_radius)
    if now.polynomial_degree == 0:
        now.reference_squarednorm = now.correction_squarednorm
        now.chebyshev_weight = 1.0
    elif now.polynomial_degree == 1:
        now.chebyshev_weight = 2.0 / (2.0 - sigma * sigma)
    else:
        now.chebyshev_weight = 4.0 / (4.0 - sigma * sigma * now.chebyshev_weight)
    now.correction_scale = now.chebyshev_weight * 2.0 / (2.0 - now.spectral_radius)
    if now.polynomial_degree > 0:
        window.a[0] = 1.0 - now.chebyshev_weight
    now.polynomial_degree += 1
    return 1 if now.correction_scale == 1.0 and now.chebyshev_weight == 1.0 else 0


@jit_inner_numpy
def _estimate_radius(now):
    """Update the radius and restart the polynomial if the residual decreases less than predicted."""
    ratio = np.sqrt(now.correction_squarednorm / now.reference_squarednorm)
    if now.spectral_radius == 0.0:
        now.spectral_radius, now.polynomial_degree = min(ratio, _MAX_SPECTRAL_RADIUS), 0
        return
    distance = np.arccosh((2.0 - now.spectral_radius) / now.spectral_radius)
    predicted = 1.0 / np.cosh(now.polynomial_degree * distance)
    if ratio > predicted**_RESTART_EXPONENT and ratio > predicted:
        wide = np.cosh(np.arccosh(max(1.0, ratio / predicted)) / now.polynomial_degree)
        now.spectral_radius, now.polynomial_degree = (
            min(0.5 * now.spectral_radius * (1.0 + wide), _MAX_SPECTRAL_RADIUS),
            0,
        )


MAX_HISTORY_SIZE = 100
"""Largest size: each pair costs two vectors and inner products with all others, and old pairs represent g badly."""


def require_history_size(pairs: int) -> None:
    """Raise ValueError for a history size outside of the limits."""
    if not 1 <= pairs <= MAX_HISTORY_SIZE:
        raise ValueError(f"history_size: should be from 1 to {MAX_HISTORY_SIZE}, not {pairs}")
