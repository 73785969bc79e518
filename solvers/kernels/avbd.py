"""The dual step of augmented vertex block descent, compiled: tensions and stiffnesses after each sweep.

    t <- k (l - clip(l, low - t/k, high - t/k)),     k <- min(k + ramp |l - clip(l, low, high)|, most)

Where an edge is within its limits t is zero, and k stays.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel


class Duals(NamedTuple):
    """What is renewed after sweeps, of each edge (m,): low, high [m]: its limits in this step; exact: whether it has a
    tension, else `most` is the stiffness that it has in truth; ramp: by how much its stiffness [N/m] grows for a metre
    that it is off; most: the largest stiffness [N/m], firmest: the largest tension [N]; stiffness [N/m], tension [N]:
    what it has, renewed; base (rows,): the majorant of all else, bound (rows,): with that of the edges, scratch."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    exact: NDArray[np.bool_]
    ramp: NDArray[np.float64]
    most: NDArray[np.float64]
    firmest: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    tension: NDArray[np.float64]
    base: NDArray[np.float64]
    bound: NDArray[np.float64]


@inner
def _clipped(x, low, high):
    return min(max(x, low), high)


@kernel
def place(blocks, hard, duals, p):
    """Write the edges' stiffnesses and moved limits to the numbers of `hard`, the edges by rows, and the majorant of
    the vertices at p to the lanes: where an edge pulls by t, no step across it rises by more than t/l says."""
    for row in range(len(duals.base)):
        duals.bound[row] = duals.base[row]
    for e in range(len(duals.low)):
        k, t = duals.stiffness[e], duals.tension[e]
        hard.numbers[e, 0], hard.numbers[e, 1], hard.numbers[e, 2] = k, duals.low[e] - t / k, duals.high[e] - t / k
        i, j = hard.rows[e, 0], hard.rows[e, 1]
        if i != j:
            share = k + max(t, 0.0) / max(_length(hard, e, p), 0.01 * duals.high[e])
            duals.bound[i] += share
            duals.bound[j] += share
    for lane in range(len(blocks.majorant)):
        blocks.majorant[lane] = duals.bound[blocks.bundles.own[lane] // 4]


@inner
def _length(hard, e, p):
    i, j = 4 * hard.rows[e, 0], 4 * hard.rows[e, 1]
    return np.sqrt((p[i] - p[j]) ** 2 + (p[i + 1] - p[j + 1]) ** 2 + (p[i + 2] - p[j + 2]) ** 2)


@inner
def _renew(hard, duals, p):
    """The dual step at p."""
    for e in range(len(duals.low)):
        k, length = duals.stiffness[e], _length(hard, e, p)
        force = k * (length - _clipped(length, hard.numbers[e, 1], hard.numbers[e, 2]))
        if duals.exact[e]:
            duals.tension[e] = _clipped(force, -duals.firmest[e], duals.firmest[e])
        if force != 0.0:
            off = abs(length - _clipped(length, duals.low[e], duals.high[e]))
            duals.stiffness[e] = min(k + duals.ramp[e] * off, duals.most[e])


@cache
def augmenting(sweeps: Any) -> Any:
    """The iteration over a kernel of sweeps, `solvers.kernels.vbd.iterate` or one for elements."""

    @kernel
    def iterate(blocks, spaces, beside, right, work, p, iterations, hard, duals):
        """That many times a sweep from p, which takes the result, and a dual step; the edges are placed."""
        for _ in range(iterations):
            sweeps(blocks, spaces, beside, right, 0.0, work, p, 1)
            _renew(hard, duals, p)
            place(blocks, hard, duals, p)

    return iterate
