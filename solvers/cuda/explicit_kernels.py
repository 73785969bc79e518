"""Kernels of explicit methods: forces, a kick and a drift in one launch, a Runge-Kutta stage in two.

    f_i = f - h_i p_i - sum over its edges of t v,      t = k (|v|^2 - r^2) / ((|v| + r) |v|)

Positions, velocities and |v|^2 - r^2 are float64, the rest of a tension is of the kernels' type: so float32 errs by a
part of the tension, and not of the length. Rows are those of `solvers.cuda.network`: the free ones first, then the
pinned, which move evenly. A kick writes positions to another array than it reads them from, for neighbours read them.

Of a method that chooses its steps, `now` has them on the device; after the last one all kernels do nothing:

    ENDED, whether it has; T, the time reached [s]; STEP, the step that is tried, and H, that before the frame's end cut
    it [s]; LAST, whether it ends the frame; BEFORE, the error of the last one over the tolerance; TAKEN, whether it was
    taken; how many were ACCEPTED and REJECTED
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from solvers.cuda import sums
from solvers.cuda.springs import SHORT
from solvers.cuda.target import cuda
from solvers.kernels.explicit_steps import CAUTION, FEWEST, FLOOR, LARGEST

ENDED, T, STEP, H, LAST, BEFORE, TAKEN, ACCEPTED, REJECTED = range(9)
NOTHING = np.zeros(9)
"""`now` before it is told anything."""


class Motion(NamedTuple):
    """What does not change in a frame, on the device: hold (f,) [N/m], force (f, 3) [N], inverse: 1/m (f,) [1/kg] and
    drag (f,) [1/s] of the free rows; begin, end (q, 3) [m]: of the pinned ones."""

    hold: Any
    force: Any
    inverse: Any
    drag: Any
    begin: Any
    end: Any


class Kernels(NamedTuple):
    """Of a precision: see each."""

    kick: Any
    evaluate: Any


@cache
def kernels(real: type[np.float32] | type[np.float64]) -> Kernels:
    """Those that compute tensions in `real`."""
    short = SHORT[real]

    @cuda.jit(device=True)
    def acceleration(edges, motion, p, i):
        """M^-1 of all forces but drag on a free row [m/s^2]."""
        x, y, z, h = p[i, 0], p[i, 1], p[i, 2], motion.hold[i]
        f0, f1, f2 = motion.force[i, 0] - h * x, motion.force[i, 1] - h * y, motion.force[i, 2] - h * z
        e, end = edges.first[i >> 5] + (i & 31), edges.first[(i >> 5) + 1]
        while e < end:
            j = edges.other[e]
            if j == i:
                break
            v0, v1, v2 = x - p[j, 0], y - p[j, 1], z - p[j, 2]
            k, rest, squared = edges.stiffness[e], edges.rest[e], v0 * v0 + v1 * v1 + v2 * v2
            if squared > short:
                length = real(math.sqrt(real(squared)))
                pull = np.float64(real(k) * real(squared - rest * rest) / ((length + real(rest)) * length))
                f0, f1, f2 = f0 - pull * v0, f1 - pull * v1, f2 - pull * v2
            else:
                named, pull = edges.edge[e], k * rest
                if named < 0:
                    named, pull = ~named, -pull
                f0 += pull * edges.axis[named, 0]
                f1 += pull * edges.axis[named, 1]
                f2 += pull * edges.axis[named, 2]
            e += 32
        w = motion.inverse[i]
        return w * f0, w * f1, w * f2

    @cuda.jit
    def kick(edges, motion, kept, gained, first, second, drift, part, p, v, q):
        """A kick of v, a second one unless it is negative, and a drift [s] of p to q; pins as after `part` of a frame.

        kept, gained (k, f) or (k, 1): of each kick, what is left of a velocity and what it gains of the acceleration
        [s].
        """
        i, rows = cuda.grid(1), v.shape[0]
        while i < p.shape[0]:
            if i < rows:
                a0, a1, a2 = acceleration(edges, motion, p, i)
                at = i if kept.shape[1] > 1 else 0
                left, won = kept[first, at], gained[first, at]
                w0, w1, w2 = left * v[i, 0] + won * a0, left * v[i, 1] + won * a1, left * v[i, 2] + won * a2
                if second >= 0:
                    left, won = kept[second, at], gained[second, at]
                    w0, w1, w2 = left * w0 + won * a0, left * w1 + won * a1, left * w2 + won * a2
                v[i, 0], v[i, 1], v[i, 2] = w0, w1, w2
                q[i, 0], q[i, 1], q[i, 2] = p[i, 0] + drift * w0, p[i, 1] + drift * w1, p[i, 2] + drift * w2
            else:
                carry(motion, i - rows, part, q, i)
            i += cuda.gridsize(1)

    @cuda.jit
    def evaluate(edges, motion, q, s, speeds, pulls, now):
        """Write the acceleration of stage s to `pulls` (s, f, 3), at q and its speeds."""
        if now[ENDED] != 0.0:
            return
        i = cuda.grid(1)
        while i < pulls.shape[1]:
            a0, a1, a2 = acceleration(edges, motion, q, i)
            c = motion.drag[i]
            pulls[s, i, 0] = a0 - c * speeds[s, i, 0]
            pulls[s, i, 1] = a1 - c * speeds[s, i, 1]
            pulls[s, i, 2] = a2 - c * speeds[s, i, 2]
            i += cuda.gridsize(1)

    return Kernels(kick, evaluate)


@cuda.jit
def begin(vertex, step, motion, p, q, v):
    """Take a step: its start for positions, in both arrays, and for velocities, its force and where pins lead."""
    i, rows = cuda.grid(1), v.shape[0]
    while i < p.shape[0]:
        at = vertex[i]
        for c in range(3):
            here = step.positions[at, c]
            p[i, c], q[i, c] = here, here
            if i < rows:
                v[i, c], motion.force[i, c] = step.velocity[at, c], step.force[at, c]
            else:
                motion.begin[i - rows, c], motion.end[i - rows, c] = here, step.pins[i - rows, c]
        i += cuda.gridsize(1)


@cuda.jit
def speeds(motion, frame, v, out):
    """Write velocities at a frame's end to `out` (n, 3), of pinned rows what brings them evenly to their targets."""
    i, rows = cuda.grid(1), v.shape[0]
    while i < out.shape[0]:
        for c in range(3):
            k = i - rows
            out[i, c] = v[i, c] if i < rows else (motion.end[k, c] - motion.begin[k, c]) / frame
        i += cuda.gridsize(1)


@cuda.jit(device=True)
def carry(motion, pin, part, q, i):
    """Put a pinned row where it is after this part of the frame."""
    for c in range(3):
        q[i, c] = motion.end[pin, c] + (1.0 - part) * (motion.begin[pin, c] - motion.end[pin, c])


@cuda.jit
def drifted(motion, drift, part, p, v):
    """A drift [s] of p, and pins as after `part` of the frame."""
    i, rows = cuda.grid(1), v.shape[0]
    while i < p.shape[0]:
        if i < rows:
            for c in range(3):
                p[i, c] += drift * v[i, c]
        else:
            carry(motion, i - rows, part, p, i)
        i += cuda.gridsize(1)


@cuda.jit
def stage(motion, frame, a, times, s, p, v, speeds, pulls, q, now):
    """Write the positions of stage s to q and its velocities to `speeds`, of a step from p and v."""
    if now[ENDED] != 0.0:
        return
    i, rows, h = cuda.grid(1), v.shape[0], now[STEP]
    while i < p.shape[0]:
        if i < rows:
            for c in range(3):
                x, w = p[i, c], v[i, c]
                for j in range(s):
                    if a[s, j] != 0.0:
                        x += h * a[s, j] * speeds[j, i, c]
                        w += h * a[s, j] * pulls[j, i, c]
                q[i, c], speeds[s, i, c] = x, w
        else:
            carry(motion, i - rows, (now[T] + times[s] * h) / frame, q, i)
        i += cuda.gridsize(1)


@cuda.jit
def errors(weights, frame, speeds, pulls, partials, now):
    """The first stages of the squares of errors by `weights` (1 or 2, s), velocities by what they move in a frame."""
    if now[ENDED] != 0.0:
        return
    for k in range(weights.shape[0]):
        total, i = 0.0, cuda.grid(1)
        while i < speeds.shape[1]:
            for c in range(3):
                x, y = 0.0, 0.0
                for j in range(weights.shape[1]):
                    x += weights[k, j] * speeds[j, i, c]
                    y += weights[k, j] * pulls[j, i, c]
                total += x * x + frame * frame * y * y
            i += cuda.gridsize(1)
        sums.keep(total, k, partials)


@cuda.jit
def choose(frame, tolerance, power, most, entries, estimates, partials, count, now):
    """Whether a step is taken, and the next one, as `solvers.kernels.explicit_steps.integrate` does; one block.

    entries: numbers that move; estimates: of the error, 0 where steps have one length; most: steps that may be tried.
    """
    if now[ENDED] != 0.0:
        if cuda.threadIdx.x == 0:
            now[TAKEN] = 0.0
        return
    size = 0.0
    if estimates > 0:
        size = sums.of_all(0, partials, count)
    if estimates > 1:
        other = sums.of_all(1, partials, count)
        size = size * size / (size + 0.01 * other) if size > 0.0 else 0.0
    if cuda.threadIdx.x == 0:
        step, last = now[STEP], now[LAST]
        error = step * math.sqrt(size / max(1.0, entries)) / tolerance
        h = now[H]
        if error <= 1.0:
            now[T] = frame if last != 0.0 else now[T] + step
            now[TAKEN] = 1.0
            now[ACCEPTED] += 1.0
            if power > 0.0:
                change = CAUTION * max(error, 1e-10) ** (-0.7 / power) * now[BEFORE] ** (0.4 / power)
                now[BEFORE] = max(error, 1e-4)
                h = max(h, step * change) if last != 0.0 else step * min(LARGEST, max(FEWEST, change))
        else:  # and where it is no number
            now[TAKEN] = 0.0
            now[REJECTED] += 1.0
            h = step * FEWEST
            if power > 0.0 and error < math.inf:
                h = step * max(FEWEST, CAUTION * error ** (-1.0 / power))
        now[H] = h
        over = now[T] + 1.0000001 * h >= frame
        now[LAST] = 1.0 if over else 0.0
        now[STEP] = frame - now[T] if over else h
        if not now[T] < frame or h < FLOOR * frame or now[ACCEPTED] + now[REJECTED] >= most:
            now[ENDED] = 1.0


@cuda.jit
def take(s, q, p, v, speeds, pulls, now):
    """Go where stage s, the last one, ends, if the step is taken; what is known there is the next step's first."""
    if now[TAKEN] == 0.0:
        return
    i, rows = cuda.grid(1), v.shape[0]
    while i < p.shape[0]:
        for c in range(3):
            p[i, c] = q[i, c]
            if i < rows:
                v[i, c] = speeds[s, i, c]
                speeds[0, i, c], pulls[0, i, c] = speeds[s, i, c], pulls[s, i, c]
        i += cuda.gridsize(1)
