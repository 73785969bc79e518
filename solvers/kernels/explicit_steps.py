"""Explicit integration of a frame, compiled: compositions of kicks and drifts, and Runge-Kutta methods that keep to an
error by their step.

    p' = v,    v' = M^-1 (f - grad E(p)) - c v

All positions, velocities and accelerations are in rows of four; `Forces` has what does not change in a frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.kernels.springs import Bundles, add_descent
from solvers.problem import Positions

FEWEST, LARGEST, CAUTION = 0.2, 5.0, 0.9
"""What a step may shrink and grow by at once, and the part taken of what the error allows."""

FLOOR = 1e-10
"""Of a frame: a shorter step is given up."""

Array = NDArray[np.float64]


class Forces(NamedTuple):
    """bundles: of the springs at unpinned vertices; right: the constant force [N], as `Bundles.right` has it; a
    quadratic form as `solvers.kernels.forms.Form` has it: pairs (k, 2), weight (k,), held (n,), or empty; inverse:
    1/m (n,) [1/kg], 0 for the pinned; drag: c (n,) [1/s]; pins (q,): vertices that move evenly from `begin` to `end`,
    (q, 3) [m]."""

    bundles: Bundles
    right: Array
    pairs: NDArray[np.int64]
    weight: Array
    held: Array
    inverse: Array
    drag: Array
    pins: NDArray[np.int64]
    begin: Positions
    end: Positions


@inner
def pull(forces, p, out):
    """Write M^-1 of all forces but drag [m/s^2] at p to `out`."""
    for k in range(len(out)):
        out[k] = 0.0
    add_descent(forces.bundles, 0, len(forces.bundles.start) - 1, p, forces.right, out, 0)
    for i in range(len(forces.held)):
        for k in range(4 * i, 4 * i + 3):
            out[k] -= forces.held[i] * p[k]
    for e in range(len(forces.weight)):
        i, j, w = 4 * forces.pairs[e, 0], 4 * forces.pairs[e, 1], forces.weight[e]
        for c in range(3):
            f = w * (p[i + c] - p[j + c])
            out[i + c] -= f
            out[j + c] += f
    for i in range(len(forces.inverse)):
        for k in range(4 * i, 4 * i + 3):
            out[k] *= forces.inverse[i]


@inner
def carry(forces, part, p):
    """Put the pins where they are after this part of the frame."""
    for q in range(len(forces.pins)):
        for c in range(3):
            p[4 * forces.pins[q] + c] = forces.end[q, c] + (1.0 - part) * (forces.begin[q, c] - forces.end[q, c])


@kernel
def compose(forces, drifts, kept, gained, count, h, p, v, acceleration):
    """`count` steps of h [s]: drift 0, kick 0, drift 1, ..., the last drift, of p and v, which take the result.

    drifts (k + 1,): parts of h; kept and gained (k, n): what is left of a velocity by a kick, and what it gains of the
    acceleration [s], both exact for drag; acceleration: scratch.
    """
    known = False
    for step in range(count):
        gone = 0.0
        for k in range(len(drifts)):
            if drifts[k] != 0.0:
                gone += drifts[k]
                for i in range(len(p)):
                    p[i] += drifts[k] * h * v[i]
                carry(forces, (step + gone) / count, p)
                known = False
            if k < len(kept):
                if not known:
                    pull(forces, p, acceleration)
                    known = True
                for i in range(len(forces.inverse)):
                    for c in range(4 * i, 4 * i + 3):
                        v[c] = kept[k, i] * v[c] + gained[k, i] * acceleration[c]


@inner
def _stage(forces, a, s, h, p, v, speeds, pulls, q, w):
    """Write the motion of stage s to q and w."""
    for i in range(len(p)):
        q[i], w[i] = p[i], v[i]
    for j in range(s):
        if a[j] != 0.0:
            for i in range(len(p)):
                q[i] += h * a[j] * speeds[j, i]
                w[i] += h * a[j] * pulls[j, i]


@inner
def _evaluate(forces, s, q, w, speeds, pulls):
    pull(forces, q, pulls[s])
    for i in range(len(forces.inverse)):
        for c in range(4 * i, 4 * i + 3):
            pulls[s, c] -= forces.drag[i] * w[c]
    for i in range(len(q)):
        speeds[s, i] = w[i]


@inner
def _size(forces, weights, span, speeds, pulls):
    """The sum of squares of an error by its weights: of positions, and of velocities by what they move in `span`."""
    total = 0.0
    for i in range(len(forces.inverse)):
        if forces.inverse[i] != 0.0:
            for c in range(4 * i, 4 * i + 3):
                x = y = 0.0
                for j in range(len(weights)):
                    x += weights[j] * speeds[j, c]
                    y += weights[j] * pulls[j, c]
                total += x * x + span * span * y * y
    return total


@kernel
def integrate(forces, a, times, errors, power, tolerance, most, span, frame, h, p, v, q, w, speeds, pulls, told):
    """A frame [s] by a Runge-Kutta method whose steps keep an error at most `tolerance` [m], root mean square.

    a (s, s): rows of the tableau, the last of which ends the step; times (s,): c; errors (1 or 2, s): weights of the
    error, the second one that of a lower order which tempers it; power: the error falls by h^power, 0 keeps h; most:
    how many steps may be tried; span [s]: by what velocities count; h: to begin with; q, w: scratch; speeds, pulls:
    scratch (s, rows); told: takes the steps accepted, those rejected, the last step [s] and the time reached [s].
    """
    free = 0
    for i in range(len(forces.inverse)):
        free += 3 * (forces.inverse[i] != 0.0)
    t, before, stages = 0.0, 1.0, len(a)
    told[0] = told[1] = 0.0
    _evaluate(forces, 0, p, v, speeds, pulls)
    while t < frame:
        last = t + 1.0000001 * h >= frame
        step = frame - t if last else h
        for s in range(1, stages):
            _stage(forces, a[s], s, step, p, v, speeds, pulls, q, w)
            carry(forces, (t + times[s] * step) / frame, q)
            _evaluate(forces, s, q, w, speeds, pulls)
        size = _size(forces, errors[0], span, speeds, pulls)
        if len(errors) > 1:
            other = _size(forces, errors[1], span, speeds, pulls)
            size = size * size / (size + 0.01 * other) if size > 0.0 else 0.0
        error = step * np.sqrt(size / max(1, free)) / tolerance
        if error <= 1.0:
            t = frame if last else t + step
            for i in range(len(p)):
                p[i], v[i] = q[i], w[i]
                speeds[0, i], pulls[0, i] = speeds[stages - 1, i], pulls[stages - 1, i]
            told[0] += 1.0
            if power > 0.0:  # by proportion and integral (Hairer and Wanner, section IV.2)
                change = CAUTION * max(error, 1e-10) ** (-0.7 / power) * before ** (0.4 / power)
                before = max(error, 1e-4)
                h = max(h, step * change) if last else step * min(LARGEST, max(FEWEST, change))
        else:  # and where it is no number
            told[1] += 1.0
            known = power > 0.0 and error < np.inf
            h = step * (max(FEWEST, CAUTION * error ** (-1.0 / power)) if known else FEWEST)
        if h < FLOOR * frame or told[0] + told[1] >= most:
            break
    told[2], told[3] = h, t
