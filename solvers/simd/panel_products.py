"""Products of a panel and its transpose with four interleaved right-hand sides, in LLVM vectors.

A panel W has 4 m columns (m = 1 to 4). Its rows are grouped in tiles of four, stored by columns: a lane of four numbers
is a column of a tile. A work vector has rows of 4: x, y, z and zero. The factor of an entry of W is equal either within
a lane or across all lanes. W is therefore loaded as it is stored, and no padding is multiplied:

    forward     x, y and z of a column's row, each repeated four times, stay in registers for all tiles; the lanes of
                the products are summed, transposed, and added to the rows of y in `index`
    backward    x, y and z of the four rows of y in `index`, transposed, are equal for all lanes; sums over all tiles
                stay in registers, and in the end those of a lane are added

Rows that complete the last tile are zero, and refer to a row of their own panel. Panels have the work vector's type, or
are float16, viewed as uint16, with a float32 work vector.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from springbench.solvers.simd.llvm_vectors import I64, VectorBuilder, literal_signature, prefetch_line, unpack_arguments

_PREFETCH_BYTES = 4096
"""Prefetch distance in bytes of the downward pass, which the hardware prefetcher predicts less well."""


class _TileBuilder(VectorBuilder):
    """Builder for tiles of 4 m columns in 512-bit vectors.

    The attribute `element_type` is the element type of the work vector.
    """

    def __init__(self, context: Any, builder: Any, element: types.Float, m: int) -> None:
        super().__init__(context, builder)
        self.element_type = context.get_value_type(element)
        self.element_bytes = element.bitwidth // 8
        self.lanes_per_vector = 16 // self.element_bytes  # lanes of four numbers in 64 bytes
        self.vectors_per_tile = 4 * m // self.lanes_per_vector
        self.entries_per_tile = 16 * m

    def zero_vector(self, lanes: int) -> ir.Constant:
        """Return a vector of zeros with a number of lanes."""
        return ir.Constant(ir.VectorType(self.element_type, 4 * lanes), [0.0] * (4 * lanes))

    def load_lanes(self, pointer: Any, lanes: int = 1) -> Any:
        """Load a number of lanes of four numbers."""
        return self.load(pointer, ir.VectorType(self.element_type, 4 * lanes))

    def load_panel_vector(self, tile: Any, kind: types.Array, z: int) -> Any:
        """Load vector z of a tile of a panel; float16 is widened."""
        at = self.builder.gep(tile, [I64(4 * self.lanes_per_vector * z)])
        if kind.dtype != types.uint16:
            return self.load_lanes(at, self.lanes_per_vector)
        half, wide = (ir.VectorType(e, 4 * self.lanes_per_vector) for e in (ir.HalfType(), self.element_type))
        return self.builder.fpext(self.load(at, half), wide)

    def pick_lanes(self, a: Any, b: Any, lanes: list[int]) -> Any:
        """Return lanes of two vectors, numbered through both."""
        return self.shuffle(a, b, [4 * lane + i for lane in lanes for i in range(4)])

    def shuffle_within_lanes(self, a: Any, b: Any, places: tuple[int, ...]) -> Any:
        """Permute numbers within each lane; places are numbered through both vectors' lanes."""
        n = a.type.count
        return self.shuffle(a, b, [n * (i // 4) + lane + i % 4 for lane in range(0, n, 4) for i in places])

    def join_vectors(self, rows: list[Any]) -> Any:
        """Concatenate one, two or four vectors."""
        while len(rows) > 1:
            many = rows[0].type.count // 4
            rows = [self.pick_lanes(a, b, list(range(2 * many))) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        return rows[0]

    def repeat_entry(self, vector: Any, c: int) -> Any:
        """Return number c of each lane, repeated four times."""
        return self.shuffle(vector, vector, [i // 4 * 4 + c for i in range(vector.type.count)])

    def add_vectors(self, a: Any, b: Any) -> Any:
        """Return a + b."""
        return self.builder.fadd(a, b)

    def reduce_to_rows(self, totals: list[Any]) -> list[Any]:
        """Sum the lanes of three or four vectors; return four rows, padded with zero."""
        vectors, even = (
            [*totals, self.zero_vector(self.lanes_per_vector)][:4],
            list(range(0, 2 * self.lanes_per_vector, 2)),
        )
        for _ in range(self.lanes_per_vector // 2):  # until a lane is a sum
            vectors = [
                self.add_vectors(self.pick_lanes(a, b, even), self.pick_lanes(a, b, [lane + 1 for lane in even]))
                for a, b in zip(vectors[::2], vectors[1::2], strict=True)
            ]
        whole = self.join_vectors(vectors)
        turned = self.shuffle(whole, whole, [4 * c + r for r in range(4) for c in range(4)])
        return [self.pick_lanes(turned, turned, [r]) for r in range(4)]

    def transpose_rows(self, rows: list[Any]) -> list[Any]:
        """Return x, y and z of four rows, repeated in each lane of a vector."""
        if self.lanes_per_vector == 2:
            whole = self.join_vectors(rows)
            return [self.shuffle(whole, whole, [4 * r + c for r in range(4)] * 2) for c in range(3)]
        rows = [self.pick_lanes(row, row, [0] * 4) for row in rows]  # so that all that follows stays within lanes
        (xy01, z01), (xy23, z23) = (
            [self.shuffle_within_lanes(a, b, at) for at in ((0, 4, 1, 5), (2, 6, 3, 7))]
            for a, b in (rows[:2], rows[2:])
        )
        x, y = (self.shuffle_within_lanes(xy01, xy23, at) for at in ((0, 1, 4, 5), (2, 3, 6, 7)))
        return [x, y, self.shuffle_within_lanes(z01, z23, (0, 1, 4, 5))]

    def sum_within_lanes(self, x: Any, y: Any, z: Any) -> Any:
        """Return each lane's sums of x, y and z, and zero."""
        xy, z0 = (
            self.add_vectors(
                self.shuffle_within_lanes(a, b, (0, 4, 1, 5)), self.shuffle_within_lanes(a, b, (2, 6, 3, 7))
            )
            for a, b in ((x, y), (z, self.zero_vector(self.lanes_per_vector)))
        )
        return self.add_vectors(
            self.shuffle_within_lanes(xy, z0, (0, 1, 4, 5)), self.shuffle_within_lanes(xy, z0, (2, 3, 6, 7))
        )

    def prefetch_tile(self, tile: Any, kind: Any) -> None:
        """Prefetch the cache lines _PREFETCH_BYTES before those of a tile."""
        for line in reversed(range(0, self.entries_per_tile * kind.dtype.bitwidth // 8, 64)):
            prefetch_line(self.builder, tile, line - _PREFETCH_BYTES)


def _row_pointers(builder: Any, index: Any, first: Any, rows: Any) -> list[Any]:
    """Return pointers to the four rows in `index` from `first` on."""
    names = [builder.zext(builder.load(builder.gep(index, [builder.add(first, I64(r))])), I64) for r in range(4)]
    return [builder.gep(rows, [builder.mul(name, I64(4))]) for name in names]


def _panel_product_code(
    typingctx: Any, panel: Any, offset: Any, index: Any, at: Any, count: Any, x: Any, x_row: Any, y: Any, y_row: Any,
    numbers: Any, quads: Any,
) -> Any:  # fmt: skip
    """Compute y[y_row + index[at + r]] += sum_j W[r, j] x[x_row + j] for r < count, a multiple of four.

    W starts at `offset`. numbers: how many numbers of a row of x are not zero, 3 or 4.
    """
    declared = literal_signature(panel, offset, index, at, count, x, x_row, y, y_row, numbers, quads, compiled_in=2)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        panel, offset, index, at, count, x, x_row, y, y_row, numbers, m = unpack_arguments(
            context, builder, signature, args
        )
        kind = signature.args[0]
        t = _TileBuilder(context, builder, signature.args[7].dtype, m)
        panel, index = builder.gep(panel, [offset]), builder.gep(index, [at])
        x, y = (builder.gep(rows, [builder.mul(first, I64(4))]) for rows, first in ((x, x_row), (y, y_row)))
        columns = [t.load_lanes(builder.gep(x, [I64(4 * j)])) for j in range(4 * m)]
        vectors = [t.join_vectors(columns[j : j + t.lanes_per_vector]) for j in range(0, 4 * m, t.lanes_per_vector)]
        factors = [[t.repeat_entry(vector, c) for c in range(numbers)] for vector in vectors]
        with cgutils.for_range(builder, builder.lshr(count, I64(2))) as loop:
            first = builder.mul(loop.index, I64(4))
            tile = builder.gep(panel, [builder.mul(loop.index, I64(t.entries_per_tile))])
            sums: list[Any] = [None] * numbers
            for z, three in enumerate(factors):
                w = t.load_panel_vector(tile, kind, z)
                sums = [t.multiply_add(w, factor, total) for factor, total in zip(three, sums, strict=True)]
            for row, place in zip(t.reduce_to_rows(sums), _row_pointers(builder, index, first, y), strict=True):
                t.store(t.add_vectors(row, t.load_lanes(place)), place)
        return context.get_dummy_value()

    return declared, generate


def _transposed_product_code(
    typingctx: Any, square: Any, start: Any, own: Any, panel: Any, offset: Any, index: Any, at: Any, below: Any, y: Any,
    x_row: Any, quads: Any,
) -> Any:  # fmt: skip
    """Compute y[x_row + j] = sum_r S[r, j] y[x_row + r] + sum_r W[r, j] y[index[at + r]].

    The first sum is over r < 4 quads, with S from `start` on; it is omitted if `own` is zero. The second one is over
    r < below, a multiple of four, with W from `offset` on.
    """
    declared = literal_signature(square, start, own, panel, offset, index, at, below, y, x_row, quads)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        square, start, own, panel, offset, index, at, below, y, x_row, m = unpack_arguments(
            context, builder, signature, args
        )
        square_kind, panel_kind = signature.args[0], signature.args[3]
        t = _TileBuilder(context, builder, signature.args[8].dtype, m)
        square, panel, index = (builder.gep(a, [begin]) for a, begin in ((square, start), (panel, offset), (index, at)))
        out = builder.gep(y, [builder.mul(x_row, I64(4))])
        vector = t.zero_vector(t.lanes_per_vector)
        sums = [[cgutils.alloca_once_value(builder, vector) for _ in range(3)] for _ in range(t.vectors_per_tile)]

        def add(tile: Any, kind: Any, places: list[Any]) -> None:
            t.prefetch_tile(tile, kind)
            factors = t.transpose_rows([t.load_lanes(place) for place in places])
            for z, three in reversed(list(enumerate(sums))):
                w = t.load_panel_vector(tile, kind, z)
                for factor, total in zip(factors, three, strict=True):
                    builder.store(t.multiply_add(w, factor, builder.load(total)), total)

        # From the last row to the first: panels are then read strictly downwards, after the upward forward pass, so
        # that data that is still in cache is read first.
        tiles = builder.lshr(below, I64(2))
        with cgutils.for_range(builder, tiles) as loop:
            k = builder.sub(builder.sub(tiles, I64(1)), loop.index)
            tile = builder.gep(panel, [builder.mul(k, I64(t.entries_per_tile))])
            add(tile, panel_kind, _row_pointers(builder, index, builder.mul(k, I64(4)), y))
        with builder.if_then(builder.icmp_signed(">", own, I64(0)), likely=True):
            for k in reversed(range(m)):
                places = [builder.gep(out, [I64(4 * (4 * k + r))]) for r in range(4)]
                add(builder.gep(square, [I64(t.entries_per_tile * k)]), square_kind, places)
        done = [t.sum_within_lanes(*(builder.load(total) for total in three)) for three in sums]
        for z, rows in enumerate(done):
            t.store(rows, builder.gep(out, [I64(4 * t.lanes_per_vector * z)]))
        return context.get_dummy_value()

    return declared, generate


# Numba passes the first argument itself, which type checkers cannot see.
add_panel_product: Any = intrinsic(_panel_product_code)
set_transposed_product: Any = intrinsic(_transposed_product_code)
