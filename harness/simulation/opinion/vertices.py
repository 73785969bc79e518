"""Reference terms per vertex: attachments, drag, Rayleigh damping, velocity decay, pins.

attachments   k/2 |x_i - q_i(t)|^2, the stiffness shared equally
air drag      c rate/2 |x_i - o_i|^2, of which the gradient is c v_i; quadratic: m dv/dt = -c |v| v, solved exactly
              over a step, v <- v / (1 + dt c |v| / m)
ether drag    v <- exp(-c dt) v                                           Liu et al. 2013, section 5
Rayleigh      C = a M + b K: a m_i as drag, b k as dashpots along springs, b times the matrix of bending
pins          w/2 |x_i - q_i(t)|^2, or exactly, at the rest position moved by key frames
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from harness.simulation.opinion.declared import Array, Begin, Declared, Moment, Opinion, PinnedVertex
from harness.simulation.opinion.derivatives import Values, Wide, wide
from harness.simulation.opinion.edges import along_edges, finite, of_springs
from harness.simulation.opinion.motion import place, speed
from harness.simulation.opinion.selected import chosen
from harness.simulation.opinion.surfaces import damped_bending


def attachments(effect: Any, declared: Declared) -> Opinion:
    """Build springs of zero length to points."""
    vertices = chosen(declared, effect)
    k = np.longdouble(effect.stiffness) / len(vertices)
    given = declared.rest[vertices] if effect.to is None else np.broadcast_to(wide(effect.to), (len(vertices), 3))

    def begin(moment: Moment) -> Values:
        q = place(effect.motion, moment.until).there(given)
        return lambda x: k / 2 * ((x[vertices] - q) ** 2).sum(axis=1)

    resists = np.zeros(len(declared.mass))
    resists[vertices] = float(k)
    return Opinion(begin, resists, reach=float(np.abs(given).max()) + _reach(effect.motion))


def _reach(motion: Any) -> float:
    """Return the largest translation [m] of key frames, without rotations."""
    return max((float(np.abs(key.offset).max()) for key in motion.keys), default=0.0) if motion else 0.0


def air_drag(effect: Any, declared: Declared) -> Opinion:
    """Build drag in still air, as an energy or as a velocity filter."""
    c = effect.coefficient * declared.mesh.shares
    if effect.law == "linear":
        return Opinion(_drag(c), c / declared.time_step)
    dt, mass = declared.time_step, declared.mass

    def force(p: Array, v: Array, t: float) -> tuple[Array, float]:
        speed = np.sqrt((v**2).sum(axis=1))
        drag = np.minimum(c * speed, mass / dt)
        # The accuracy of a speed is the round-off of positions, times the rate.
        return -drag[:, None] * v, float((drag + c * speed).max()) * (float(speed.max()) + declared.mesh.size / dt)

    if declared.staged:
        return Opinion(force=force)

    def slowed(v: Array) -> Array:
        speed = np.sqrt((v**2).sum(axis=1))
        drag = dt * c * speed
        return np.array([u * m / (m + d) if d > 0 else u for u, m, d in zip(v, mass, drag, strict=True)])

    return Opinion(decay=slowed)


def _drag(c: Array) -> Begin:
    def begin(moment: Moment) -> Values:
        return lambda x: wide(c) * moment.rate / 2 * ((x - moment.origin) ** 2).sum(axis=1)

    return begin


def ether_drag(effect: Any, declared: Declared) -> Opinion:
    """Build decay of all velocities, or drag proportional to mass."""
    if declared.staged:
        c = effect.rate * declared.mass
        return Opinion(_drag(c), c / declared.time_step)
    return Opinion(decay=lambda v: math.exp(-effect.rate * declared.time_step) * v)


def rayleigh(effect: Any, declared: Declared) -> Opinion:
    """Build damping proportional to the masses and to the stiffness of springs and bending."""
    b, parts = effect.stiffness, [_drag(effect.mass * declared.mass)]
    if b:
        parts += [along_edges(declared, b * finite(of_springs(s, declared))) for s in declared.of_kind("springs")]
        parts += [damped_bending(one, b, declared) for one in declared.of_kind("bending")]

    def begin(moment: Moment) -> Values:
        begun = [part(moment) for part in parts]

        def values(x: Wide) -> Wide:
            return np.concatenate([values(x) for values in begun])

        return values

    return Opinion(begin, effect.mass * declared.mass / declared.time_step)


def pins(effect: Any, declared: Declared) -> Opinion:
    """Build pinned vertices."""
    weight = math.inf if effect.weight == "exact" else float(effect.weight)
    held = {i: pin(weight, effect.motion, declared.rest[i]) for i in chosen(declared, effect)}
    return Opinion(pins=held, reach=_reach(effect.motion))


def pin(weight: float, motion: Any, q: Wide) -> PinnedVertex:
    """Build a pin.

    Args:
      weight: penalty weight [N/m], infinite for an exact pin.
      motion: key frames, None for none.
      q: declared point (3,) [m].
    """

    def there(time: float) -> Wide:
        return place(motion, time).there(q[None])[0]

    def moving(time: float) -> Wide:
        return speed(motion, q, time)

    return PinnedVertex(weight, there, moving)
