"""Objective of eight vertices and their springs, and its negative gradient, in explicit LLVM vectors.

The formula is that of `springbench.solvers.kernels.spring_objective`, the lanes are those of
`springbench.solvers.simd.spring_packets`.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from springbench.solvers.simd.edge_packets import EdgeBuilder
from springbench.solvers.simd.llvm_vectors import F64, I64, unpack_arguments
from springbench.solvers.simd.spring_packets import (
    LANES,
    MAX_SQUARED_LENGTH,
    PACKET_TYPE,
    PacketBuilder,
    SpringPacket,
    constant_packet,
)

SHORT_SPRING = float("-inf")
"""Result in place of an energy. An energy itself may be negative, because forms have pairs of negative stiffness."""


def _spring_gradient_code(typingctx: Any, packets: Any, shares: Any, number: Any, x: Any, right: Any, out: Any) -> Any:
    """Write a packet's rows of `out` and return its energy.

    If a spring is too short, nothing is written and SHORT_SPRING is returned.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        packets, shares, number, x, right, out = unpack_arguments(context, builder, signature, args)
        v, springs = PacketBuilder(context, builder), SpringPacket.from_packets(builder, packets, number)
        centre = v.gather_rows(x, v.load_row_offsets(springs.row_offset, number))
        edges = None if springs.edges is None else EdgeBuilder(v, springs.edges, number)
        sums, shortest = v.allocate_sums(4), cgutils.alloca_once_value(builder, constant_packet(MAX_SQUARED_LENGTH))

        def read(entry: Any) -> list[Any]:
            """Load the data of an entry's springs.

            They are the entry, k r, k, 1/(4 k), and the vector from the other ends of the springs.
            """
            numbers = [
                entry,
                *v.load_packets(springs.weights, springs.weight_offset, entry),
                *v.load_packets(shares.energy_weights, shares.weight_offset, entry, 1),
            ]
            return [*numbers, *v.compute_spring_vectors(x, centre, springs.neighbour_offset, entry)]

        def add(values: list[Any]) -> None:
            """Add an entry's springs to the sums."""
            entry, pull, k, share, *arrow = values
            squared = v.squared_norm(arrow)
            v.update_minimum(squared, shortest)
            root = v.inverse_sqrt(squared)
            scale = builder.fsub(builder.fmul(pull, root), k)
            energy = builder.fmul(builder.fmul(share, scale), scale)
            if edges is not None:
                v.add_products([energy], [squared], sums[3:])
                scale = edges.subtract_forces(entry, arrow, squared, root, scale, sums)
                v.add_products([scale] * 3, arrow, sums[:3])
                return
            v.add_products([scale] * 3 + [energy], [*arrow, squared], sums)

        v.pipeline_entries(springs.first_entry, springs.end_entry, read, add)
        *total, energy = [builder.load(accumulator) for accumulator in sums]
        short = v.has_short_spring(shortest)
        with builder.if_then(builder.not_(short), likely=True):
            *constants, anchor_stiffness = v.load_right_hand_side(right, number)
            away = [v.subtract_product(a, anchor_stiffness, b) for a, b in zip(constants, centre, strict=True)]
            half = v.load(builder.gep(shares.inverse_anchor, [builder.mul(number, I64(LANES))]), PACKET_TYPE)
            builder.store(v.multiply_add(half, v.squared_norm(away), energy), sums[3])
            total = [builder.fadd(a, b) for a, b in zip(total, away, strict=True)]
            for place, row in zip(
                v.load_row_offsets(springs.row_offset, number), v.transpose_to_rows(total), strict=True
            ):
                v.store(row, builder.gep(out, [place]))
        return builder.select(short, F64(SHORT_SPRING), v.sum_lanes(builder.load(sums[3])))

    return types.float64(packets, shares, number, x, right, out), generate


# Numba passes the first argument itself, which type checkers cannot see.
spring_energy_and_descent: Any = intrinsic(_spring_gradient_code)
