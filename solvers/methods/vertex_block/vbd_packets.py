"""Newton steps of eight vertices of one colour, in explicit LLVM vectors.

The layout is that of `springbench.solvers.simd.spring_packets`.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from springbench.solvers.simd.edge_packets import EdgeBuilder
from springbench.solvers.simd.llvm_vectors import I64, unpack_arguments
from springbench.solvers.simd.spring_packets import (
    LANES,
    MASK_TYPE,
    MIN_SQUARED_LENGTH,
    PACKET_TYPE,
    PacketBuilder,
    SpringPacket,
    constant_packet,
)

SPRING_SCRATCH_SIZE = 4
"""Numbers stored for each spring between the two passes: its vector and its length."""

PACKET_SCRATCH_SIZE = 3
"""Numbers stored for each vertex before those of its springs: the gradient of its dashpots."""

_PIVOT_ROUNDOFF = 1e-14
"""Pivots up to this fraction of the trace are round-off, with about ten springs per vertex."""

_ZERO, _HALF, _ONE = constant_packet(0.0), constant_packet(0.5), constant_packet(1.0)


def _solve_newton_system(v: PacketBuilder, block: list[Any], g: list[Any]) -> tuple[list[Any], Any]:
    """Return -B^-1 g by L D L', and where B is positive definite.

    B is [[a, b, c], [b, d, e], [c, e, f]].
    """
    builder: Any = v.builder
    a, b, c, d, e, f = block
    by_a = builder.fdiv(_ONE, a)
    l1, l2 = builder.fmul(b, by_a), builder.fmul(c, by_a)
    second = v.subtract_product(d, l1, b)
    by_second = builder.fdiv(_ONE, second)
    below = v.subtract_product(e, l2, b)
    l3 = builder.fmul(below, by_second)
    third = v.subtract_product(v.subtract_product(f, l2, c), l3, below)
    y1 = v.subtract_product(g[1], l1, g[0])
    y2 = v.subtract_product(v.subtract_product(g[2], l2, g[0]), l3, y1)
    x2 = builder.fdiv(builder.fsub(_ZERO, y2), third)
    x1 = v.subtract_product(builder.fmul(builder.fsub(_ZERO, y1), by_second), l3, x2)
    x0 = v.subtract_product(builder.fmul(builder.fsub(_ZERO, g[0]), by_a), l1, x1)
    x0 = v.subtract_product(x0, l2, x2)
    least = builder.fmul(constant_packet(_PIVOT_ROUNDOFF), builder.fadd(builder.fadd(a, d), f))
    large = [builder.fcmp_ordered(">", pivot, least) for pivot in (a, second, third)]
    return [x0, x1, x2], builder.and_(builder.and_(large[0], large[1]), large[2])


def _scratch_pointers(builder: Any, springs: SpringPacket, near: Any, entry: Any) -> list[Any]:
    """Return pointers to the stored vector and length of an entry's springs."""
    begins = builder.mul(builder.sub(entry, springs.first_entry), I64(LANES * SPRING_SCRATCH_SIZE))
    begins = builder.add(begins, I64(LANES * PACKET_SCRATCH_SIZE))
    return [builder.gep(near, [builder.add(begins, I64(LANES * k))]) for k in range(SPRING_SCRATCH_SIZE)]


def _build_vertex_model(
    v: PacketBuilder, springs: SpringPacket, near: Any, x: Any, centre: list[Any], load: list[Any], weight: Any
) -> tuple[list[Any], list[Any], Any]:
    """Return negative gradients, blocks, and whether a spring is too short.

    The blocks are upper triangles by rows. `load` is the force of inertia, external forces and pins, `weight` their
    stiffness.
    """
    builder: Any = v.builder
    edges = None if springs.edges is None else EdgeBuilder(v, springs.edges, springs.packet_index)
    slopes = v.allocate_sums(3)
    sums = [cgutils.alloca_once_value(builder, one) for one in (*load, weight, _ZERO, _ZERO, weight, _ZERO, weight)]
    short = cgutils.alloca_once_value(builder, ir.Constant(MASK_TYPE, [0] * LANES))
    with cgutils.for_range_slice(builder, springs.first_entry, springs.end_entry, I64(1), I64) as (entry, _):
        arrow = v.compute_spring_vectors(x, centre, springs.neighbour_offset, entry)
        squared = v.squared_norm(arrow)
        tiny = builder.fcmp_ordered("<=", squared, constant_packet(MIN_SQUARED_LENGTH))
        builder.store(builder.or_(builder.load(short), tiny), short)
        root = v.inverse_sqrt(v.clamp_squared_length(squared))
        scratch = _scratch_pointers(builder, springs, near, entry)
        for value, pointer in zip([*arrow, builder.fmul(squared, root)], scratch, strict=True):
            v.store(value, pointer)
        pull, k = v.load_packets(springs.weights, springs.weight_offset, entry)
        inward = builder.fmul(pull, root)
        tension = builder.fsub(inward, k)
        # Springs with negative k belong to an energy's spring form, have no rest length and are never compressed.
        compressed = [builder.fcmp_ordered(">", force, _ZERO) for force in (tension, inward)]
        lateral = builder.select(builder.and_(*compressed), _ZERO, builder.fsub(_ZERO, tension))
        axial = builder.fsub(k, lateral)
        if edges is not None:
            factors = [tension, lateral, axial]
            tension, lateral, axial = edges.add_derivatives(entry, arrow, squared, root, factors, slopes)
        n = [builder.fmul(component, root) for component in arrow]
        along = [builder.fmul(axial, component) for component in n]
        added = [(tension, component) for component in arrow]
        added += [(along[i], n[j]) for i in range(3) for j in range(i, 3)]
        for index, ((one, other), accumulator) in enumerate(zip(added, sums, strict=True)):
            total = v.multiply_add(one, other, builder.load(accumulator))
            builder.store(builder.fadd(total, lateral) if index in (3, 6, 8) else total, accumulator)
    if edges is not None:
        edges.add_dashpot_blocks(sums[3:])
        for k, (slope, total) in enumerate(zip(slopes, sums, strict=False)):
            v.store(builder.load(slope), builder.gep(near, [I64(LANES * k)]))
            builder.store(builder.fsub(builder.load(total), builder.load(slope)), total)
    found = [builder.load(total) for total in sums]
    return found[:3], found[3:], v.any_lane(builder.load(short))


def _energy_change(
    v: PacketBuilder, springs: SpringPacket, near: Any, load: list[Any], weight: Any, d: list[Any]
) -> Any:
    """Return the energy change of steps d, from differences of lengths, which do not cancel."""
    builder: Any = v.builder
    edges = None if springs.edges is None else EdgeBuilder(v, springs.edges, springs.packet_index)
    rise = builder.fmul(builder.fmul(_HALF, weight), v.squared_norm(d))
    for component, own_force in zip(d, load, strict=True):
        rise = v.subtract_product(rise, component, own_force)
    rises = cgutils.alloca_once_value(builder, rise)
    with cgutils.for_range_slice(builder, springs.first_entry, springs.end_entry, I64(1), I64) as (entry, _):
        *arrow, length = [v.load(pointer, PACKET_TYPE) for pointer in _scratch_pointers(builder, springs, near, entry)]
        moved = [builder.fadd(a, b) for a, b in zip(arrow, d, strict=True)]
        squared = v.squared_norm(moved)
        after = builder.fmul(squared, v.inverse_sqrt(v.clamp_squared_length(squared)), flags=("contract",))
        both = builder.fadd(after, length, flags=("contract",))
        change = builder.fmul(builder.fadd(arrow[0], moved[0]), d[0])
        for c in (1, 2):
            change = v.multiply_add(builder.fadd(arrow[c], moved[c]), d[c], change)
        pull, k = v.load_packets(springs.weights, springs.weight_offset, entry)
        if edges is None:
            factor = builder.fsub(builder.fmul(_HALF, k), builder.fdiv(pull, both))
        else:
            by_both = builder.fdiv(_ONE, both)
            factor = v.subtract_product(builder.fmul(_HALF, k), pull, by_both)
            edges.add_limit_change(entry, length, after, change, by_both, rises)
        v.add_products([factor], [change], [rises])
    if edges is not None:
        slopes = [v.load(builder.gep(near, [I64(LANES * k)]), PACKET_TYPE) for k in range(PACKET_SCRATCH_SIZE)]
        edges.add_dashpot_change(slopes, d, rises)
    return builder.load(rises)


def _load_vertices(
    v: PacketBuilder, springs: SpringPacket, number: Any, x: Any, right: Any
) -> tuple[list[Any], list[Any], list[Any], Any]:
    """Return row offsets, positions, load without springs, and stiffness of a packet's vertices."""
    places = v.load_row_offsets(springs.row_offset, number)
    centre = v.gather_rows(x, places)
    *constants, weight = v.load_right_hand_side(right, number)
    return places, centre, [v.subtract_product(c, weight, p) for c, p in zip(constants, centre, strict=True)], weight


def _newton_step_code(typingctx: Any, packets: Any, number: Any, x: Any, right: Any, majorant: Any, near: Any) -> Any:
    """Move a packet's vertices in x; return whether a spring is too short.

    If one is, no vertex is moved.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        packets, number, x, right, majorant, near = unpack_arguments(context, builder, signature, args)
        v, springs = PacketBuilder(context, builder), SpringPacket.from_packets(builder, packets, number)
        places, centre, load, weight = _load_vertices(v, springs, number, x, right)
        force, block, short = _build_vertex_model(v, springs, near, x, centre, load, weight)
        d, definite = _solve_newton_system(v, block, [builder.fsub(_ZERO, component) for component in force])
        falls = builder.fcmp_ordered("<=", _energy_change(v, springs, near, load, weight, d), _ZERO)
        better = builder.and_(definite, falls)
        scale = builder.fdiv(_ONE, v.load(builder.gep(majorant, [builder.mul(number, I64(LANES))]), PACKET_TYPE))
        safe = [builder.fmul(scale, component) for component in force]
        ends = [builder.fadd(p, builder.select(better, a, b)) for p, a, b in zip(centre, d, safe, strict=True)]
        with builder.if_then(builder.not_(short), likely=True):
            for place, row in zip(places, v.transpose_to_rows(ends), strict=True):
                v.store(row, builder.gep(x, [place]))
        return short

    return types.boolean(packets, number, x, right, majorant, near), generate


def _vertex_model_code(typingctx: Any, packets: Any, number: Any, x: Any, right: Any, near: Any, sums: Any) -> Any:
    """Write a packet's negative gradients (3) and blocks (6) to `sums`, eight numbers each.

    Returns whether a spring is too short.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        packets, number, x, right, near, sums = unpack_arguments(context, builder, signature, args)
        v, springs = PacketBuilder(context, builder), SpringPacket.from_packets(builder, packets, number)
        _, centre, load, weight = _load_vertices(v, springs, number, x, right)
        force, block, short = _build_vertex_model(v, springs, near, x, centre, load, weight)
        for k, value in enumerate([*force, *block]):
            v.store(value, builder.gep(sums, [I64(LANES * k)]))
        return short

    return types.boolean(packets, number, x, right, near, sums), generate


def _model_step_code(typingctx: Any, packets: Any, number: Any, x: Any, right: Any, near: Any, sums: Any) -> Any:
    """Write the Newton steps (3) of the model in `sums`, and their energy changes.

    They follow the gradients, in place of the blocks. The changes are those of all energies in the vertex model, and
    infinite where a block is not positive definite.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        packets, number, x, right, near, sums = unpack_arguments(context, builder, signature, args)
        v, springs = PacketBuilder(context, builder), SpringPacket.from_packets(builder, packets, number)
        _, _, load, weight = _load_vertices(v, springs, number, x, right)
        at = [builder.gep(sums, [I64(LANES * k)]) for k in range(9)]
        loaded = [v.load(pointer, PACKET_TYPE) for pointer in at]
        d, definite = _solve_newton_system(v, loaded[3:], [builder.fsub(_ZERO, component) for component in loaded[:3]])
        rise = builder.select(
            definite, _energy_change(v, springs, near, load, weight, d), constant_packet(float("inf"))
        )
        for value, pointer in zip([*d, rise], at[3:7], strict=True):
            v.store(value, pointer)
        return context.get_dummy_value()

    return types.void(packets, number, x, right, near, sums), generate


# Numba passes the first argument itself, which type checkers cannot see.
vbd_newton_step: Any = intrinsic(_newton_step_code)
vbd_vertex_model: Any = intrinsic(_vertex_model_code)
vbd_model_step: Any = intrinsic(_model_step_code)
