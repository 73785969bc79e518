"""Accelerated descent: a direction from the last correction and previous differences, and its acceptance.

    c_k = -Q^-1 grad g(p_k) = LG(p_k) - p_k                       the plain correction, a local-global iteration
    d   = scale c_k - sum over j of (a_j s_j + b_j w_j)           the accelerated direction
    s_j = p_(j+1) - p_j,   y_j = grad g(p_(j+1)) - grad g(p_j),   w_j = Q^-1 y_j = c_j - c_(j+1)

A method is defined by its coefficients (see `acceleration_coefficients`), which it computes from inner products of the
window's vectors. An iteration tries p + d, then shorter steps, then the plain correction with decreasing lengths, until
one descends enough (`solvers.kernels.line_search`). For projective energies Q majorises the Hessian, so that
the plain correction is accepted at full length. Vectors are flat and independent of the meaning of their entries;
entries of vertices that do not move are zero.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.kernels.accelerate_coefficients import coefficients
from solvers.kernels.line_search import falls, flattens
from solvers.vectors.dots import dot, dots

_FLATTER = 0.1
AGAIN, ACCEPTED, STALLED = 0, 1, 2
"""The result of `judge`: evaluate the next trial, accept it, or stop because round-off prevents descent."""

BLOCK = 512
"""Entries per block, so that the data of all pairs stay in the first-level cache."""

_HALVINGS = 40

NOW = np.dtype(
    [
        ("method", np.int64),  # see `accelerate_coefficients`
        ("retries", np.int64),  # shorter steps along d before the plain correction
        ("count", np.int64),  # pairs in the window
        ("newest", np.int64),  # the latest of them
        ("tries", np.int64),  # trials rejected in this iteration
        ("plain", np.int64),  # whether the trial is along c
        ("rise", np.float64),  # g(trial) - g(p) [J]
        ("noise", np.float64),  # what of it may be round-off
        ("fallen", np.float64),  # by how much g fell since the start, where round-off does not hide it [J]
        ("length", np.float64),  # t
        ("slope", np.float64),  # grad g(p) d [J]
        ("squared", np.float64),  # |c|_Q^2 [J]
        ("scale", np.float64),
        ("radius", np.float64),  # Chebyshev's: of convergence of the plain iteration
        ("weight", np.float64),  # omega
        ("degree", np.int64),  # of the polynomial
        ("reference", np.float64),  # |c|_Q^2 where it began [J]
    ]
)
"""The state of an iteration."""


class Window(NamedTuple):
    """The state of a solve with m pairs in the history and N entries per vector.

    Attributes:
        steps, images: s and w (m N,).
        position, trial: p and p + t d, N entries and possibly more that do not move.
        descent, descent_there: -grad g at p and at the trial.
        correction, direction: c and d (N,).
        block: scratch.
        sy, wy: s_i y_j for i not younger than j, and w_i y_j (m, m).
        sg, wg: s_i grad g(p) and w_i grad g(p) (m,).
        a, b: coefficients (m,).
        now: scalars of the iteration.

    The arrays s, w, c and d have the precision of the factor.
    """

    steps: NDArray[Any]
    images: NDArray[Any]
    position: NDArray[np.float64]
    trial: NDArray[np.float64]
    descent: NDArray[np.float64]
    descent_there: NDArray[np.float64]
    correction: NDArray[Any]
    direction: NDArray[Any]
    block: NDArray[np.float64]
    sy: NDArray[np.float64]
    wy: NDArray[np.float64]
    sg: NDArray[np.float64]
    wg: NDArray[np.float64]
    a: NDArray[np.float64]
    b: NDArray[np.float64]
    now: NDArray[Any]


@kernel
def begin(window, correction):
    """Initialise the window at the trial point, whose descent direction and correction are known."""
    now = window.now[0]
    now.count, now.newest, now.radius, now.degree = 0, -1, 0.0, 0
    size = len(window.correction)
    for k in range(len(window.position)):
        window.position[k] = window.trial[k]
    for k in range(size):
        window.descent[k], window.correction[k] = window.descent_there[k], correction[k]
    now.squared = dot(window.descent, window.correction, size)


@kernel
def propose(window):
    """Propose the first trial of an iteration."""
    now = window.now[0]
    now.plain, now.tries = coefficients(window), 0
    _combine(window)


@kernel
def shorten(window, part):
    """Shorten the trial to a fraction of its length."""
    _try(window, part * window.now[0].length)


@kernel
def judge(window):
    """Decide about a trial whose change, noise and gradient are known."""
    now = window.now[0]
    even = abs(now.rise) <= now.noise < np.inf
    if even:
        there = -dot(window.direction, window.descent_there, len(window.direction))
        enough = now.slope <= 0.0 and flattens(there, now.slope, _FLATTER)
        excess = 0.5 * now.length * (there - now.slope)
    else:
        enough = falls(now.rise, now.length, min(0.0, now.slope), 0.0)
        excess = now.rise - now.length * now.slope
    if enough:
        now.fallen -= 0.0 if even else now.rise
        return ACCEPTED
    now.tries += 1
    if now.plain and (even or now.tries > _HALVINGS):
        return STALLED
    if now.plain or (now.tries <= now.retries and now.slope < 0.0):
        # Minimum of the interpolating parabola, safeguarded against too short or too long steps.
        least = -0.5 * now.slope * now.length / excess if excess > 0.0 else 0.5
        _try(window, now.length * min(max(least, 0.1), 0.5))
        return AGAIN
    now.plain, now.count, now.degree, now.tries = 1, now.count if now.retries == 0 else 0, 0, 0
    for k in range(len(window.direction)):
        window.direction[k] = window.correction[k]
    now.slope = -now.squared
    _try(window, 1.0)
    return AGAIN


@kernel
def accept(window, correction):
    """Accept the trial point, where `correction` is the plain one, and add the pair of this step to the history."""
    now, m = window.now[0], len(window.a)
    new = (now.newest + 1) % m
    now.count = min(now.count + 1, m)
    for j in range(m):
        # The product with a gradient difference is the difference of the products with the gradients.
        window.sy[j, new], window.wy[j, new] = -window.sg[j], -window.wg[j]
        window.sg[j] = window.wg[j] = 0.0
    window.sy[new, new] = window.wy[new, new] = 0.0
    now.squared = 0.0
    size = len(window.direction)
    for begin in range(0, size, BLOCK):
        end = min(size, begin + BLOCK)
        step = window.steps[new * size + begin : new * size + end]
        image = window.images[new * size + begin : new * size + end]
        y = window.block[: end - begin]
        _replace(window.trial[begin:end], window.position[begin:end], step, 1.0)
        _replace(correction[begin:end], window.correction[begin:end], image, -1.0)
        _replace(window.descent_there[begin:end], window.descent[begin:end], y, -1.0)
        now.squared += dot(window.descent[begin:end], window.correction[begin:end], end - begin)
        sy, wy = dots(step, image, y, end - begin)
        window.sy[new, new] += sy
        window.wy[new, new] += wy
        for back in range(now.count):
            j = (new - back + m) % m
            sg, wg = dots(
                window.steps[j * size + begin : j * size + end],
                window.images[j * size + begin : j * size + end],
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
    now.newest = new


@inner
def _try(window, length):
    window.now[0].length = length
    size = len(window.direction)
    _go(window.position[:size], length, window.direction, window.trial[:size])


@inner
def _go(position, length, direction, trial):
    for k in range(len(trial)):
        trial[k] = position[k] + length * direction[k]


@inner
def _combine(window):
    """Compute the direction from the coefficients, its slope, and a trial at full length."""
    now, size, m = window.now[0], len(window.direction), len(window.a)
    slope = 0.0
    for begin in range(0, size, BLOCK):
        end = min(size, begin + BLOCK)
        direction = window.block[: end - begin]
        _set(direction, now.scale, window.correction[begin:end])
        for back in range(now.count):
            j = (now.newest - back + m) % m
            _subtract(
                direction,
                window.a[j],
                window.steps[j * size + begin : j * size + end],
                window.b[j],
                window.images[j * size + begin : j * size + end],
            )
        _set(window.direction[begin:end], 1.0, direction)
        slope -= dot(window.direction[begin:end], window.descent[begin:end], end - begin)
        _go(window.position[begin:end], 1.0, window.direction[begin:end], window.trial[begin:end])
    now.slope, now.length = slope, 1.0


@inner
def _replace(new, old, change, sign):
    """Replace old entries by new ones, and write the change times `sign`."""
    for k in range(len(new)):
        change[k] = sign * (new[k] - old[k])
        old[k] = new[k]


@inner
def _set(out, scale, c):
    for k in range(len(out)):
        out[k] = scale * c[k]


@inner
def _subtract(out, a, s, b, w):
    for k in range(len(out)):
        out[k] -= a * s[k] + b * w[k]
