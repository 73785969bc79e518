"""The coefficients of accelerated directions d = scale c - sum over j of (a_j s_j + b_j w_j), for each method.

See `solvers.kernels.accelerate` for the notation, and each method's own module for its source.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from solvers.compiling import inner_options, kept

# At a minimum all products may be zero. Quotients are then nan, and the resulting trial is rejected.
inner: Any = kept(**inner_options, error_model="numpy")

CHEBYSHEV, ANDERSON, LBFGS = 0, 1, 2

_CURVED = 1e-2
"""Smallest ratio of s y to w y of a pair that L-BFGS stores; for a positive Hessian s y is not below w y."""

_DEPENDENT = 1e-12
"""Fraction of its square below which the independent part of a difference is ignored by Anderson."""

_SLOWER = 0.75
"""Chebyshev's estimate is updated if the residual ratio exceeds this power of the predicted one."""

_ROUNDEST = 1.0 - 1e-7


@inner
def coefficients(window):
    """Set scale, a and b; return 1 if they give the plain correction, else 0."""
    now = window.now[0]
    for j in range(len(window.a)):
        window.a[j] = window.b[j] = 0.0
    now.scale = 1.0
    if now.method == LBFGS:
        return _lbfgs(window, now)
    if now.method == ANDERSON:
        return _anderson(window, now)
    return _chebyshev(window, now)


@inner
def _lbfgs(window, now):
    """Run the two-loop recursion over the pairs (Nocedal 1980) on inner products (Byrd, Nocedal, Schnabel 1994).

    H0 = scale Q^-1 has the curvature of the newest pair along Q^-1 y. Q itself is too stiff, with steps half as long.
    """
    a, b, m = window.a, window.b, len(window.a)
    new = now.newest
    if now.count > 0 and not window.sy[new, new] > _CURVED * window.wy[new, new]:
        now.newest = (new - 1 + m) % m
        now.count -= 1
    first = now.newest - now.count + 1 + m
    if now.count > 0:
        now.scale = window.sy[now.newest, now.newest] / window.wy[now.newest, now.newest]
    for back in range(now.count):
        i = (now.newest - back + m) % m
        total = window.sg[i]
        for later in range(back):
            j = (now.newest - later + m) % m
            total += window.sy[i, j] * b[j]
        b[i] = -total / window.sy[i, i]
    for nth in range(now.count):
        i = (first + nth) % m
        total = -now.scale * window.wg[i] - window.sy[i, i] * b[i]
        for other in range(now.count):
            j = (first + other) % m
            total -= now.scale * window.wy[i, j] * b[j]
        for before in range(nth):
            j = (first + before) % m
            total -= window.sy[j, i] * a[j]
        a[i] = total / window.sy[i, i]
    for j in range(m):
        b[j] *= now.scale
    return 1 if now.count == 0 else 0


@inner
def _anderson(window, now):
    """Set a = -b = argmin |c - W a|_Q by the normal equations; of dependent differences the newest are used."""
    a, m, L = window.a, len(window.a), window.sy
    for nth in range(now.count):
        i = (now.newest - nth + m) % m
        left = window.wy[i, i]
        total = window.wg[i]
        for other in range(nth):
            j = (now.newest - other + m) % m
            entry = window.wy[i, j]
            for before in range(other):
                k = (now.newest - before + m) % m
                entry -= L[i, k] * L[j, k]
            L[i, j] = entry / L[j, j] if L[j, j] > 0.0 else 0.0
            left -= L[i, j] ** 2
            total -= L[i, j] * a[j]
        L[i, i] = np.sqrt(left) if left > _DEPENDENT * window.wy[i, i] else 0.0
        a[i] = total / L[i, i] if L[i, i] > 0.0 else 0.0
    for nth in range(now.count - 1, -1, -1):
        i = (now.newest - nth + m) % m
        total = a[i]
        for other in range(nth + 1, now.count):
            j = (now.newest - other + m) % m
            total -= L[j, i] * a[j]
        a[i] = total / L[i, i] if L[i, i] > 0.0 else 0.0
    for j in range(m):
        window.b[j] = -a[j]
    return 1 if now.count == 0 else 0


@inner
def _chebyshev(window, now):
    """Set the coefficients of p_(k+1) - p_k = weight gamma c + (weight - 1) s."""
    if now.degree > 0 and now.reference > 0.0:
        _estimate(now)
    sigma = now.radius / (2.0 - now.radius)
    if now.degree == 0:
        now.reference = now.squared
        now.weight = 1.0
    elif now.degree == 1:
        now.weight = 2.0 / (2.0 - sigma * sigma)
    else:
        now.weight = 4.0 / (4.0 - sigma * sigma * now.weight)
    now.scale = now.weight * 2.0 / (2.0 - now.radius)
    if now.degree > 0:
        window.a[0] = 1.0 - now.weight
    now.degree += 1
    return 1 if now.scale == 1.0 and now.weight == 1.0 else 0


@inner
def _estimate(now):
    """Update the radius and restart the polynomial if the residual decreases less than predicted."""
    ratio = np.sqrt(now.squared / now.reference)
    if now.radius == 0.0:
        now.radius, now.degree = min(ratio, _ROUNDEST), 0
        return
    distance = np.arccosh((2.0 - now.radius) / now.radius)
    promised = 1.0 / np.cosh(now.degree * distance)
    if ratio > promised**_SLOWER and ratio > promised:
        wide = np.cosh(np.arccosh(max(1.0, ratio / promised)) / now.degree)
        now.radius, now.degree = min(0.5 * now.radius * (1.0 + wide), _ROUNDEST), 0


MOST_PAIRS = 100
"""Each pair costs two vectors and an inner product with all others, and old pairs are no longer representative."""


def require_pairs(pairs: int) -> None:
    """Raise ValueError for a history size outside of the limits."""
    if not 1 <= pairs <= MOST_PAIRS:
        raise ValueError(f"pairs: should be from 1 to {MOST_PAIRS}, not {pairs}")
