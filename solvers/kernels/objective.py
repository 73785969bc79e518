"""The gradient of the objective and its change between two points, in one pass over springs and one over vertices.

    grad g = sum_e k_e (1 - r_e/l_e) v_e + h (p - target) - f + w (p - pin)              h = c m/dt^2
    g(q) - g(p) = sum_e k_e/2 (l'_e - l_e) (l'_e + l_e - 2 r_e) + ...,   l' - l = (v' - v)(v' + v) / (l' + l)

The change is a sum of differences without cancellation, not the difference of two sums. It distinguishes descent from
round-off as long as the gradient does, long after the values of the energies agree in all digits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.energies.springs import TINY, Springs
from solvers.problem import Positions, StepProblem, System
from solvers.round_off import EPS


class Terms(NamedTuple):
    """The constant data of a run: springs, inertia h (n,) [N/m], penalty pins and their weights [N/m]."""

    edges: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    direction: NDArray[np.float64]
    inertia: NDArray[np.float64]
    pinned: NDArray[np.int64]
    weight: NDArray[np.float64]

    @classmethod
    def of(cls, system: System, springs: Springs) -> Terms:
        """Copy the terms of a system into arrays."""
        _, pinned, weight = system.penalty
        s = springs
        arrays: list[Any] = [s.edges, s.stiffness, s.rest_length, s.rest_direction, system.inertia, pinned, weight]
        return cls(*(np.array(a, order="C") for a in arrays))


class Given(NamedTuple):
    """The data of a step: target (n, 3) [m], force (n, 3) [N], the penalty pins' targets (q, 3) [m]."""

    target: Positions
    force: Positions
    pins: Positions

    @classmethod
    def of(cls, problem: StepProblem) -> Given:
        """Copy a step's arrays; the kernels are compiled for writable arrays."""
        soft, _, _ = problem.system.penalty
        return cls(*(np.array(a, order="C") for a in (problem.target, problem.force, problem.pin_targets[soft])))


@inner
def along(terms, e, p):
    """Return the unit direction of spring e and its length [m]; at zero length that of the rest shape."""
    i, j = terms.edges[e, 0], terms.edges[e, 1]
    v0, v1, v2 = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
    length = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    if length <= TINY:
        return terms.direction[e, 0], terms.direction[e, 1], terms.direction[e, 2], 0.0
    return v0 / length, v1 / length, v2 / length, length


@kernel
def gradient(terms, given, p, out):
    """Write the gradient [N] at p, both (n, 3), of springs, inertia, force and penalty pins to `out`."""
    for v in range(len(p)):
        for c in range(3):
            out[v, c] = terms.inertia[v] * (p[v, c] - given.target[v, c]) - given.force[v, c]
    for q in range(len(terms.pinned)):
        v = terms.pinned[q]
        for c in range(3):
            out[v, c] += terms.weight[q] * (p[v, c] - given.pins[q, c])
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        if i == j:
            continue
        n0, n1, n2, length = along(terms, e, p)
        tension = terms.stiffness[e] * (length - terms.rest_length[e])
        out[i, 0] += tension * n0
        out[i, 1] += tension * n1
        out[i, 2] += tension * n2
        out[j, 0] -= tension * n0
        out[j, 1] -= tension * n1
        out[j, 2] -= tension * n2


@kernel
def round_off(terms, given, p, out):
    """Write the bound (n,) [N] of the rounding error of `gradient` at p (n, 3) [m] to `out`.

    It is that of `solvers.round_off` for springs, inertia, force and penalty pins.
    """
    for v in range(len(p)):
        out[v] = terms.inertia[v] * (size(p, v) + size(given.target, v)) + size(given.force, v)
    for q in range(len(terms.pinned)):
        out[terms.pinned[q]] += terms.weight[q] * (size(p, terms.pinned[q]) + size(given.pins, q))
    for e in range(len(terms.stiffness)):
        i, j, rest = terms.edges[e, 0], terms.edges[e, 1], terms.rest_length[e]
        if i == j:
            continue
        _, _, _, length = along(terms, e, p)
        reach = size(p, i) + size(p, j)
        turned = reach + 2.0 * rest / EPS
        if length > 0.0:
            turned = min(max(1.0, rest / length - 1.0) * reach, turned)
        share = terms.stiffness[e] * (turned + length + rest)
        out[i] += share
        out[j] += share
    for v in range(len(p)):
        out[v] *= EPS


@inner
def size(x, v):
    """Return the norm of row v of x (n, 3)."""
    return np.sqrt(x[v, 0] * x[v, 0] + x[v, 1] * x[v, 1] + x[v, 2] * x[v, 2])


@kernel
def rise(terms, given, p, q):
    """Return g(q) - g(p) [J] of springs, inertia, force and penalty pins, p and q (n, 3)."""
    total = 0.0
    for v in range(len(p)):
        for c in range(3):
            middle = 0.5 * (p[v, c] + q[v, c])
            total += (q[v, c] - p[v, c]) * (terms.inertia[v] * (middle - given.target[v, c]) - given.force[v, c])
    for k in range(len(terms.pinned)):
        v = terms.pinned[k]
        for c in range(3):
            middle = 0.5 * (p[v, c] + q[v, c])
            total += terms.weight[k] * (q[v, c] - p[v, c]) * (middle - given.pins[k, c])
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        before = after = change = 0.0
        for c in range(3):
            v = p[i, c] - p[j, c]
            s = (q[i, c] - p[i, c]) - (q[j, c] - p[j, c])
            before += v * v
            after += (v + s) * (v + s)
            change += s * (2.0 * v + s)
        before, after = np.sqrt(before), np.sqrt(after)
        if before + after > TINY:
            both = before + after
            total += terms.stiffness[e] * (change / both) * (0.5 * both - terms.rest_length[e])
    return total
