"""Compiled explicit integration of a frame: splitting methods, and Runge-Kutta methods with adaptive step size.

    p' = v,    v' = M^-1 (f - grad E(p)) - c v

Positions, velocities and accelerations are in rows of four. `Forces` has the data that are constant in a frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.kernels.springs import Bundles, add_descent
from solvers.memory import aligned
from solvers.problem import Positions

FEWEST, LARGEST, CAUTION = 0.2, 5.0, 0.9
"""Limits of the change of the step size, and the safety factor."""

FLOOR = 1e-10
"""Smallest step size relative to the frame; below it the integration is abandoned."""

Array = NDArray[np.float64]


class Forces(NamedTuple):
    """The forces of a frame.

    Attributes:
        bundles: packets of the springs at unpinned vertices.
        right: constant force [N], in the layout of `Bundles.right`.
        pairs, weight, held: quadratic form as in `Form`, (k, 2), (k,) and (n,), or
            empty.
        inverse: 1/m [1/kg] in rows of four, 0 for pinned vertices.
        drag: c [1/s] in rows of four.
        pins: vertices (q,) that move uniformly from `begin` to `end`.
        begin, end: positions of the pins (q, 3) [m].
    """

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
def add_forces(forces, p, out):
    """Add all forces except drag [N] at p to `out`, in rows of four."""
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


@inner
def pull(forces, p, out):
    """Write the acceleration [m/s^2] by these forces to `out`."""
    for k in range(len(out)):
        out[k] = 0.0
    add_forces(forces, p, out)
    for k in range(len(out)):
        out[k] *= forces.inverse[k]


@inner
def carry(forces, part, p):
    """Move the pins to their positions at a fraction of the frame."""
    for q in range(len(forces.pins)):
        for c in range(3):
            p[4 * forces.pins[q] + c] = forces.end[q, c] + (1.0 - part) * (forces.begin[q, c] - forces.end[q, c])


@inner
def kick(inverse, kept, gained, first, second, h, p, v, force):
    """Apply one kick to v, a second one unless it is negative, and a drift of p for h [s].

    The force [N] is cleared.
    """
    for i in range(len(p)):
        a = force[i] * inverse[i]
        force[i] = 0.0
        w = kept[first, i] * v[i] + gained[first, i] * a
        if second >= 0:
            w = kept[second, i] * w + gained[second, i] * a
        v[i] = w
        p[i] += h * w


@kernel
def compose(forces, drifts, kept, gained, count, h, p, v, force):
    """Run `count` steps of size h: drift 0, kick 0, drift 1, ..., the last drift.

    If a step neither starts nor ends with a drift, its last kick and the first kick of the next step share one force.
    The arrays p and v are overwritten with the result.

    Args:
        forces: forces of the frame.
        drifts: fractions of h (k + 1,).
        kept, gained: decay of a velocity by a kick, and its gain per acceleration [s] (k, rows), exact for drag.
        count: number of steps.
        h: step size [s].
        p: positions [m].
        v: velocities [m/s].
        force: scratch, initially zero.
    """
    last = len(kept) - 1
    joined = drifts[0] == 0.0 and drifts[-1] == 0.0
    for step in range(count):
        gone = drifts[0]
        if drifts[0] != 0.0:
            for i in range(len(p)):
                p[i] += drifts[0] * h * v[i]
            carry(forces, (step + gone) / count, p)
        for k in range(1 if joined and step > 0 else 0, last + 1):
            both = joined and k == last and step < count - 1
            after = drifts[1] if both else drifts[k + 1]
            add_forces(forces, p, force)
            kick(forces.inverse, kept, gained, k, 0 if both else -1, after * h, p, v, force)
            gone = 1 + after if both else gone + after
            if after != 0.0:
                carry(forces, (step + gone) / count, p)


class Coefficients(NamedTuple):
    """The coefficients of a Runge-Kutta method.

    Attributes:
        a: rows of the tableau (s, s); the last one ends the step.
        times: c (s,).
        errors: weights of the error (1 or 2, s); the second, of lower order, moderates the first.
        power: exponent of h in the error; 0 fixes h.
    """

    a: Array
    times: Array
    errors: Array
    power: float


class Subdivision(NamedTuple):
    """The steps of a frame [s]: rms error tolerance of a step [m], maximum number of tried steps, first step [s]."""

    frame: float
    tolerance: float
    most: float
    first: float


class Scratch(NamedTuple):
    """The motion at a stage, q [m] and w [m/s], and the derivatives q' and w' at all stages, (s, rows)."""

    q: Array
    w: Array
    speeds: Array
    pulls: Array

    @classmethod
    def of(cls, stages: int, rows: int) -> Scratch:
        """Allocate the scratch for a number of stages and of coordinates."""
        return cls(aligned(rows), aligned(rows), *np.zeros((2, stages, rows)))


@inner
def _stage(stages, s, h, p, v, at):
    """Write the motion of stage s to `at`."""
    for i in range(len(p)):
        at.q[i], at.w[i] = p[i], v[i]
    for j in range(s):
        a = stages.a[s, j]
        if a != 0.0:
            for i in range(len(p)):
                at.q[i] += h * a * at.speeds[j, i]
                at.w[i] += h * a * at.pulls[j, i]


@inner
def _evaluate(forces, s, q, w, at):
    """Write q' and w' of stage s to `at`."""
    pull(forces, q, at.pulls[s])
    for i in range(len(q)):
        at.pulls[s, i] -= forces.drag[i] * w[i]
        at.speeds[s, i] = w[i]


@inner
def _squares(forces, weights, span, at):
    """Return the sum of squares of an error: of positions, and of velocities times `span`."""
    total = 0.0
    for i in range(0, len(forces.inverse), 4):
        if forces.inverse[i] != 0.0:
            for c in range(i, i + 3):
                x = y = 0.0
                for j in range(len(weights)):
                    x += weights[j] * at.speeds[j, c]
                    y += weights[j] * at.pulls[j, c]
                total += x * x + span * span * y * y
    return total


@inner
def _error(forces, errors, span, at):
    """Return the sum of squares of a step's error; a second estimate moderates the first one."""
    size = _squares(forces, errors[0], span, at)
    if len(errors) == 1:
        return size
    other = _squares(forces, errors[1], span, at)
    return size * size / (size + 0.01 * other) if size > 0.0 else 0.0


@kernel
def integrate(forces, stages, steps, p, v, at, told):
    """Integrate a frame by a Runge-Kutta method with adaptive step size.

    An error of the velocity is multiplied by the length of the frame.

    Args:
        forces: forces of the frame.
        stages: coefficients of the method.
        steps: length and tolerance of the frame.
        p: positions [m], overwritten with the result.
        v: velocities [m/s], overwritten with the result.
        at: scratch.
        told: output: accepted steps, rejected steps, last step size [s], time reached [s].
    """
    free = 0
    for i in range(0, len(forces.inverse), 4):
        free += 3 * (forces.inverse[i] != 0.0)
    frame, power, end = steps.frame, stages.power, len(stages.a) - 1
    t, before, h = 0.0, 1.0, steps.first
    told[0] = told[1] = 0.0
    _evaluate(forces, 0, p, v, at)
    while t < frame:
        last = t + 1.0000001 * h >= frame
        step = frame - t if last else h
        for s in range(1, end + 1):
            _stage(stages, s, step, p, v, at)
            carry(forces, (t + stages.times[s] * step) / frame, at.q)
            _evaluate(forces, s, at.q, at.w, at)
        error = step * np.sqrt(_error(forces, stages.errors, frame, at) / max(1, free)) / steps.tolerance
        if error <= 1.0:
            t = frame if last else t + step
            for i in range(len(p)):
                p[i], v[i] = at.q[i], at.w[i]
                at.speeds[0, i], at.pulls[0, i] = at.speeds[end, i], at.pulls[end, i]
            told[0] += 1.0
            if power > 0.0:  # by proportion and integral (Hairer and Wanner, section IV.2)
                change = CAUTION * max(error, 1e-10) ** (-0.7 / power) * before ** (0.4 / power)
                before = max(error, 1e-4)
                h = max(h, step * change) if last else step * min(LARGEST, max(FEWEST, change))
        else:  # and where it is no number
            told[1] += 1.0
            known = power > 0.0 and error < np.inf
            h = step * (max(FEWEST, CAUTION * error ** (-1.0 / power)) if known else FEWEST)
        if h < FLOOR * frame or told[0] + told[1] >= steps.most:
            break
    told[2], told[3] = h, t
