"""Springs of eight vertices at a time, in explicit LLVM vectors.

Position rows have four numbers, x, y, z and padding. One load fetches a vertex, and eight loaded rows are transposed to
vectors of x, y and z. Lane l contains a spring of vertex l, so that no two lanes add to one address. Rows are
identified by the offset of their first number. Processors add that to an address at no cost, and these loops are
limited by their number of instructions.

    1/|v|   from an estimate, e = 1 - s y^2, y <- y (1 - e)^(-1/2) by its series, to about one unit in the last place:
            AVX-512's estimate, with an error of 2^-14, and a step of degree 3;
            or Lomont's integer trick (2003), with an error of 3.4 %, and steps of degree 4 and 2
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba.core import cgutils
from springbench.solvers.model.energies.spring_energy import ZERO_LENGTH
from springbench.solvers.simd.llvm_vectors import F64, I8, I64, VectorBuilder, prefetch_line

LANES = 8
RHS_STRIDE = 4 * LANES
"""Numbers in a packet's constant right-hand side: x, y and z of eight vertices, and their stiffnesses [N/m]."""
EDGE_STRIDE = 4 * LANES
"""Numbers of a strain limit and of a dashpot in each entry: four of eight lanes."""
BLOCK_ENTRIES = 6
"""Entries of the upper triangle of a vertex's block."""
ROW_TYPE, PACKET_TYPE, MASK_TYPE = ir.VectorType(F64, 4), ir.VectorType(F64, LANES), ir.VectorType(ir.IntType(1), LANES)
BITS_TYPE = ir.VectorType(I64, LANES)
_RSQRT_MAGIC, _RSQRT14_INTRINSIC = 0x5FE6EB50C7B537A9, "llvm.x86.avx512.rsqrt14.pd.512"
MIN_SQUARED_LENGTH, MAX_SQUARED_LENGTH = ZERO_LENGTH * ZERO_LENGTH, 1.7e308
"""Bounds of squared lengths between which the estimate is finite."""

PREFETCH_ROWS = 128
"""Prefetch distance in rows for data read once per iteration, which large meshes evict from the caches."""


def constant_packet(value: float) -> ir.Constant:
    """Return a packet with one number in all lanes."""
    return ir.Constant(PACKET_TYPE, [value] * LANES)


class SpringPacket(NamedTuple):
    """Springs of eight vertices in memory.

    Offsets of the arrays of `springbench.solvers.kernels.spring_local_step.SpringPackets`, the packet's index, and its
    first and end entry; its edges (`springbench.solvers.kernels.edge_elements.EdgePackets`) or None.
    """

    row_offset: Any
    neighbour_offset: Any
    weight_offset: Any
    weights: Any
    packet_index: Any
    first_entry: Any
    end_entry: Any
    edges: Any

    @classmethod
    def from_packets(cls, builder: Any, packets: Any, number: Any) -> SpringPacket:
        """Load the packet with a given index.

        Args:
            builder: LLVM builder of the code.
            packets: pointers to the arrays of all packets, `SpringPackets` as `unpack_arguments` returns it.
            number: index of the packet.
        """
        begin, end = (builder.load(builder.gep(packets.packet_start, [builder.add(number, I64(k))])) for k in (0, 1))
        arrays = packets.row_offset, packets.neighbour_offset, packets.weight_offset, packets.weights
        return cls(*arrays, number, begin, end, packets.edges)


class PacketBuilder(VectorBuilder):
    """Builder for packets of eight float64, one for each spring that ends at eight vertices."""

    def load_row_offsets(self, indices: Any, packet: Any) -> list[Any]:
        """Load the offsets of eight rows.

        Args:
            indices: pointer to offsets (int32), eight for each packet or entry.
            packet: index of the packet or entry.

        Returns:
            Eight int64.
        """
        b = self.builder
        first = b.mul(packet, I64(LANES))
        return [b.zext(b.load(b.gep(indices, [b.add(first, I64(lane))])), I64) for lane in range(LANES)]

    def gather_rows(self, array: Any, places: list[Any]) -> list[Any]:
        """Gather x, y and z of eight rows.

        Args:
            array: pointer to rows of four float64.
            places: offsets of the eight rows.

        Returns:
            Three packets.
        """
        rows = [self.load(self.builder.gep(array, [place]), ROW_TYPE) for place in places]
        pairs = [self.shuffle(rows[lane], rows[lane + 2], list(range(8))) for lane in (0, 1, 4, 5)]
        low = [0, 8, 2, 10, 4, 12, 6, 14]
        xz = [self.shuffle(pairs[i], pairs[i + 1], low) for i in (0, 2)]
        y = [self.shuffle(pairs[i], pairs[i + 1], [k + 1 for k in low]) for i in (0, 2)]
        first, second = [0, 1, 4, 5, 8, 9, 12, 13], [2, 3, 6, 7, 10, 11, 14, 15]
        return [self.shuffle(a[0], a[1], lanes) for a, lanes in ((xz, first), (y, first), (xz, second))]

    def load_packets(self, table: Any, kind: Any, entry: Any, many: int = 2) -> list[Any]:
        """Load the packets that a table contains for an entry.

        Args:
            table: pointer to packets, stored once for equal entries.
            kind: pointer to the offset in the table of each entry (int32).
            entry: index of the entry.
            many: number of packets of each entry.
        """
        b = self.builder
        return self.load_adjacent(table, b.zext(b.load(b.gep(kind, [entry])), I64), many)

    def load_adjacent(self, array: Any, first: Any, many: int) -> list[Any]:
        """Load adjacent packets.

        Args:
            array: pointer to float64.
            first: index of the first number.
            many: number of packets.
        """
        b = self.builder
        at = b.gep(array, [first])
        return [self.load(b.gep(at, [I64(LANES * k)]), PACKET_TYPE) for k in range(many)]

    def allocate_sums(self, many: int) -> list[Any]:
        """Allocate accumulators initialised with zero."""
        return [cgutils.alloca_once_value(self.builder, constant_packet(0.0)) for _ in range(many)]

    def compute_spring_vectors(self, x: Any, centre: list[Any], neighbour: Any, entry: Any) -> list[Any]:
        """Return the vectors to eight vertices from the other ends of an entry's springs.

        Args:
            x: pointer to positions in rows of four [m].
            centre: x, y and z of the eight vertices [m].
            neighbour: pointer to the offsets of the other ends (int32), eight for each entry.
            entry: index of the entry.

        Returns:
            x, y and z of the vectors [m].
        """
        others = self.gather_rows(x, self.load_row_offsets(neighbour, entry))
        return [self.builder.fsub(a, b) for a, b in zip(centre, others, strict=True)]

    def add_products(self, factors: list[Any], terms: list[Any], sums: list[Any]) -> None:
        """Add factor times term to each accumulator.

        Args:
            factors, terms: packets, as many as accumulators.
            sums: pointers to the accumulators.
        """
        for factor, term, total in zip(factors, terms, sums, strict=True):
            self.builder.store(self.multiply_add(factor, term, self.builder.load(total)), total)

    def update_minimum(self, value: Any, least: Any) -> None:
        """Update the lane-wise minimum in memory.

        Args:
            value: packet of new values; NaN changes nothing.
            least: pointer to the minimum.
        """
        self.builder.store(self.select_minimum(self.builder.load(least), value), least)

    def has_short_spring(self, least: Any) -> Any:
        """Return whether a minimum in memory is too small for an inverse square root."""
        return self.any_lane(
            self.builder.fcmp_ordered("<=", self.builder.load(least), constant_packet(MIN_SQUARED_LENGTH))
        )

    def pipeline_entries(
        self, begin: Any, end: Any, read: Callable[[Any], list[Any]], *stages: Callable[[list[Any]], Any]
    ) -> None:
        """Process all entries in a software pipeline.

        One entry is read while each stage processes an earlier one, which hides latencies. There must be at
        least as many entries as stages.

        Args:
            begin, end: range of entries.
            read: function that returns the values of an entry.
            *stages: functions of the values of the stage before, in order of execution; the result of the last one is
                ignored.
        """
        b, depth = self.builder, len(stages)
        waiting: list[list[Any]] = []  # for each stage, the last one first
        for k in range(depth):
            values = read(b.add(begin, I64(k)))
            for stage in stages[: depth - 1 - k]:
                values = stage(values)
            waiting.append([cgutils.alloca_once(b, value.type) for value in values])
            for value, place in zip(values, waiting[-1], strict=True):
                b.store(value, place)
        with cgutils.for_range_slice(b, b.add(begin, I64(depth)), end, I64(1), I64) as (entry, _):
            fresh = read(entry)
            for stage, places in zip(stages, reversed(waiting), strict=True):
                values = [b.load(place) for place in places]
                for value, place in zip(fresh, places, strict=True):
                    b.store(value, place)
                fresh = stage(values)
        for k, places in enumerate(waiting):
            values = [b.load(place) for place in places]
            for stage in stages[depth - 1 - k :]:
                values = stage(values)

    def transpose_to_rows(self, vectors: list[Any], element: ir.Type = F64) -> list[Any]:
        """Transpose vectors to eight rows of x, y, z and zero.

        Args:
            vectors: packets of x, y and z.
            element: type of the items of rows, to which float64 is rounded.
        """
        zero, pairs = ir.Constant(ir.VectorType(element, LANES), [0.0] * LANES), [0, 2, 4, 6]
        if element != F64:
            vectors = [self.builder.fptrunc(a, zero.type) for a in vectors]
            pairs = [0, 1, 4, 5]  # so that shuffles stay within 128 bits
        (x, y, z), apart, halves = vectors, pairs[1], []
        for half in (0, 2 // apart):
            lanes = [lane for k in pairs for lane in (k + half, k + half + LANES)]
            halves.append((self.shuffle(x, y, lanes), self.shuffle(z, zero, lanes)))
        out: list[Any] = [None] * LANES
        for lane in range(LANES // 2):  # two rows at a time, four lanes apart
            half, begin = (lane % 2, lane - lane % 2) if apart == 2 else (lane // 2, 2 * (lane % 2))
            places = [begin, begin + 1, begin + 8, begin + 9, begin + 4, begin + 5, begin + 12, begin + 13]
            both = self.shuffle(halves[half][0], halves[half][1], places)
            out[lane], out[lane + 4] = (self.shuffle(both, both, list(range(k, k + 4))) for k in (0, 4))
        return out

    def squared_norm(self, a: list[Any]) -> Any:
        """Return |a|^2 of eight vectors."""
        return self.inner_product(a, a)

    def inner_product(self, a: list[Any], b: list[Any]) -> Any:
        """Return the inner products of eight pairs of vectors.

        Args:
            a, b: packets of the components.
        """
        total = self.builder.fmul(a[0], b[0], flags=("contract",))
        for one, other in zip(a[1:], b[1:], strict=True):
            total = self.multiply_add(one, other, total)
        return total

    def add_row(self, pointer: Any, row: Any) -> None:
        """Add a row to one in memory.

        Args:
            pointer: pointer to the row in memory.
            row: vector of four numbers.
        """
        self.store(self.builder.fadd(self.load(pointer, row.type), row), pointer)

    def clamp_squared_length(self, s: Any) -> Any:
        """Return s clamped to MIN_SQUARED_LENGTH and MAX_SQUARED_LENGTH."""
        return self.select_minimum(
            self.select_minimum(s, constant_packet(MIN_SQUARED_LENGTH), ">="), constant_packet(MAX_SQUARED_LENGTH)
        )

    def select_minimum(self, a: Any, b: Any, order: str = "<=") -> Any:
        """Return the lane-wise minimum or maximum.

        Args:
            a, b: packets; the result is a where one is NaN.
            order: "<=" for the minimum, ">=" for the maximum.
        """
        return self.builder.select(self.builder.fcmp_ordered(order, b, a), b, a)

    def load_right_hand_side(self, array: Any, packet: Any) -> list[Any]:
        """Load the constant right-hand side of a packet, and the stiffness of its vertices.

        Args:
            array: pointer to the right-hand side, eight x, y, z [N] and stiffnesses [N/m] per packet.
            packet: index of the packet.

        Returns:
            Packets of x, y and z [N], and of stiffnesses [N/m].
        """
        return self.load_adjacent(array, self.builder.mul(packet, I64(RHS_STRIDE)), 4)

    def prefetch_ahead(self, springs: SpringPacket, places: list[Any], right: Any, out: Any) -> None:
        """Prefetch the data that a packet PREFETCH_ROWS rows ahead will read.

        Args:
            springs: the current packet.
            places: offsets of its eight rows.
            right: pointer to the right-hand side.
            out: pointer to the rows of the result.
        """
        b = self.builder
        first = b.mul(b.add(springs.packet_index, I64(PREFETCH_ROWS // LANES)), I64(RHS_STRIDE))
        for k in range(4):
            prefetch_line(b, b.gep(right, [b.add(first, I64(LANES * k))]))
        for place in places[::2]:
            prefetch_line(b, b.gep(out, [b.add(place, I64(4 * PREFETCH_ROWS))]))
        first = b.mul(b.add(springs.first_entry, I64(PREFETCH_ROWS)), I64(LANES))  # about as many entries as rows
        for k in range(LANES // 2):
            prefetch_line(b, b.gep(springs.neighbour_offset, [b.add(first, I64(2 * LANES * k))]))

    def estimate_inverse_sqrt(self, s: Any) -> tuple[Any, Any]:
        """Return y, an estimate of 1/sqrt(s), and 1 - s y^2, for clamped s.

        `inverse_sqrt_correction` completes the estimate.
        """
        b = self.builder
        if self.has_avx512:
            kind = ir.FunctionType(PACKET_TYPE, [PACKET_TYPE, PACKET_TYPE, I8])
            estimate = b.module.globals.get(_RSQRT14_INTRINSIC) or ir.Function(b.module, kind, _RSQRT14_INTRINSIC)
            y = b.call(estimate, [s, constant_packet(0.0), I8(-1)])
        else:
            half = b.lshr(b.bitcast(s, BITS_TYPE), ir.Constant(BITS_TYPE, [1] * LANES))
            y = b.bitcast(b.sub(ir.Constant(BITS_TYPE, [_RSQRT_MAGIC] * LANES), half), PACKET_TYPE)
            e = self.subtract_product(constant_packet(1.0), b.fmul(s, y), y)
            y = self.multiply_add(b.fmul(y, e), self.evaluate_polynomial(e, 35 / 128, 5 / 16, 3 / 8, 1 / 2), y)
        return y, self.subtract_product(constant_packet(1.0), b.fmul(s, y), y)

    def inverse_sqrt_correction(self, e: Any) -> Any:
        """Return ((1 - e)^(-1/2) - 1)/e to the accuracy that the estimate requires."""
        return self.evaluate_polynomial(e, *(5 / 16, 3 / 8, 1 / 2) if self.has_avx512 else (3 / 8, 1 / 2))

    def evaluate_polynomial(self, e: Any, *coefficients: float) -> Any:
        """Evaluate a polynomial in e.

        Args:
            e: packet of arguments.
            *coefficients: coefficients, from the highest power down.
        """
        first, *others = map(constant_packet, coefficients)
        for c in others:
            first = self.multiply_add(first, e, c)
        return first

    def inverse_sqrt(self, s: Any) -> Any:
        """Return 1/sqrt(s), for s between MIN_SQUARED_LENGTH and MAX_SQUARED_LENGTH."""
        y, e = self.estimate_inverse_sqrt(s)
        return self.multiply_add(self.builder.fmul(y, e), self.inverse_sqrt_correction(e), y)
