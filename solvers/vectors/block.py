"""Products of tall narrow pieces of a front, in LLVM vectors that a compiler does not find by itself.

A front is kept column by column, `stride` numbers from one to the next. A tile is eight rows of six columns, or of
three: its sums stay in registers while the columns to the left pass by, eight rows of each in a vector.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from solvers.vectors.intrinsics import signature, unpacked

ROWS, TILE = 8, 6
"""Of a tile, rows and columns (two vertices): its sums and a factor fit the registers of AVX2, two tiles' AVX-512's."""

_I64, _F64 = ir.IntType(64), ir.DoubleType()
_WIDE = ir.VectorType(_F64, ROWS)


def _load(builder: Any, pointer: Any) -> Any:
    return builder.load(builder.bitcast(pointer, _WIDE.as_pointer()), align=8)


def _store(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, _WIDE.as_pointer()), align=8)


def _wide(builder: Any, value: Any) -> Any:
    """A number in all lanes."""
    kind = ir.VectorType(value.type, ROWS)
    single = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(single, single, ir.Constant(ir.VectorType(ir.IntType(32), ROWS), [0] * ROWS))


def _spread(builder: Any, pointer: Any) -> Any:
    """A number in memory, in all lanes."""
    return _wide(builder, builder.load(pointer))


def _total(builder: Any, lanes: Any) -> Any:
    """The sum of the lanes, half of them added to the other half."""
    count = ROWS
    while count > 1:
        count //= 2
        halves = [ir.Constant(ir.VectorType(ir.IntType(32), count), list(range(k, k + count))) for k in (0, count)]
        lanes = builder.fadd(*(builder.shuffle_vector(lanes, lanes, half) for half in halves))
    return builder.extract_element(lanes, ir.IntType(32)(0))


def _masked(builder: Any, pointer: Any, mask: Any, value: Any = None) -> Any:
    """Load the lanes that a mask has, zero for the others; or store those of a value."""
    place = builder.bitcast(pointer, _WIDE.as_pointer())
    kinds = [_WIDE.as_pointer(), ir.IntType(32), mask.type]
    if value is None:
        load = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_WIDE, [*kinds, _WIDE]), "llvm.masked.load.v8f64.p0"
        )
        return builder.call(load, [place, ir.IntType(32)(8), mask, ir.Constant(_WIDE, [0.0] * ROWS)])
    store = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(ir.VoidType(), [_WIDE, *kinds]), "llvm.masked.store.v8f64.p0"
    )
    return builder.call(store, [value, place, ir.IntType(32)(8), mask])


def _prefetch(builder: Any, pointer: Any) -> None:
    """Ask for a cache line."""
    byte, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
    call = builder.module.declare_intrinsic(
        "llvm.prefetch.p0", fnty=ir.FunctionType(ir.VoidType(), [byte, i32, i32, i32])
    )
    builder.call(call, [builder.bitcast(pointer, byte), i32(0), i32(3), i32(1)])


def _minus_product(builder: Any, c: Any, a: Any, b: Any) -> Any:
    """c - a b; `contract` lets the target fuse them where it can."""
    return builder.fsub(c, builder.fmul(a, b, flags=("contract",)), flags=("contract",))


def _subtract_product(typingctx: Any, L: Any, at: Any, top: Any, stride: Any, depth: Any, C: Any, to: Any, step: Any,
                      strips: Any, columns: Any) -> Any:  # fmt: skip
    """C[to + r + step j] -= sum over k < depth of L[at + r + stride k] L[top + j + stride k] for j < columns, and r in
    as many strips of eight."""
    declared = signature(L, at, top, stride, depth, C, to, step, strips, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, top, stride, depth, C, to, step, strips, columns = unpacked(context, builder, signature, args)
        left, above = builder.gep(L, [at]), builder.gep(L, [top])

        def tile(row: Any, vectors: int) -> None:
            """So many vectors of rows from `row` on."""
            begins = [builder.add(row, _I64(ROWS * v)) for v in range(vectors)]
            targets = [
                builder.gep(C, [builder.add(builder.add(to, builder.mul(step, _I64(j))), begin)])
                for j in range(columns) for begin in begins
            ]  # fmt: skip
            sums = [cgutils.alloca_once(builder, _WIDE) for _ in targets]
            for accumulator, target in zip(sums, targets, strict=True):
                builder.store(_load(builder, target), accumulator)
            with cgutils.for_range(builder, depth) as loop:
                column = builder.mul(loop.index, stride)
                rows = [_load(builder, builder.gep(left, [builder.add(column, begin)])) for begin in begins]
                across = builder.gep(above, [column])
                for j in range(columns):
                    factor = _spread(builder, builder.gep(across, [_I64(j)]))
                    for v, x in enumerate(rows):
                        place = sums[j * vectors + v]
                        builder.store(_minus_product(builder, builder.load(place), x, factor), place)
            for accumulator, target in zip(sums, targets, strict=True):
                _store(builder, builder.load(accumulator), target)

        together = 2 if "+avx512f" in context.codegen().magic_tuple()[2] else 1
        whole = builder.udiv(strips, _I64(together))
        with cgutils.for_range(builder, whole) as loop:
            tile(builder.mul(loop.index, _I64(ROWS * together)), together)
        with cgutils.for_range_slice(builder, builder.mul(whole, _I64(together)), strips, _I64(1), _I64) as (strip, _):
            tile(builder.mul(strip, _I64(ROWS)), 1)
        return context.get_dummy_value()

    return declared, generate


def _divide(typingctx: Any, L: Any, at: Any, stride: Any, triangle: Any, strips: Any, columns: Any) -> Any:
    """The rows X of a tile, in as many strips of eight from `at` on, become X T^-T; triangle (TILE, TILE): T, its
    diagonal inverted."""
    declared = signature(L, at, stride, triangle, strips, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, triangle, strips, columns = unpacked(context, builder, signature, args)
        T = {
            (j, k): _spread(builder, builder.gep(triangle, [_I64(TILE * j + k)]))
            for j in range(columns) for k in range(j + 1)
        }  # fmt: skip
        with cgutils.for_range(builder, strips) as loop:
            row = builder.add(at, builder.mul(loop.index, _I64(ROWS)))
            done: list[Any] = []
            for j in range(columns):
                pointer = builder.gep(L, [builder.add(row, builder.mul(stride, _I64(j)))])
                x = _load(builder, pointer)
                for k in range(j):
                    x = _minus_product(builder, x, done[k], T[j, k])
                x = builder.fmul(x, T[j, j])
                _store(builder, x, pointer)
                done.append(x)
        return context.get_dummy_value()

    return declared, generate


def _factorise_corner(typingctx: Any, L: Any, at: Any, stride: Any, least: Any, triangle: Any, columns: Any) -> Any:
    """Write the Cholesky factor of a tile's corner, at `at`, to triangle (TILE, TILE), its diagonal inverted; returns
    whether each pivot is above its entry of `least` (TILE,)."""
    declared = types.boolean(*signature(L, at, stride, least, triangle, columns).args)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, least, triangle, columns = unpacked(context, builder, signature, args)
        root = builder.module.declare_intrinsic("llvm.sqrt", [_F64])
        t: dict[tuple[int, int], Any] = {}
        positive: Any = ir.Constant(ir.IntType(1), 1)
        for j in range(columns):
            column = builder.gep(L, [builder.add(at, builder.mul(stride, _I64(j)))])
            for i in range(j, columns):
                entry = builder.load(builder.gep(column, [_I64(i)]))
                for k in range(j):
                    entry = _minus_product(builder, entry, t[i, k], t[j, k])
                if i == j:
                    above = builder.fcmp_ordered(">", entry, builder.load(builder.gep(least, [_I64(j)])))
                    positive = builder.and_(positive, above)
                    t[j, j] = builder.fdiv(_F64(1.0), builder.call(root, [entry]))
                else:
                    t[i, j] = builder.fmul(entry, t[j, j])
                builder.store(t[i, j], builder.gep(triangle, [_I64(TILE * i + j)]))
        return positive

    return declared, generate


def _solve_columns(typingctx: Any, L: Any, at: Any, stride: Any, x: Any, to: Any, strips: Any, columns: Any) -> Any:
    """A tile's pass forwards: x[to + j] for j < columns, by its corner at `at`; what is below, in as many strips of
    eight, less by what that brings."""
    declared = signature(L, at, stride, x, to, strips, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, x, to, strips, columns = unpacked(context, builder, signature, args)
        starts = [builder.gep(L, [builder.add(at, builder.mul(stride, _I64(j)))]) for j in range(columns)]
        x = builder.gep(x, [to])
        y: list[Any] = []
        for j in range(columns):
            value = builder.load(builder.gep(x, [_I64(j)]))
            for k in range(j):
                value = _minus_product(builder, value, builder.load(builder.gep(starts[k], [_I64(j)])), y[k])
            y.append(builder.fmul(value, builder.load(builder.gep(starts[j], [_I64(j)]))))
        for j, value in enumerate(y):
            builder.store(value, builder.gep(x, [_I64(j)]))
        factors = [_wide(builder, value) for value in y]
        with cgutils.for_range(builder, strips) as loop:
            row = builder.add(builder.mul(loop.index, _I64(ROWS)), _I64(columns))
            target = builder.gep(x, [row])
            total = _load(builder, target)
            for start, factor in zip(starts, factors, strict=True):
                total = _minus_product(builder, total, _load(builder, builder.gep(start, [row])), factor)
            _store(builder, total, target)
        return context.get_dummy_value()

    return declared, generate


def _solve_rows(typingctx: Any, L: Any, at: Any, stride: Any, x: Any, to: Any, strips: Any, columns: Any) -> Any:
    """A tile's pass backwards: x[to + j] for j < columns, less by what as many strips of eight below bring, by its
    corner at `at`."""
    declared = signature(L, at, stride, x, to, strips, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, x, to, strips, columns = unpacked(context, builder, signature, args)
        starts = [builder.gep(L, [builder.add(at, builder.mul(stride, _I64(j)))]) for j in range(columns)]
        ahead = builder.mul(stride, _I64(-TILE))
        x = builder.gep(x, [to])
        sums = [cgutils.alloca_once(builder, _WIDE) for _ in range(columns)]
        for accumulator in sums:
            builder.store(ir.Constant(_WIDE, [0.0] * ROWS), accumulator)
        with cgutils.for_range(builder, strips) as loop:
            row = builder.add(builder.mul(loop.index, _I64(ROWS)), _I64(columns))
            factor = _load(builder, builder.gep(x, [row]))
            for start, accumulator in zip(starts, sums, strict=True):
                place = builder.gep(start, [row])
                _prefetch(builder, builder.gep(place, [ahead]))  # of the tile that is next
                builder.store(_minus_product(builder, builder.load(accumulator), _load(builder, place), factor),
                              accumulator)  # fmt: skip
        y: list[Any] = [None] * columns
        for j in range(columns - 1, -1, -1):
            value = builder.fadd(builder.load(builder.gep(x, [_I64(j)])), _total(builder, builder.load(sums[j])))
            for k in range(columns - 1, j, -1):
                value = _minus_product(builder, value, builder.load(builder.gep(starts[j], [_I64(k)])), y[k])
            y[j] = builder.fmul(value, builder.load(builder.gep(starts[j], [_I64(j)])))
            builder.store(y[j], builder.gep(x, [_I64(j)]))
        return context.get_dummy_value()

    return declared, generate


def _add(typingctx: Any, source: Any, at: Any, target: Any, to: Any, count: Any) -> Any:
    """target[to + r] += source[at + r] for r < count; the lanes behind are neither read nor written."""
    declared = types.void(source, at, target, to, count)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, at, target, to, count = unpacked(context, builder, signature, args)
        source, target = builder.gep(source, [at]), builder.gep(target, [to])
        lanes = ir.Constant(ir.VectorType(_I64, ROWS), list(range(ROWS)))
        strips = builder.udiv(builder.add(count, _I64(ROWS - 1)), _I64(ROWS))
        with cgutils.for_range(builder, strips) as loop:
            row = builder.mul(loop.index, _I64(ROWS))
            left = _wide(builder, builder.sub(count, row))
            mask = builder.icmp_signed("<", lanes, left)
            place = builder.gep(target, [row])
            total = builder.fadd(*(_masked(builder, p, mask) for p in (place, builder.gep(source, [row]))))
            _masked(builder, place, mask, total)
        return context.get_dummy_value()

    return declared, generate


# Numba passes the first argument itself, which type checkers do not know.
subtract_product: Any = intrinsic(_subtract_product)
add: Any = intrinsic(_add)
divide: Any = intrinsic(_divide)
factorise_corner: Any = intrinsic(_factorise_corner)
solve_columns: Any = intrinsic(_solve_columns)
solve_rows: Any = intrinsic(_solve_rows)
