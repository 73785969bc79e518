"""Lagged Coulomb friction of collisions with given normal forces: a convex function of positions within the step.

    E(p) = sum over pairs of mu F h(|u|),     u = (I - nn') sum_i c_i (x_i - x_i^t)

F: the barrier's normal force at `start.pressed`, an iterate of this step, or at the step's start if that is None; c, n:
coefficients and direction of the closest points there; x^t: positions at the step's start (Li et al. 2020, "Incremental
potential contact", section 5; `solvers.contact.friction_rounds` iterates them to convergence). h is the length,
smoothed where a pair slips by less than s in a step; its slope is continuous, and below 1 there:

    h(u) = u^2/s - u^3/(3 s^2)  for u < s,     u - s/3 beyond
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact import barrier
from solvers.contact.blocks import NUMBERS, Blocks, row
from solvers.contact.contacts import Contacts
from solvers.problem import Positions

Array = NDArray[np.float64]


class Grip(NamedTuple):
    """Collisions with friction.

    Attributes:
        vertices: (g, 4); missing vertices have zero coefficients.
        weights: c (g, 4).
        normal: unit normals (g, 3).
        anchor: sum_i c_i x_i^t [m], (g, 3).
        force: mu F [N], (g,).
        slip: s [m].
    """

    vertices: NDArray[np.int64]
    weights: Array
    normal: Array
    anchor: Array
    force: Array
    slip: float

    @classmethod
    def of(cls, contacts: Contacts, start: Positions, friction: float, slip: float) -> Self:
        """Build the friction of collisions.

        Args:
            contacts: active collisions.
            start: positions of all vertices at the step's start [m].
            friction: friction coefficient mu.
            slip: s [m].
        """
        between, force = contacts.between, np.empty(len(contacts.vertices))
        barrier.forces(contacts, force)
        normal = between / np.sqrt(np.einsum("ij,ij->i", between, between))[:, None]
        vertices, weights, anchor = contacts.vertices.copy(), contacts.weights.copy(), np.empty_like(between)
        combine(vertices, weights, start, anchor)
        return cls(vertices, weights, normal, anchor, friction * force, slip)

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p (n, 3)."""
        return hold(self, p)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N] at p (n, 3) to `out`."""
        pull(self, p, out)

    def blocks(self, p: Positions) -> Blocks:
        """Return the Hessian blocks at p (n, 3), positive semidefinite."""
        many = len(self.vertices)
        packed = np.empty(NUMBERS * many)
        curve(self, p, packed)
        return Blocks(self.vertices, NUMBERS * np.arange(many + 1), packed)


@inner
def combined(x, c, p, axis):
    """Return sum_i c_i p_i [m] along an axis."""
    return c[0] * p[x[0], axis] + c[1] * p[x[1], axis] + c[2] * p[x[2], axis] + c[3] * p[x[3], axis]


@kernel
def combine(vertices, weights, p, out):
    """Write sum_i c_i p_i [m] of each collision to `out`."""
    for e in range(len(vertices)):
        for axis in range(3):
            out[e, axis] = combined(vertices[e], weights[e], p, axis)


@inner
def slipped(grip, p, e):
    """Return the tangential displacement u and |u| [m] of collision e."""
    x, c, n = grip.vertices[e], grip.weights[e], grip.normal[e]
    u0 = combined(x, c, p, 0) - grip.anchor[e, 0]
    u1 = combined(x, c, p, 1) - grip.anchor[e, 1]
    u2 = combined(x, c, p, 2) - grip.anchor[e, 2]
    along = u0 * n[0] + u1 * n[1] + u2 * n[2]
    u0, u1, u2 = u0 - along * n[0], u1 - along * n[1], u2 - along * n[2]
    return u0, u1, u2, np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)


@inner
def rate(length, slip):
    """Return h'(u)/u [1/m]."""
    return (2.0 - length / slip) / slip if length < slip else 1.0 / length


@inner
def rounded(length, slip):
    """Return h [m] of a length."""
    y = min(length / slip, 1.0)
    return slip * (y * y - y * y * y / 3.0) + max(length - slip, 0.0)


@inner
def bends(u0, u1, u2, length, slip):
    """Return h'(u)/u, h''(u) minus that [1/m], and u/|u|."""
    flat, least = rate(length, slip), max(length, 1e-300)
    return flat, max(2.0 * (1.0 - length / slip) / slip, 0.0) - flat, (u0 / least, u1 / least, u2 / least)


@inner
def bent(n, second, a, b):
    """Return entry (a, b) of the Hessian of h [1/m], tangential to n (3,); second: from `bends`."""
    flat, more, u = second
    same = 1.0 if a == b else 0.0
    return flat * (same - n[a] * n[b]) + more * u[a] * u[b]


@kernel
def hold(grip, p):
    """Return the friction energy [J] at p (n, 3)."""
    total, s = 0.0, grip.slip
    for e in range(len(grip.vertices)):
        length = slipped(grip, p, e)[3]
        total += grip.force[e] * rounded(length, s)
    return total


@kernel
def pull(grip, p, out):
    """Add the friction gradient [N] at p (n, 3) to `out`."""
    for e in range(len(grip.vertices)):
        u0, u1, u2, length = slipped(grip, p, e)
        w = grip.force[e] * rate(length, grip.slip)
        for i in range(4):
            v, c = grip.vertices[e, i], grip.weights[e, i]
            out[v, 0] += c * (w * u0)
            out[v, 1] += c * (w * u1)
            out[v, 2] += c * (w * u2)


@kernel
def curve(grip, p, out):
    """Write the packed Hessian block of each collision at p (n, 3) to `out`."""
    for e in range(len(grip.vertices)):
        n, c, H = grip.normal[e], grip.weights[e], out[NUMBERS * e : NUMBERS * (e + 1)]
        u0, u1, u2, length = slipped(grip, p, e)
        second = bends(u0, u1, u2, length, grip.slip)
        for a in range(3):
            for b in range(3):
                h = grip.force[e] * bent(n, second, a, b)
                for i in range(4):
                    for j in range(i + 1):
                        H[row(i, a) + 3 * j + b] = c[i] * c[j] * h


_NONE = np.empty((0, 3))
NO_GRIP = Grip(np.empty((0, 4), np.int64), np.empty((0, 4)), _NONE, _NONE, np.empty(0), 1.0)
