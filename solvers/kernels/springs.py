"""The local step of springs, compiled: each vertex gathers from its own springs, so no two threads write to one place.

    out_i = y_i + sum over springs (i, j) of k r (p_i - p_j) / |p_i - p_j|

One pass, without A or d. A vertex adds in the order of its springs whatever the number of threads, so the bits
do not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from solvers.energies.springs import TINY, Springs
from solvers.problem import Positions

_TINY_SQUARED = TINY * TINY
# All of fastmath but what would let the compiler assume that there is no NaN and no infinity.
_FAST = {"contract", "reassoc", "nsz", "arcp"}


@dataclass(frozen=True, slots=True, eq=False)
class Incidence:
    """The springs at each vertex, in compressed rows.

    start: (n + 1,); neighbour: (2m,), the other end; stiffness: k (2m,) [N/m]; pull: k r (2m,) [N];
    direction: (2m, 3), from the neighbour to the vertex, taken at zero length.
    """

    start: NDArray[np.int64]
    neighbour: NDArray[np.int32]
    stiffness: NDArray[np.float64]
    pull: NDArray[np.float64]
    direction: NDArray[np.float64]

    @classmethod
    def of(cls, springs: Springs, n: int) -> Incidence:
        """The incidence of springs over n vertices; self-loops, which stretch nothing, are left out."""
        keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])
        i, j = springs.edges[keep].T
        rows, spring = np.concatenate([i, j]), np.concatenate([keep, keep])
        order = np.argsort(rows, kind="stable")
        sign = np.concatenate([np.ones(len(keep)), -np.ones(len(keep))])
        direction = sign[:, None] * springs.rest_direction[spring]
        k = springs.stiffness[spring]
        return cls(
            np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))]),
            np.concatenate([j, i])[order].astype(np.int32),
            np.ascontiguousarray(k[order]),
            np.ascontiguousarray((k * springs.rest_length[spring])[order]),
            np.ascontiguousarray(direction[order]),
        )

    def project(self, p: Positions, y: Positions, out: Positions) -> None:
        """The local step: write y + A'K d(p) [N], shape (n, 3), to `out`."""
        _project(p, y, self.start, self.neighbour, self.pull, self.direction, out)

    def energy_norm(self, e: Positions, inertia: NDArray[np.float64]) -> float:
        """|e|_Q [J^(1/2)] of a displacement (n, 3) [m] that vanishes at the pins; inertia: m/dt^2 (n,) [N/m]."""
        share = np.empty(len(e))
        _energy(e, inertia, self.start, self.neighbour, self.stiffness, share)
        return float(np.sqrt(share.sum()))


@njit(cache=True, parallel=True, fastmath=_FAST)
def _project(p, y, start, neighbour, pull, direction, out):
    for i in prange(len(p)):
        x0, x1, x2 = p[i, 0], p[i, 1], p[i, 2]
        s0, s1, s2 = y[i, 0], y[i, 1], y[i, 2]
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            v0, v1, v2 = x0 - p[j, 0], x1 - p[j, 1], x2 - p[j, 2]
            squared = v0 * v0 + v1 * v1 + v2 * v2
            if squared <= _TINY_SQUARED:
                v0, v1, v2, squared = direction[e, 0], direction[e, 1], direction[e, 2], 1.0
            scale = pull[e] / np.sqrt(squared)
            s0 += scale * v0
            s1 += scale * v1
            s2 += scale * v2
        out[i, 0], out[i, 1], out[i, 2] = s0, s1, s2


@njit(cache=True, parallel=True, fastmath=_FAST)
def _energy(e, inertia, start, neighbour, stiffness, share):
    for i in prange(len(e)):
        total = inertia[i] * (e[i, 0] ** 2 + e[i, 1] ** 2 + e[i, 2] ** 2)
        for s in range(start[i], start[i + 1]):
            j = neighbour[s]
            v0, v1, v2 = e[i, 0] - e[j, 0], e[i, 1] - e[j, 1], e[i, 2] - e[j, 2]
            total += 0.5 * stiffness[s] * (v0 * v0 + v1 * v1 + v2 * v2)
        share[i] = total
