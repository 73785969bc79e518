"""Kernels of XPBD: positions without springs, their initialisation, and the projection of springs.

    D = x_i - x_j,   w = u_i - u_j,   v = D + w,   |v| - r = (|D| - r) + (D + v).w / (|D| + |v|)

x, the positions without springs, and |D| - r are float64. The displacement u from there has the kernels' type: the
error of float32 is relative to u and to the distance of a spring from its rest length. The factor `ease` of
`xpbd_projection` is computed where it is used.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from springbench.solvers.cuda.cuda_target import cuda
from springbench.solvers.cuda.device_springs import MIN_SQUARED_LENGTH

RealType = type[np.float32] | type[np.float64]


class XpbdKernels(NamedTuple):
    """Kernels for one precision."""

    write_anchors: Any
    write_compliance: Any
    linearise_constraints: Any
    project_colour: Any


@cache
def build_xpbd_kernels(real: RealType) -> XpbdKernels:
    """Build the kernels that compute in `real`."""
    zero, one, short = real(0.0), real(1.0), real(MIN_SQUARED_LENGTH[real])

    @cuda.jit
    def write_anchors(places, target, force, pins, x, u, compliance):
        """Write the positions without springs, y/q, to x; set u to 0."""
        i = cuda.grid(1)
        while i < x.shape[0]:
            anchor_stiffness, w, q = places.anchor_stiffness[i], places.pin_weight[i], places.pin_indices[i]
            for c in range(3):
                away = force[i, c]
                if q >= 0 and not math.isinf(w):
                    away += w * (pins[q, c] - target[i, c])
                x[i, c] = pins[q, c] if math.isinf(w) else target[i, c] + away / anchor_stiffness
                u[i, c] = zero
            compliance[i] = real(1.0 / anchor_stiffness)
            i += cuda.gridsize(1)

    @cuda.jit
    def write_compliance(places, h, u, compliance, gives):
        """Write 1/q for a step of h [s], and set u to 0.

        1/q is written in `real` and in float64.
        """
        i = cuda.grid(1)
        while i < gives.shape[0]:
            gives[i] = 1.0 / (places.mass[i] / (h * h) + places.pin_weight[i])
            compliance[i] = real(gives[i])
            for c in range(4):
                u[i, c] = zero
            i += cuda.gridsize(1)

    @cuda.jit
    def linearise_constraints(x, count, springs):
        """Write D and |D| - r of `count` springs, and zero tensions."""
        e = cuda.grid(1)
        while e < count:
            i, j = springs.ends[e, 0], springs.ends[e, 1]
            v0, v1, v2 = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
            length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            springs.reference_vectors[0, e], springs.reference_vectors[1, e], springs.reference_vectors[2, e] = (
                real(v0),
                real(v1),
                real(v2),
            )
            springs.reference_vectors[3, e] = real(length - springs.rest_length[e])
            springs.spring_tensions[e] = zero
            e += cuda.gridsize(1)

    @cuda.jit
    def project_colour(begin, end, springs, compliance, u):
        """Project the springs from `begin` to `end`, all of one colour, by moving both ends."""
        e = begin + cuda.grid(1)
        while e < end:
            i, j = springs.ends[e, 0], springs.ends[e, 1]
            d0, d1, d2 = (
                springs.reference_vectors[0, e],
                springs.reference_vectors[1, e],
                springs.reference_vectors[2, e],
            )
            w0, w1, w2 = u[i, 0] - u[j, 0], u[i, 1] - u[j, 1], u[i, 2] - u[j, 2]
            v0, v1, v2 = d0 + w0, d1 + w1, d2 + w2
            squared = v0 * v0 + v1 * v1 + v2 * v2
            if squared <= short:
                stretch = -real(springs.rest_length[e])
                v0, v1 = real(springs.rest_direction[e, 0]), real(springs.rest_direction[e, 1])
                v2 = real(springs.rest_direction[e, 2])
            else:
                length = real(math.sqrt(squared))
                both = length + real(math.sqrt(d0 * d0 + d1 * d1 + d2 * d2))
                stretch = springs.reference_vectors[3, e] + ((d0 + v0) * w0 + (d1 + v1) * w1 + (d2 + v2) * w2) / both
                scale = one / length
                v0, v1, v2 = scale * v0, scale * v1, scale * v2
            k, gives, takes = springs.stiffness[e], compliance[i], compliance[j]
            change = (k * stretch - springs.spring_tensions[e]) / (one + k * (gives + takes))
            springs.spring_tensions[e] += change
            a, b = gives * change, takes * change
            u[i, 0], u[i, 1], u[i, 2] = u[i, 0] - a * v0, u[i, 1] - a * v1, u[i, 2] - a * v2
            u[j, 0], u[j, 1], u[j, 2] = u[j, 0] + b * v0, u[j, 1] + b * v1, u[j, 2] + b * v2
            e += cuda.gridsize(1)

    return XpbdKernels(write_anchors, write_compliance, linearise_constraints, project_colour)


@cuda.jit
def write_device_positions(x, u, out):
    """Write x + u to `out`.

    Args:
        x: positions without springs (n, 3) [m], float64.
        u: displacement (n, 4) [m], in the type of the kernels; column 3 is padding.
        out: positions (n, 3) [m].
    """
    i = cuda.grid(1)
    while i < x.shape[0]:
        for c in range(3):
            out[i, c] = x[i, c] + np.float64(u[i, c])
        i += cuda.gridsize(1)


@cuda.jit
def predict_step(
    h, remaining_fraction, vertex_data, start_positions, pin_targets, vertex_compliance, force, v, before, x, u
):
    """Write the positions of a substep without springs to x, and set u to 0.

    Args:
        h: substep [s].
        remaining_fraction: part of the step after this substep.
        vertex_data: pins of the vertices.
        start_positions: (n, 3) [m], where pins start.
        pin_targets: (q, 3) [m], where pins end.
        vertex_compliance: inverse stiffness of inertia and pin of each vertex (n,) [m/N].
        force: constant force (n, 3) [N].
        v: velocities (n, 3) [m/s].
        before: receives the positions at the start of the substep (n, 3) [m].
        x: positions (n, 3) [m], overwritten by the prediction.
        u: displacement from x (n, 3) [m], set to 0.
    """
    i = cuda.grid(1)
    while i < x.shape[0]:
        q, w = vertex_data.pin_indices[i], vertex_data.pin_weight[i]
        for c in range(3):
            here = x[i, c]
            before[i, c], u[i, c] = here, 0.0
            there = here + h * v[i, c] + vertex_compliance[i] * force[i, c]
            if q >= 0:
                target = pin_targets[q, c] + remaining_fraction * (start_positions[i, c] - pin_targets[q, c])
                if math.isinf(w):
                    there = target
                else:
                    # Displacement from the inertial motion, without the force that was added above.
                    there += vertex_compliance[i] * w * (target - here - h * v[i, c])
            x[i, c] = there
        i += cuda.gridsize(1)


@cuda.jit
def finish_substep(h, before, x, u, v):
    """Finish a substep: it ends at x + u, which determines the velocity.

    Args:
        h: substep [s].
        before: positions at the start of the substep (n, 3) [m].
        x: positions without springs (n, 3) [m], overwritten with those at the end.
        u: displacement (n, 4) [m], set to zero; column 3 is padding.
        v: velocity (n, 3) [m/s], overwritten.
    """
    i = cuda.grid(1)
    while i < x.shape[0]:
        for c in range(3):
            there = x[i, c] + np.float64(u[i, c])
            v[i, c] = (there - before[i, c]) / h
            x[i, c], u[i, c] = there, 0.0
        i += cuda.gridsize(1)
