"""Lagged Coulomb friction of collisions with given normal forces: a convex function of positions.

    E(p) = sum over pairs of mu F h(|u|),     u = (I - nn') sum_i c_i (x_i - x_i^t)

F: the barrier's normal force at `start.normal_force_positions`, an iterate of this step, or at the step's start if that
is None; c, n: coefficients and direction of the closest points there; x^t: positions at the step's start (Li et al.
2020, "Incremental potential contact", section 5; `springbench.solvers.contact.lagged_friction` iterates them to
convergence). h is the length, smoothed where a pair slips by less than s in a step, by the law of half-spaces
(`springbench.solvers.contact.potentials.friction_law`). The paper's h, u^2/s - u^3/(3 s^2) for u < s, has a continuous
second derivative; Newton's method needs no fewer iterations with it, and up to a third more.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.collisions import Collisions
from springbench.solvers.contact.potentials import barrier
from springbench.solvers.contact.potentials.friction_law import (
    friction_stiffness,
    project_tangentially,
    smoothed_length,
)
from springbench.solvers.contact.potentials.hessian_blocks import BLOCK_ENTRIES, PackedBlocks, row_offset
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.model.step_problem import Positions

FloatArray = NDArray[np.float64]


class TangentialCollisions(NamedTuple):
    """Collisions with friction.

    Attributes:
        vertices: (g, 4); missing vertices have zero coefficients.
        coefficients: c (g, 4).
        normal: unit normals (g, 3).
        friction_anchor: sum_i c_i x_i^t [m], (g, 3).
        friction_limit: mu F [N], (g,).
        smoothing_length: s [m].
    """

    vertices: NDArray[np.int64]
    coefficients: FloatArray
    normal: FloatArray
    friction_anchor: FloatArray
    friction_limit: FloatArray
    smoothing_length: float

    @classmethod
    def from_collisions(
        cls, collisions: Collisions, start: Positions, friction: float, smoothing_length: float
    ) -> Self:
        """Build the friction of collisions.

        Args:
            collisions: active collisions.
            start: positions of all vertices at the step's start [m].
            friction: friction coefficient mu.
            smoothing_length: s [m].
        """
        between, force = collisions.distance_vector, np.empty(len(collisions.vertices))
        barrier.compute_normal_forces(collisions, force)
        normal = between / np.sqrt(np.einsum("ij,ij->i", between, between))[:, None]
        vertices, weights, anchor = collisions.vertices.copy(), collisions.coefficients.copy(), np.empty_like(between)
        combine_positions(vertices, weights, start, anchor)
        return cls(vertices, weights, normal, anchor, friction * force, smoothing_length)

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p (n, 3)."""
        return friction_energy(self, p)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient of friction.

        Args:
            p: positions of all vertices (n, 3) [m].
            out: gradient (n, 3) [N], updated.
        """
        add_friction_gradient(self, p, out)

    def hessian_blocks(self, p: Positions) -> PackedBlocks:
        """Return the Hessian blocks at p (n, 3), positive semidefinite."""
        many = len(self.vertices)
        packed = np.empty(BLOCK_ENTRIES * many)
        write_friction_hessian(self, p, packed)
        return PackedBlocks(self.vertices, BLOCK_ENTRIES * np.arange(many + 1), packed)


@jit_inner
def combine_coordinate(x, c, p, axis):
    """Return sum_i c_i p_i [m] along an axis.

    Args:
        x: vertices of the collision (4,).
        c: coefficients (4,).
        p: positions (n, 3) [m].
        axis: coordinate, 0 to 2.
    """
    return c[0] * p[x[0], axis] + c[1] * p[x[1], axis] + c[2] * p[x[2], axis] + c[3] * p[x[3], axis]


@jit_kernel
def combine_positions(vertices, weights, p, out):
    """Compute sum_i c_i p_i of each collision.

    Args:
        vertices: vertices of each collision (g, 4).
        weights: coefficients c (g, 4).
        p: positions (n, 3) [m].
        out: output (g, 3) [m].
    """
    for e in range(len(vertices)):
        for axis in range(3):
            out[e, axis] = combine_coordinate(vertices[e], weights[e], p, axis)


@jit_inner
def tangential_displacement(tangential_collisions, p, e):
    """Return the tangential displacement u, three numbers, and |u| [m] of a collision.

    Args:
        tangential_collisions: collisions with friction.
        p: positions (n, 3) [m].
        e: index of the collision.
    """
    x, c, n = tangential_collisions.vertices[e], tangential_collisions.coefficients[e], tangential_collisions.normal[e]
    u0, u1, u2 = project_tangentially(
        combine_coordinate(x, c, p, 0) - tangential_collisions.friction_anchor[e, 0],
        combine_coordinate(x, c, p, 1) - tangential_collisions.friction_anchor[e, 1],
        combine_coordinate(x, c, p, 2) - tangential_collisions.friction_anchor[e, 2],
        n[0], n[1], n[2],
    )  # fmt: skip
    return u0, u1, u2, np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)


@jit_inner
def slip_direction(u0, u1, u2, length, smoothing_length):
    """Return u/|u| of a collision that slips, and zero of one that sticks.

    Args:
        u0, u1, u2: tangential displacement u [m].
        length: |u| [m].
        smoothing_length: s [m], up to which a collision sticks.
    """
    if length <= smoothing_length:
        return 0.0, 0.0, 0.0
    return u0 / length, u1 / length, u2 / length


@jit_kernel
def friction_energy(tangential_collisions, p):
    """Return the friction energy [J].

    Args:
        tangential_collisions: collisions with friction.
        p: positions (n, 3) [m].
    """
    total, s = 0.0, tangential_collisions.smoothing_length
    for e in range(len(tangential_collisions.vertices)):
        length = tangential_displacement(tangential_collisions, p, e)[3]
        total += tangential_collisions.friction_limit[e] * smoothed_length(length, s)
    return total


@jit_kernel
def add_friction_gradient(tangential_collisions, p, out):
    """Add the friction gradient.

    Args:
        tangential_collisions: collisions with friction.
        p: positions (n, 3) [m].
        out: gradient (n, 3) [N], updated.
    """
    for e in range(len(tangential_collisions.vertices)):
        u0, u1, u2, length = tangential_displacement(tangential_collisions, p, e)
        w = friction_stiffness(tangential_collisions.friction_limit[e], length, tangential_collisions.smoothing_length)
        for i in range(4):
            v, c = tangential_collisions.vertices[e, i], tangential_collisions.coefficients[e, i]
            out[v, 0] += c * (w * u0)
            out[v, 1] += c * (w * u1)
            out[v, 2] += c * (w * u2)


@jit_kernel
def write_friction_hessian(tangential_collisions, p, out):
    """Write the packed Hessian block of each collision.

    Args:
        tangential_collisions: collisions with friction.
        p: positions (n, 3) [m].
        out: blocks of `BLOCK_ENTRIES` numbers each, (90 g,) [N/m].
    """
    for e in range(len(tangential_collisions.vertices)):
        n, c, H = (
            tangential_collisions.normal[e],
            tangential_collisions.coefficients[e],
            out[BLOCK_ENTRIES * e : BLOCK_ENTRIES * (e + 1)],
        )
        u0, u1, u2, length = tangential_displacement(tangential_collisions, p, e)
        s = tangential_collisions.smoothing_length
        slip, stiffness = (
            slip_direction(u0, u1, u2, length, s),
            friction_stiffness(tangential_collisions.friction_limit[e], length, s),
        )
        for a in range(3):
            for b in range(3):
                same = 1.0 if a == b else 0.0
                h = stiffness * (same - n[a] * n[b] - slip[a] * slip[b])
                for i in range(4):
                    for j in range(i + 1):
                        H[row_offset(i, a) + 3 * j + b] = c[i] * c[j] * h


_NO_VECTORS = np.empty((0, 3))
NO_TANGENTIAL_COLLISIONS = TangentialCollisions(
    np.empty((0, 4), np.int64), np.empty((0, 4)), _NO_VECTORS, _NO_VECTORS, np.empty(0), 1.0
)
