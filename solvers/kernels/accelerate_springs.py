"""The objective and minus its gradient in one pass over a factor's rows, in packets of eight vertices.

    b_i = y_i - h_i p_i + sum of s v over the springs (i, j),   s = k r / |v| - k,   v = p_i - p_j    minus the gradient
    g   = sum of s^2 |v|^2 / (2 k) + sum of |y_i - h_i p_i|^2 / (2 h_i)                          up to a constant

with h = c m/dt^2 + w and y = c M target/dt^2 + f + w C'C p_pin. All terms of g are squares, so that g is accurate to a
few units in the last place of its own value. A massless unpinned vertex (h = 0) adds -y_i p_i.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner
from solvers.kernels.springs import TINY_SQUARED, Bundles, add_short, kinds
from solvers.vectors import descent
from solvers.vectors.springs import LANES, RIGHT


class Shares(NamedTuple):
    """The data of the objective in addition to those of the gradient.

    Attributes:
        kind: of each packet entry, the position in `shares` of eight times 1/(4 k) [m/N], or 1/(2 k)
            if the other end is exactly pinned and so has no entry.
        shares: these numbers.
        inverse: 1/(2 h) [m/N] of each lane (8 b,), 0 if h is 0.
        massless: offsets of the rows with h = 0, and of their x in the right-hand side (., 2).
        size: sum of k r^2 [J].
    """

    kind: NDArray[np.int32]
    shares: NDArray[np.float64]
    inverse: NDArray[np.float64]
    massless: NDArray[np.int64]
    size: float

    @classmethod
    def of(cls, bundles: Bundles, held: NDArray[np.float64], pinned: NDArray[np.int64]) -> Shares:
        """Build the weights of springs in packets, of which the rows `pinned` do not move."""
        pull, k = bundles.each()
        parts = np.where(np.isin(bundles.neighbour, 4 * pinned), 0.5, 0.25)
        share = np.divide(parts, k, out=np.zeros_like(k), where=k != 0.0)
        inverse = np.divide(0.5, held, out=np.zeros_like(held), where=held > 0.0)
        massless = np.unique(bundles.own[bundles.in_lanes(held) == 0.0])
        places = np.column_stack([massless, bundles.in_right(len(held))[massless // 4]])
        return cls(*kinds(share), bundles.in_lanes(inverse), places.astype(np.int64), 2.0 * float(share @ pull**2))


@inner
def descend(bundles, shares, p, right, out):
    """Write minus the gradient at p to the rows of `out`, and return the objective."""
    total = 0.0
    for b in range(len(bundles.start) - 1):
        energy = descent.descend(bundles, shares, b, p, right, out)
        if energy < 0.0:
            for lane in range(LANES):
                for c in range(4):
                    out[bundles.own[LANES * b + lane] + c] = 0.0
            add_short(bundles, b, p, right, out, True)
            energy = _short(bundles, shares, b, p, right)
        total += energy
    for k in range(len(shares.massless)):
        for c in range(3):
            total -= right[shares.massless[k, 1] + LANES * c] * p[shares.massless[k, 0] + c]
    return total


@inner
def _short(bundles, shares, b, p, right):
    """Return the energy of a packet with a spring of zero length."""
    total = 0.0
    for lane in range(LANES):
        i, at = bundles.own[LANES * b + lane], RIGHT * b + lane
        for c in range(3):
            away = right[at + LANES * c] - right[at + 3 * LANES] * p[i + c]
            total += shares.inverse[LANES * b + lane] * away**2
    for e in range(LANES * bundles.start[b], LANES * bundles.start[b + 1]):
        entry, lane = divmod(e, LANES)
        i, j, w = bundles.own[LANES * b + lane], bundles.neighbour[e], bundles.kind[entry] + lane
        squared = 0.0
        for c in range(3):
            squared += (p[i + c] - p[j + c]) ** 2
        length = 0.0 if squared <= TINY_SQUARED else np.sqrt(squared)
        total += (
            shares.shares[shares.kind[entry] + lane] * (bundles.weights[w] - bundles.weights[w + LANES] * length) ** 2
        )
    return total
