"""The compiled dual step of augmented vertex block descent: tensions and stiffnesses after each sweep.

    t <- k (l - clip(l, low - t/k, high - t/k)),     k <- min(k + ramp |l - clip(l, low, high)|, most)

For an edge within its limits t is zero, and k does not change.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel


class Duals(NamedTuple):
    """The dual variables and parameters of each edge (m,), updated after sweeps.

    Attributes:
        low, high: minimum and maximum length in this step [m].
        exact: whether the edge has a tension; otherwise `most` is its physical stiffness.
        ramp: increase of the stiffness [N/m] per metre of constraint violation.
        most: maximum stiffness [N/m].
        firmest: maximum tension [N].
        stiffness: current stiffness [N/m].
        tension: current tension [N].
        base: majorant of all other energies (rows,).
        bound: scratch for the majorant with the edges (rows,).
    """

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
    """Write the edges' stiffnesses and shifted limits to their parameters, and the vertex majorants to the lanes.

    If an edge pulls with t, the stiffness of a transverse step is at most t/l.
    """
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
    """Do the dual step at p."""
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
    """Build the iteration over a kernel of sweeps, `vbd_sweeps.iterate` or one for elements."""

    @kernel
    def iterate(blocks, spaces, beside, right, work, p, iterations, hard, duals):
        """Run n sweeps from p, which is overwritten, each with a dual step; edge parameters must be current."""
        for _ in range(iterations):
            sweeps(blocks, spaces, beside, right, 0.0, work, p, 1)
            _renew(hard, duals, p)
            place(blocks, hard, duals, p)

    return iterate
