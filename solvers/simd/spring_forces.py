"""Forces of the springs of eight vertices, and their norm, in explicit LLVM vectors.

The lanes are those of `springbench.solvers.simd.spring_packets`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from springbench.solvers.simd.edge_packets import EdgeBuilder
from springbench.solvers.simd.llvm_vectors import I64, unpack_arguments
from springbench.solvers.simd.spring_packets import (
    LANES,
    MAX_SQUARED_LENGTH,
    PACKET_TYPE,
    PacketBuilder,
    SpringPacket,
    constant_packet,
)


def _spring_force_code(subtract_position: bool) -> Callable[..., Any]:
    """Return the code that adds a packet's forces to rows of `out`.

    The code returns whether a spring is too short; if one is, it adds nothing. subtract_position: whether to add the
    negative gradient; if not, the constant right-hand side and the spring projections are added.
    """

    def declare(typingctx: Any, packets: Any, number: Any, x: Any, right: Any, out: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            packets, number, x, right, out = unpack_arguments(context, builder, signature, args)
            v, springs = PacketBuilder(context, builder), SpringPacket.from_packets(builder, packets, number)
            places = v.load_row_offsets(springs.row_offset, number)
            centre = v.gather_rows(x, places)
            v.prefetch_ahead(springs, places, right, out)
            sums, short = _sum_spring_forces(v, springs, x, centre, subtract_position)
            with builder.if_then(builder.not_(short), likely=True):
                *constants, anchor_stiffness = v.load_right_hand_side(right, number)
                total = [builder.fadd(a, b) for a, b in zip(sums, constants, strict=True)]
                if subtract_position:
                    total = [v.subtract_product(a, anchor_stiffness, b) for a, b in zip(total, centre, strict=True)]
                places = v.load_row_offsets(springs.row_offset, number)  # again: they would not stay in registers
                for place, row in zip(places, v.transpose_to_rows(total, out.type.pointee), strict=True):
                    v.add_row(builder.gep(out, [place]), row)
            return short

        return types.boolean(packets, number, x, right, out), generate

    return declare


def _sum_spring_forces(
    v: PacketBuilder, springs: SpringPacket, x: Any, centre: list[Any], correct: bool
) -> tuple[list[Any], Any]:
    """Return the sums of a packet's springs, and whether a spring is too short.

    The terms are (k r/|v| - k) v if `correct`, else k r/|v| v.
    """
    builder: Any = v.builder
    sums, shortest = v.allocate_sums(3), cgutils.alloca_once_value(builder, constant_packet(MAX_SQUARED_LENGTH))
    if springs.edges is not None:
        _add_springs_with_edges(v, springs, x, centre, correct, sums, shortest)
        return [builder.load(total) for total in sums], v.has_short_spring(shortest)

    def read(entry: Any) -> list[Any]:
        """Load the data of an entry's springs.

        They are k r, k, the squared length of the vector from the other ends of the springs, and the vector.
        """
        arrow = v.compute_spring_vectors(x, centre, springs.neighbour_offset, entry)
        return [*v.load_packets(springs.weights, springs.weight_offset, entry), v.squared_norm(arrow), *arrow]

    def scale(values: list[Any]) -> list[Any]:
        """Return the factor of the vectors, as an estimate and its correction terms."""
        pull, stiffness, squared, *arrow = values
        v.update_minimum(squared, shortest)
        y, e = v.estimate_inverse_sqrt(squared)
        guess = builder.fmul(pull, y)
        more = builder.fmul(guess, e)
        return [builder.fsub(guess, stiffness) if correct else guess, more, e, *arrow]

    def add(values: list[Any]) -> None:
        """Add an entry's springs to the sums."""
        guess, more, e, *arrow = values
        v.add_products([v.multiply_add(more, v.inverse_sqrt_correction(e), guess)] * 3, arrow, sums)

    v.pipeline_entries(springs.first_entry, springs.end_entry, read, scale, add)
    return [builder.load(total) for total in sums], v.has_short_spring(shortest)


def _add_springs_with_edges(
    v: PacketBuilder,
    springs: SpringPacket,
    x: Any,
    centre: list[Any],
    correct: bool,
    sums: list[Any],
    shortest: Any,
) -> None:
    """Add a packet's springs and edges to the sums, in a pipeline of two stages."""
    builder, edges = v.builder, EdgeBuilder(v, springs.edges, springs.packet_index)

    def read(entry: Any) -> list[Any]:
        arrow = v.compute_spring_vectors(x, centre, springs.neighbour_offset, entry)
        return [*v.load_packets(springs.weights, springs.weight_offset, entry), entry, v.squared_norm(arrow), *arrow]

    def add(values: list[Any]) -> None:
        pull, stiffness, entry, squared, *arrow = values
        v.update_minimum(squared, shortest)
        root = v.inverse_sqrt(squared)
        scale = builder.fmul(pull, root)
        if correct:
            scale = builder.fsub(scale, stiffness)
        scale = edges.subtract_forces(entry, arrow, squared, root, scale, sums, correct=correct)
        v.add_products([scale] * 3, arrow, sums)

    v.pipeline_entries(springs.first_entry, springs.end_entry, read, add)


def _spring_norm_code(typingctx: Any, packets: Any, number: Any, x: Any, measure: Any) -> Any:
    """Return a packet's share of the squared norm of x.

    This is half the sum of its springs' terms, plus `measure` times squared positions.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        packets, number, x, measure = unpack_arguments(context, builder, signature, args)
        v, springs = PacketBuilder(context, builder), SpringPacket.from_packets(builder, packets, number)
        centre, (total,) = v.gather_rows(x, v.load_row_offsets(springs.row_offset, number)), v.allocate_sums(1)

        def read(entry: Any) -> list[Any]:
            arrow = v.compute_spring_vectors(x, centre, springs.neighbour_offset, entry)
            return [v.load_packets(springs.weights, springs.weight_offset, entry)[1], v.squared_norm(arrow)]

        def add(values: list[Any]) -> None:
            v.add_products(values[:1], values[1:], [total])

        v.pipeline_entries(springs.first_entry, springs.end_entry, read, add)
        diagonal = v.load(builder.gep(measure, [builder.mul(number, I64(LANES))]), PACKET_TYPE)
        return v.sum_lanes(
            v.multiply_add(v.squared_norm(centre), diagonal, builder.fmul(constant_packet(0.5), builder.load(total)))
        )

    return types.float64(packets, number, x, measure), generate


# Numba passes the first argument itself, which type checkers cannot see.
add_spring_projection: Any = intrinsic(_spring_force_code(subtract_position=False))
add_spring_forces: Any = intrinsic(_spring_force_code(subtract_position=True))
spring_squared_norm: Any = intrinsic(_spring_norm_code)
