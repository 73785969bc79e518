"""Compiled extended position based dynamics: projection of all springs in order, and whole steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.model.energies.spring_energy import ZERO_LENGTH, Springs

_ZERO_LENGTH_SQUARED = ZERO_LENGTH * ZERO_LENGTH


class SpringConstraints(NamedTuple):
    """Springs in the order of their projection.

    Attributes:
        end_vertices: (m, 2).
        stiffness: k (m,) [N/m].
        rest_length: r (m,) [m].
        rest_direction: direction at zero length (m, 3).
    """

    end_vertices: NDArray[np.int32]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

    @classmethod
    def from_springs(cls, springs: Springs, order: NDArray[np.int64]) -> SpringConstraints:
        """Select springs in a given order.

        Args:
            springs: springs of the system.
            order: indices of the selected springs (m,).
        """
        fields = (springs.stiffness, springs.rest_length, springs.rest_direction)
        return cls(
            np.ascontiguousarray(springs.edges[order], np.int32), *(np.ascontiguousarray(x[order]) for x in fields)
        )


class PinMotion(NamedTuple):
    """The motion of the pins in a step.

    Attributes:
        pinned_vertices: (q,).
        pin_weight: (q,) [N/m], infinite for an exact pin.
        pin_start, pin_end: positions at the start and the end of the step (q, 3) [m].
    """

    pinned_vertices: NDArray[np.int64]
    pin_weight: NDArray[np.float64]
    pin_start: NDArray[np.float64]
    pin_end: NDArray[np.float64]


@jit_inner
def _project_constraints(constraints, ease, compliance, tension, p):
    """Project all springs once.

    After its projection a spring has the force k (|p_i - p_j| - r); `tension` accumulates it if given.
    """
    ends, stiffness, rest_length, rest_direction = constraints
    for e in range(len(stiffness)):
        i, j = ends[e]
        v0, v1, v2 = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        squared = v0 * v0 + v1 * v1 + v2 * v2
        if squared <= _ZERO_LENGTH_SQUARED:
            length = 0.0
            v0, v1, v2 = rest_direction[e]
        else:
            length = np.sqrt(squared)
            scale = 1.0 / length
            v0, v1, v2 = scale * v0, scale * v1, scale * v2
        force = stiffness[e] * (length - rest_length[e])
        if tension is None:
            change = ease[e] * force
        else:
            change = ease[e] * (force - tension[e])
            tension[e] += change
        a, b = compliance[i] * change, compliance[j] * change
        p[i, 0], p[i, 1], p[i, 2] = p[i, 0] - a * v0, p[i, 1] - a * v1, p[i, 2] - a * v2
        p[j, 0], p[j, 1], p[j, 2] = p[j, 0] + b * v0, p[j, 1] + b * v1, p[j, 2] + b * v2


@jit_kernel
def run_projections(constraints, ease, compliance, tension, p, iterations):
    """Run n passes from p (n, 3) [m], which is overwritten with the result.

    Args:
        constraints: the springs.
        ease: 1/(1 + k (1/h_i + 1/h_j)) (m,).
        compliance: 1/h (n,) [m/N], with the stiffness h of inertia and pins.
        tension: tension of each spring (m,) [N], zero at the start of a step and accumulated over the passes.
        p: positions (n, 3) [m].
        iterations: number of passes.
    """
    for _ in range(iterations):
        _project_constraints(constraints, ease, compliance, tension, p)


@jit_kernel
def run_substeps(constraints, ease, compliance, pinned, force, before, p, v, h, count):
    """Run `count` steps of size h with one pass each.

    The arrays p and v are overwritten with the result.

    Args:
        constraints, ease, compliance: as for `run_projections`, for steps of size h.
        pinned: motion of the pins.
        force: (n, 3) [N].
        before: scratch like p.
        p: positions (n, 3) [m].
        v: velocities (n, 3) [m/s].
        h: step size [s].
        count: number of steps.
    """
    vertices, weight, begin, end = pinned
    for step in range(1, count + 1):
        for i in range(len(p)):
            for c in range(3):
                before[i, c] = p[i, c]
                p[i, c] += h * v[i, c] + compliance[i] * force[i, c]
        left = (count - step) / count
        for q in range(len(vertices)):
            i = vertices[q]
            for c in range(3):
                target = end[q, c] + left * (begin[q, c] - end[q, c])
                if weight[q] == np.inf:
                    p[i, c] = target
                else:
                    # Displacement from the inertial motion, without the force that was added above.
                    away = target - before[i, c] - h * v[i, c]
                    p[i, c] += compliance[i] * weight[q] * away
        _project_constraints(constraints, ease, compliance, None, p)
        for i in range(len(p)):
            for c in range(3):
                v[i, c] = (p[i, c] - before[i, c]) / h
