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
from solvers.memory import aligned
from solvers.problem import Positions

FEWEST, LARGEST, CAUTION = 0.2, 5.0, 0.9
"""What a step may shrink and grow by at once, and the part taken of what the error allows."""

FLOOR = 1e-10
"""Of a frame: a shorter step is given up."""

Array = NDArray[np.float64]


class Forces(NamedTuple):
    """bundles: of the springs at unpinned vertices; right: the constant force [N], as `Bundles.right` has it; a
    quadratic form as `solvers.kernels.forms.Form` has it: pairs (k, 2), weight (k,), held (n,), or empty; inverse:
    1/m [1/kg], 0 for the pinned, and drag: c [1/s], both in rows of four; pins (q,): vertices that move evenly from
    `begin` to `end`, (q, 3) [m]."""

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
    """Add all forces but drag [N] at p to `out`, in rows of four."""
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
    """Write M^-1 of these forces [m/s^2] to `out`."""
    for k in range(len(out)):
        out[k] = 0.0
    add_forces(forces, p, out)
    for k in range(len(out)):
        out[k] *= forces.inverse[k]


@inner
def carry(forces, part, p):
    """Put the pins where they are after this part of the frame."""
    for q in range(len(forces.pins)):
        for c in range(3):
            p[4 * forces.pins[q] + c] = forces.end[q, c] + (1.0 - part) * (forces.begin[q, c] - forces.end[q, c])


@inner
def kick(inverse, kept, gained, first, second, h, p, v, force):
    """A kick of v, a second one unless it is negative, and a drift of p for h [s]; the force [N] is used up."""
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
    """`count` steps of h [s]: drift 0, kick 0, drift 1, ..., the last drift, of p and v, which take the result. Where a
    step neither ends nor begins with a drift, its last kick and the next step's first have one force.

    drifts (k + 1,): parts of h; kept and gained (k, rows): what is left of a velocity by a kick, and what it gains of
    the acceleration [s], both exact for drag; force: scratch, of zeros.
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
    """A Runge-Kutta method: a (s, s), rows of the tableau, the last of which ends the step; times (s,): c; errors
    (1 or 2, s): weights of the error, the second one that of a lower order which tempers it; power: the error falls by
    h^power, 0 keeps h."""

    a: Array
    times: Array
    errors: Array
    power: float


class Subdivision(NamedTuple):
    """How a frame [s] is cut: tolerance [m]: of each step, root mean square; most: how many may be tried; first [s]."""

    frame: float
    tolerance: float
    most: float
    first: float


class Scratch(NamedTuple):
    """The motion at a stage, q [m] and w [m/s], and q' and w' at all of them, (s, rows)."""

    q: Array
    w: Array
    speeds: Array
    pulls: Array

    @classmethod
    def of(cls, stages: int, rows: int) -> Scratch:
        """Memory for so many numbers of positions."""
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
    """The sum of squares of an error by its weights: of positions, and of velocities by what they move in `span`."""
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
    """The sum of squares of a step's error; of two estimates the second one tempers the first."""
    size = _squares(forces, errors[0], span, at)
    if len(errors) == 1:
        return size
    other = _squares(forces, errors[1], span, at)
    return size * size / (size + 0.01 * other) if size > 0.0 else 0.0


@kernel
def integrate(forces, stages, steps, p, v, at, told):
    """A frame by a Runge-Kutta method whose steps keep to an error; an error of velocity counts by what it moves in the
    frame.

    p [m], v [m/s]: take the result; at: scratch; told: takes the steps accepted, those rejected, the last step [s] and
    the time reached [s].
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
