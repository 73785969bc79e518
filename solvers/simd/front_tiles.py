"""Products of tiles of a frontal matrix, in explicit LLVM vectors.

A front is stored by columns, with `stride` entries from one to the next. A tile has eight rows and six or three
columns. Its sums stay in registers during the loop over the columns to the left, of which eight rows form a vector.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from springbench.solvers.simd.llvm_vectors import (
    F64,
    I32,
    I64,
    VectorBuilder,
    literal_signature,
    prefetch_line,
    unpack_arguments,
)

TILE_ROWS, TILE_COLUMNS = 8, 6
"""Rows and columns (two vertices) of a tile. The sums of one tile and a factor fit the registers of AVX2."""

_TILE_HEIGHTS = (4, 2, 1)
"""Numbers of tiles, one below the other, whose sums a product with AVX-512 has in registers: the more, the fewer
factors are loaded for each sum."""

_PREFETCH_COLUMNS = 8
"""Prefetch distance of a product: hardware does not predict columns that are a page or more apart."""

_PACKET_TYPE = ir.VectorType(F64, TILE_ROWS)


class _StripBuilder(VectorBuilder):
    """Builder for vectors of eight rows of a column."""

    def load_rows(self, pointer: Any) -> Any:
        """Load eight rows."""
        return self.load(pointer, _PACKET_TYPE)

    def broadcast_from_memory(self, pointer: Any) -> Any:
        """Load a number into all lanes."""
        return self.broadcast_scalar(self.builder.load(pointer), TILE_ROWS)

    def masked_load_or_store(self, pointer: Any, mask: Any, value: Any = None) -> Any:
        """Load the lanes of a mask, with zero in the others, or store them."""
        builder = self.builder
        place = builder.bitcast(pointer, _PACKET_TYPE.as_pointer())
        kinds = [_PACKET_TYPE.as_pointer(), I32, mask.type]
        if value is None:
            kind, name = ir.FunctionType(_PACKET_TYPE, [*kinds, _PACKET_TYPE]), "llvm.masked.load.v8f64.p0"
            load = cgutils.get_or_insert_function(builder.module, kind, name)
            return builder.call(load, [place, I32(8), mask, ir.Constant(_PACKET_TYPE, [0.0] * TILE_ROWS)])
        kind, name = ir.FunctionType(ir.VoidType(), [_PACKET_TYPE, *kinds]), "llvm.masked.store.v8f64.p0"
        store = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(store, [value, place, I32(8), mask])


def _subtract_tile_product_code(
    typingctx: Any, L: Any, at: Any, top: Any, stride: Any, depth: Any,
    C: Any, to: Any, step: Any, strips: Any, overwrite: Any, columns: Any,
) -> Any:  # fmt: skip
    """Compute C[to + r + step j] -= sum over k < depth of L[at + r + stride k] L[top + j + stride k].

    j < columns, and r covers `strips` strips of eight rows. C is not read, as if it were zero, if `overwrite` is not
    zero.
    """
    declared = literal_signature(L, at, top, stride, depth, C, to, step, strips, overwrite, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, top, stride, depth, C, to, step, strips, overwrite, columns = unpack_arguments(
            context, builder, signature, args
        )
        v = _StripBuilder(context, builder)
        left, above = builder.gep(L, [at]), builder.gep(L, [top])
        from_zero = builder.icmp_signed("!=", overwrite, I64(0))
        ahead = builder.mul(stride, I64(_PREFETCH_COLUMNS))

        def tile(row: Any, vectors: int) -> None:
            """Process a number of vectors of rows, from `row` on."""
            begins = [builder.add(row, I64(TILE_ROWS * n)) for n in range(vectors)]
            targets = [
                builder.gep(C, [builder.add(builder.add(to, builder.mul(step, I64(j))), begin)])
                for j in range(columns) for begin in begins
            ]  # fmt: skip
            sums = [cgutils.alloca_once(builder, _PACKET_TYPE) for _ in targets]
            with builder.if_else(from_zero) as (then, otherwise):
                with then:
                    for accumulator in sums:
                        builder.store(ir.Constant(_PACKET_TYPE, [0.0] * TILE_ROWS), accumulator)
                with otherwise:
                    for accumulator, target in zip(sums, targets, strict=True):
                        builder.store(v.load_rows(target), accumulator)
            with cgutils.for_range(builder, depth) as loop:
                column = builder.mul(loop.index, stride)
                places = [builder.gep(left, [builder.add(column, begin)]) for begin in begins]
                for place in places:
                    prefetch_line(builder, builder.gep(place, [ahead]))
                rows = [v.load_rows(place) for place in places]
                across = builder.gep(above, [column])
                for j in range(columns):
                    factor = v.broadcast_from_memory(builder.gep(across, [I64(j)]))
                    for n, x in enumerate(rows):
                        place = sums[j * vectors + n]
                        builder.store(v.subtract_product(builder.load(place), x, factor), place)
            for accumulator, target in zip(sums, targets, strict=True):
                v.store(builder.load(accumulator), target)

        begin = I64(0)
        for vectors in _TILE_HEIGHTS if v.has_avx512 else (1,):
            count = builder.udiv(builder.sub(strips, begin), I64(vectors))
            end = builder.add(begin, builder.mul(count, I64(vectors)))
            with cgutils.for_range_slice(builder, begin, end, I64(vectors), I64) as (strip, _):
                tile(builder.mul(strip, I64(TILE_ROWS)), vectors)
            begin = end
        return context.get_dummy_value()

    return declared, generate


def _solve_tile_triangle_code(
    typingctx: Any, L: Any, at: Any, stride: Any, triangle: Any, strips: Any, columns: Any
) -> Any:
    """Replace the rows X of a tile by X T^-T.

    The rows are in strips of eight, from `at` on. triangle (TILE_COLUMNS, TILE_COLUMNS): T with inverted diagonal.
    """
    declared = literal_signature(L, at, stride, triangle, strips, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, triangle, strips, columns = unpack_arguments(context, builder, signature, args)
        v = _StripBuilder(context, builder)
        T = {
            (j, k): v.broadcast_from_memory(builder.gep(triangle, [I64(TILE_COLUMNS * j + k)]))
            for j in range(columns) for k in range(j + 1)
        }  # fmt: skip
        with cgutils.for_range(builder, strips) as loop:
            row = builder.add(at, builder.mul(loop.index, I64(TILE_ROWS)))
            done: list[Any] = []
            for j in range(columns):
                pointer = builder.gep(L, [builder.add(row, builder.mul(stride, I64(j)))])
                x = v.load_rows(pointer)
                for k in range(j):
                    x = v.subtract_product(x, done[k], T[j, k])
                x = builder.fmul(x, T[j, j])
                v.store(x, pointer)
                done.append(x)
        return context.get_dummy_value()

    return declared, generate


def _factorise_tile_code(typingctx: Any, L: Any, at: Any, stride: Any, least: Any, triangle: Any, columns: Any) -> Any:
    """Write the Cholesky factor of a tile's diagonal block to `triangle`, with inverted diagonal.

    triangle: (TILE_COLUMNS, TILE_COLUMNS). Returns whether each pivot exceeds its threshold.
    """
    declared = types.boolean(*literal_signature(L, at, stride, least, triangle, columns).args)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, least, triangle, columns = unpack_arguments(context, builder, signature, args)
        v = _StripBuilder(context, builder)
        root = builder.module.declare_intrinsic("llvm.sqrt", [F64])
        t: dict[tuple[int, int], Any] = {}
        positive: Any = ir.Constant(ir.IntType(1), 1)
        for j in range(columns):
            column = builder.gep(L, [builder.add(at, builder.mul(stride, I64(j)))])
            for i in range(j, columns):
                entry = builder.load(builder.gep(column, [I64(i)]))
                for k in range(j):
                    entry = v.subtract_product(entry, t[i, k], t[j, k])
                if i == j:
                    above = builder.fcmp_ordered(">", entry, builder.load(builder.gep(least, [I64(j)])))
                    positive = builder.and_(positive, above)
                    t[j, j] = builder.fdiv(F64(1.0), builder.call(root, [entry]))
                else:
                    t[i, j] = builder.fmul(entry, t[j, j])
                builder.store(t[i, j], builder.gep(triangle, [I64(TILE_COLUMNS * i + j)]))
        return positive

    return declared, generate


def _forward_solve_tile_code(
    typingctx: Any, L: Any, at: Any, stride: Any, x: Any, to: Any, strips: Any, columns: Any
) -> Any:
    """Perform a tile's forward substitution for x[to + j], j < columns, with its diagonal block at `at`.

    The contributions are subtracted from the rows below, in strips of eight.
    """
    declared = literal_signature(L, at, stride, x, to, strips, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, x, to, strips, columns = unpack_arguments(context, builder, signature, args)
        v = _StripBuilder(context, builder)
        starts = [builder.gep(L, [builder.add(at, builder.mul(stride, I64(j)))]) for j in range(columns)]
        x = builder.gep(x, [to])
        y: list[Any] = []
        for j in range(columns):
            value = builder.load(builder.gep(x, [I64(j)]))
            for k in range(j):
                value = v.subtract_product(value, builder.load(builder.gep(starts[k], [I64(j)])), y[k])
            y.append(builder.fmul(value, builder.load(builder.gep(starts[j], [I64(j)]))))
        for j, value in enumerate(y):
            builder.store(value, builder.gep(x, [I64(j)]))
        factors = [v.broadcast_scalar(value, TILE_ROWS) for value in y]
        with cgutils.for_range(builder, strips) as loop:
            row = builder.add(builder.mul(loop.index, I64(TILE_ROWS)), I64(columns))
            target = builder.gep(x, [row])
            total = v.load_rows(target)
            for start, factor in zip(starts, factors, strict=True):
                total = v.subtract_product(total, v.load_rows(builder.gep(start, [row])), factor)
            v.store(total, target)
        return context.get_dummy_value()

    return declared, generate


def _backward_solve_tile_code(
    typingctx: Any, L: Any, at: Any, stride: Any, x: Any, to: Any, strips: Any, columns: Any
) -> Any:
    """Perform a tile's backward substitution for x[to + j], j < columns, with its diagonal block at `at`.

    The contributions of the rows below, in strips of eight, are subtracted first.
    """
    declared = literal_signature(L, at, stride, x, to, strips, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, x, to, strips, columns = unpack_arguments(context, builder, signature, args)
        v = _StripBuilder(context, builder)
        starts = [builder.gep(L, [builder.add(at, builder.mul(stride, I64(j)))]) for j in range(columns)]
        ahead = builder.mul(stride, I64(-TILE_COLUMNS))
        x = builder.gep(x, [to])
        sums = [cgutils.alloca_once(builder, _PACKET_TYPE) for _ in range(columns)]
        for accumulator in sums:
            builder.store(ir.Constant(_PACKET_TYPE, [0.0] * TILE_ROWS), accumulator)
        with cgutils.for_range(builder, strips) as loop:
            row = builder.add(builder.mul(loop.index, I64(TILE_ROWS)), I64(columns))
            factor = v.load_rows(builder.gep(x, [row]))
            for start, accumulator in zip(starts, sums, strict=True):
                place = builder.gep(start, [row])
                prefetch_line(builder, builder.gep(place, [ahead]))  # of the tile that is next
                builder.store(v.subtract_product(builder.load(accumulator), v.load_rows(place), factor),
                              accumulator)  # fmt: skip
        y: list[Any] = [None] * columns
        for j in range(columns - 1, -1, -1):
            value = builder.fadd(builder.load(builder.gep(x, [I64(j)])), v.sum_by_halves(builder.load(sums[j])))
            for k in range(columns - 1, j, -1):
                value = v.subtract_product(value, builder.load(builder.gep(starts[j], [I64(k)])), y[k])
            y[j] = builder.fmul(value, builder.load(builder.gep(starts[j], [I64(j)])))
            builder.store(y[j], builder.gep(x, [I64(j)]))
        return context.get_dummy_value()

    return declared, generate


def _add_vector_code(typingctx: Any, source: Any, at: Any, target: Any, to: Any, count: Any) -> Any:
    """Compute target[to + r] += source[at + r] for r < count; lanes beyond are neither read nor written."""
    declared = types.void(source, at, target, to, count)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, at, target, to, count = unpack_arguments(context, builder, signature, args)
        v = _StripBuilder(context, builder)
        source, target = builder.gep(source, [at]), builder.gep(target, [to])
        lanes = ir.Constant(ir.VectorType(I64, TILE_ROWS), list(range(TILE_ROWS)))
        strips = builder.udiv(builder.add(count, I64(TILE_ROWS - 1)), I64(TILE_ROWS))
        with cgutils.for_range(builder, strips) as loop:
            row = builder.mul(loop.index, I64(TILE_ROWS))
            left = v.broadcast_scalar(builder.sub(count, row), TILE_ROWS)
            mask = builder.icmp_signed("<", lanes, left)
            place = builder.gep(target, [row])
            total = builder.fadd(*(v.masked_load_or_store(p, mask) for p in (place, builder.gep(source, [row]))))
            v.masked_load_or_store(place, mask, total)
        return context.get_dummy_value()

    return declared, generate


# Numba passes the first argument itself, which type checkers cannot see.
subtract_tile_product: Any = intrinsic(_subtract_tile_product_code)
add_vector: Any = intrinsic(_add_vector_code)
solve_tile_triangle: Any = intrinsic(_solve_tile_triangle_code)
factorise_tile: Any = intrinsic(_factorise_tile_code)
forward_solve_tile: Any = intrinsic(_forward_solve_tile_code)
backward_solve_tile: Any = intrinsic(_backward_solve_tile_code)
