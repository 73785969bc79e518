"""The objective and minus its gradient, in packets of eight vertices.

Both are computed in one pass over a factor's rows:

    b_i = y_i - h_i p_i + sum of s v over the springs (i, j),   s = k r / |v| - k,   v = p_i - p_j    minus the gradient
    g   = sum of s^2 |v|^2 / (2 k) + sum of |y_i - h_i p_i|^2 / (2 h_i)                          up to a constant

with h = c m/dt^2 + w and y = c M target/dt^2 + f + w C'C p_pin. All terms of g are squares, so that g is accurate to a
few units in the last place of its own value. A massless unpinned vertex (h = 0) adds -y_i p_i.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.kernels.edge_elements import edge_energy
from springbench.solvers.kernels.packet_data import deduplicate_packets
from springbench.solvers.kernels.spring_local_step import (
    ZERO_LENGTH_SQUARED,
    SpringPackets,
    add_degenerate_packet,
)
from springbench.solvers.simd import spring_descent
from springbench.solvers.simd.spring_packets import LANES, RHS_STRIDE


class ObjectiveWeights(NamedTuple):
    """The data of the objective in addition to those of the gradient.

    Attributes:
        weight_offset: of each packet entry, the position in `energy_weights` of eight times 1/(4 k) [m/N], or 1/(2 k)
            if the other end is exactly pinned and so has no entry.
        energy_weights: these numbers.
        inverse_anchor: 1/(2 h) [m/N] of each lane (8 b,), 0 if h is 0.
        massless_rows: offsets of the rows with h = 0, and of their x in the right-hand side (., 2).
        energy_scale: sum of k r^2 [J].
    """

    weight_offset: NDArray[np.int32]
    energy_weights: NDArray[np.float64]
    inverse_anchor: NDArray[np.float64]
    massless_rows: NDArray[np.int64]
    energy_scale: float

    @classmethod
    def from_packets(
        cls, packets: SpringPackets, anchor_stiffness: NDArray[np.float64], pinned: NDArray[np.int64]
    ) -> ObjectiveWeights:
        """Build the weights of springs in packets.

        Args:
            packets: packets of the springs and edges.
            anchor_stiffness: anchor stiffness h of each row [N/m].
            pinned: rows of the exactly pinned vertices.
        """
        pull, k = packets.entry_weights()
        parts = np.where(np.isin(packets.neighbour_offset, 4 * pinned), 0.5, 0.25)
        share = np.divide(parts, k, out=np.zeros_like(k), where=k != 0.0)
        inverse = np.divide(0.5, anchor_stiffness, out=np.zeros_like(anchor_stiffness), where=anchor_stiffness > 0.0)
        massless = np.unique(packets.row_offset[packets.gather_lanes(anchor_stiffness) == 0.0])
        places = np.column_stack([massless, packets.right_hand_side_offset(len(anchor_stiffness))[massless // 4]])
        return cls(
            *deduplicate_packets(share),
            packets.gather_lanes(inverse),
            places.astype(np.int64),
            2.0 * float(share @ pull**2),
        )


@jit_inner
def value_and_descent(packets, shares, p, right, out):
    """Write minus the gradient and return the objective [J].

    Args:
        packets: packets of the springs and edges.
        shares: weights of the objective.
        p: positions in rows of four [m].
        right: right-hand side of the packets, with y and anchor stiffness.
        out: output in rows of four [N], overwritten in the rows of the packets.

    Returns:
        The objective, up to a constant of the step.
    """
    total = 0.0
    for b in range(len(packets.packet_start) - 1):
        energy = spring_descent.spring_energy_and_descent(packets, shares, b, p, right, out)
        if energy == spring_descent.SHORT_SPRING:
            for lane in range(LANES):
                for c in range(4):
                    out[packets.row_offset[LANES * b + lane] + c] = 0.0
            add_degenerate_packet(packets, b, p, right, out, True)
            energy = _degenerate_packet_energy(packets, shares, b, p, right)
        total += energy
    for k in range(len(shares.massless_rows)):
        for c in range(3):
            total -= right[shares.massless_rows[k, 1] + LANES * c] * p[shares.massless_rows[k, 0] + c]
    return total


@jit_inner
def _degenerate_packet_energy(packets, shares, b, p, right):
    """Return the energy of a packet with a spring of zero length."""
    total = 0.0
    for lane in range(LANES):
        i, at = packets.row_offset[LANES * b + lane], RHS_STRIDE * b + lane
        for c in range(3):
            away = right[at + LANES * c] - right[at + 3 * LANES] * p[i + c]
            total += shares.inverse_anchor[LANES * b + lane] * away**2
    for e in range(LANES * packets.packet_start[b], LANES * packets.packet_start[b + 1]):
        entry, lane = divmod(e, LANES)
        i, j, w = packets.row_offset[LANES * b + lane], packets.neighbour_offset[e], packets.weight_offset[entry] + lane
        squared = 0.0
        for c in range(3):
            squared += (p[i + c] - p[j + c]) ** 2
        length = 0.0 if squared <= ZERO_LENGTH_SQUARED else np.sqrt(squared)
        total += (
            shares.energy_weights[shares.weight_offset[entry] + lane]
            * (packets.weights[w] - packets.weights[w + LANES] * length) ** 2
        )
        total += edge_energy(packets.edges, entry, lane, p[i] - p[j], p[i + 1] - p[j + 1], p[i + 2] - p[j + 2])
    return total
