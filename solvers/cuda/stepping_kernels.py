"""Kernels between steps on a device: filters of the velocity, what a step gives, and where it ends; by vertices.

The formulas are those of `solvers.cuda.stepping`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from solvers.cuda.target import cuda


class Motions(NamedTuple):
    """On the device, each (n, 3): p [m], v [m/s], and p', v' one step before, the same arrays where nothing is
    recalled."""

    p: Any
    v: Any
    p_before: Any
    v_before: Any


class Weights(NamedTuple):
    """Of an integrator: see `solvers.device.Rule`; rate [1/s]: the unknown's velocity over what it moved."""

    recalls: float
    leads: float
    bends: float
    ahead: float
    when: float
    rate: float


class Gives(NamedTuple):
    """What a step gives: target, guess (n, 3) [m], force (n, 3) [N], and where pins hold the unknown, (q, 3) [m]."""

    target: Any
    force: Any
    guess: Any
    pins: Any


@cuda.jit
def decay(v, kept):
    """`solvers.filters.Decay`."""
    i = cuda.grid(1)
    while i < v.shape[0]:
        v[i, 0], v[i, 1], v[i, 2] = kept * v[i, 0], kept * v[i, 1], kept * v[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def slow(v, mass, coefficient):
    """`solvers.filters.QuadraticDrag`."""
    i = cuda.grid(1)
    while i < v.shape[0]:
        drag = coefficient[i] * (v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]) ** 0.5
        if drag > 0.0:
            left = mass[i] / (mass[i] + drag)
            v[i, 0], v[i, 1], v[i, 2] = left * v[i, 0], left * v[i, 1], left * v[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def predict(motions, weights, load, drag, pin, wanted, kind, gives):
    """Write what a step gives. load (n, 3) [N], drag (n,) [N s/m]; pin (n,): the number of a vertex's pin, -1 for none;
    wanted (q, 3) [m]: where pins want their vertices at the step's end; kind: of first guess."""
    p, v = motions.p, motions.v
    i = cuda.grid(1)
    while i < p.shape[0]:
        k = pin[i]
        for c in range(3):
            here, speed = p[i, c], v[i, c]
            origin = here + weights.recalls * (here - motions.p_before[i, c])
            target = origin + weights.leads * speed + weights.bends * (speed - motions.v_before[i, c])
            gives.target[i, c] = target
            gives.force[i, c] = load[i, c] + weights.rate * drag[i] * origin
            guess = target if kind == 2 else here
            if k >= 0:
                held = wanted[k, c] if weights.when == 1.0 else here + weights.when * (wanted[k, c] - here)
                gives.pins[k, c] = held
                guess = held if kind > 0 else guess
            gives.guess[i, c] = guess
        i += cuda.gridsize(1)


@cuda.jit
def lag(motions, weights, origin, lagged):
    """Write where the unknown's velocity is taken from, and where what is lagged is taken (n, 3) [m]."""
    p = motions.p
    i = cuda.grid(1)
    while i < p.shape[0]:
        for c in range(3):
            here = p[i, c]
            origin[i, c] = here + weights.recalls * (here - motions.p_before[i, c])
            lagged[i, c] = here + weights.ahead * motions.v[i, c]
        i += cuda.gridsize(1)


@cuda.jit
def advance(vertex, rows, weights, motions):
    """Take where a solve ended, in rows, for the unknown, and go to the step's end."""
    p, v = motions.p, motions.v
    r = cuda.grid(1)
    while r < vertex.shape[0]:
        i = vertex[r]
        for c in range(3):
            x, here, speed = rows[r, c], p[i, c], v[i, c]
            origin = here + weights.recalls * (here - motions.p_before[i, c])
            w = weights.rate * (x - origin)
            motions.p_before[i, c], motions.v_before[i, c] = here, speed
            if weights.when == 1.0:
                p[i, c], v[i, c] = x, w
            else:  # x and w are means over the step
                p[i, c], v[i, c] = 2.0 * x - here, 2.0 * w - speed
        r += cuda.gridsize(1)


@cuda.jit
def arrive(vertex, rows, speeds, p, v):
    """Take positions and velocities of a step's end, in rows, as they are."""
    r = cuda.grid(1)
    while r < vertex.shape[0]:
        i = vertex[r]
        for c in range(3):
            p[i, c], v[i, c] = rows[r, c], speeds[r, c]
        r += cuda.gridsize(1)
