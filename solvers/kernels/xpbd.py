"""Extended position based dynamics, compiled: all springs one after another, and whole steps of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.energies.springs import TINY, Springs

_TINY_SQUARED = TINY * TINY


class Constraints(NamedTuple):
    """Springs in the order in which they are gone through.

    ends (m, 2); stiffness: k (m,) [N/m]; rest_length: r (m,) [m]; rest_direction: (m, 3), taken at zero length.
    """

    ends: NDArray[np.int32]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

    @classmethod
    def of(cls, springs: Springs, order: NDArray[np.int64]) -> Constraints:
        """The springs named in `order`."""
        fields = (springs.stiffness, springs.rest_length, springs.rest_direction)
        return cls(
            np.ascontiguousarray(springs.edges[order], np.int32), *(np.ascontiguousarray(x[order]) for x in fields)
        )


class Pinned(NamedTuple):
    """Pins in a step: vertices (q,), their weight (q,) [N/m], infinite for an exact one, and where they move from and
    to, (q, 3) [m]."""

    vertices: NDArray[np.int64]
    weight: NDArray[np.float64]
    begin: NDArray[np.float64]
    end: NDArray[np.float64]


@inner
def _project(constraints, ease, compliance, tension, p):
    """One pass: each spring's ends go to where its force, which is kept in `tension` where that is given, is
    k (|p_i - p_j| - r)."""
    ends, stiffness, rest_length, rest_direction = constraints
    for e in range(len(stiffness)):
        i, j = ends[e]
        v0, v1, v2 = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        squared = v0 * v0 + v1 * v1 + v2 * v2
        if squared <= _TINY_SQUARED:
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


@kernel
def iterate(constraints, ease, compliance, tension, p, iterations):
    """That many passes from p (n, 3) [m], which takes the result.

    compliance: 1/held (n,) [m/N]; ease: 1/(1 + k (1/held_i + 1/held_j)) (m,); tension (m,) [N]: of each spring, zero
    where a step begins, and kept from one pass to the next.
    """
    for _ in range(iterations):
        _project(constraints, ease, compliance, tension, p)


@kernel
def substeps(constraints, ease, compliance, pinned, force, before, p, v, h, count):
    """`count` steps of h [s], each with one pass, from p (n, 3) [m] and v (n, 3) [m/s], which take the result.

    force: (n, 3) [N]; before: scratch like p; the others as in `iterate`, for steps of h.
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
                    # What inertia alone would lead to, without the force that was added above.
                    away = target - before[i, c] - h * v[i, c]
                    p[i, c] += compliance[i] * weight[q] * away
        _project(constraints, ease, compliance, None, p)
        for i in range(len(p)):
            for c in range(3):
                v[i, c] = (p[i, c] - before[i, c]) / h
