"""Products of the Hessian of springs with vectors, in packets of eight vertices.

    (H x)_i = h_i x_i + sum over springs (i, j) of (m m' + t/l I) (x_i - x_j),   m = sqrt(k - t/l) n

Each spring is linearised once (`springbench.solvers.kernels.spring_hessian.linearise_springs`) for many products.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.kernels.spring_local_step import SpringPackets
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.simd.spring_packets import LANES
from springbench.solvers.simd.spring_products import LINEAR_STRIDE, write_spring_products


class HessianPackets(NamedTuple):
    """The Hessian in packets of the vertices that move.

    Attributes:
        spring_packets: packets of the springs.
        padding_offset: offset of the row n + 1, at which padding springs end.
        diagonal: stiffness of inertia and pins in each lane (8 b,) [N/m].
        linear: linearised springs of each entry, zero in padding lanes.
    """

    spring_packets: SpringPackets
    padding_offset: int
    diagonal: NDArray[np.float64]
    linear: NDArray[np.float64]

    @classmethod
    def from_springs(cls, springs: Springs, anchor_stiffness: NDArray[np.float64]) -> HessianPackets:
        """Build the packets.

        Args:
            springs: the springs.
            anchor_stiffness: stiffness of inertia and pins (n,) [N/m], infinite at fixed vertices.
        """
        n, part = len(anchor_stiffness), np.where(np.isinf(anchor_stiffness), -1, 0)
        packets, _ = SpringPackets.from_springs(springs, np.arange(n), part, 1, n, n + 1)
        linear = allocate_aligned(LINEAR_STRIDE * len(packets.weight_offset))
        return cls(packets, 4 * (n + 1), packets.gather_lanes(np.append(anchor_stiffness, 0.0)), linear)


@jit_inner
def fill_linear_springs(hessian, linear):
    """Write the linearised springs to the entries.

    Args:
        hessian: the Hessian in packets, whose linearised springs are overwritten.
        linear: the springs as `linearise_springs` writes them (m, 4).
    """
    packets = hessian.spring_packets
    for e in range(len(packets.spring_index)):
        if packets.neighbour_offset[e] != hessian.padding_offset:
            spring, at = packets.spring_index[e], LINEAR_STRIDE * (e // LANES) + e % LANES
            spring = max(spring, ~spring)
            for k in range(4):
                hessian.linear[at + LANES * k] = linear[spring, k]


@jit_inner
def multiply_packets(hessian, x, out):
    """Write the product of the Hessian with x.

    Args:
        hessian: the Hessian in packets.
        x: (n + 2, 4) [m]; the last two rows and the last column are zero.
        out: output in the rows of vertices that move (n + 2, 4) [N].
    """
    packets = hessian.spring_packets
    for b in range(len(packets.packet_start) - 1):
        write_spring_products(packets, hessian.linear, hessian.diagonal, b, x, out)
