"""Products of tall narrow pieces of a front, in LLVM vectors that a compiler does not find by itself.

A front is kept column by column, `stride` numbers from one to the next. A tile is eight rows of six columns, or of
three: its sums stay in registers while the columns to the left pass by, eight rows of each in a vector.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

ROWS, TILE = 8, 6
"""Of a tile, rows and columns (two vertices): its sums and a factor fit the registers of AVX2."""

_I64, _F64 = ir.IntType(64), ir.DoubleType()
_WIDE = ir.VectorType(_F64, ROWS)


def _load(builder: Any, pointer: Any) -> Any:
    return builder.load(builder.bitcast(pointer, _WIDE.as_pointer()), align=8)


def _store(builder: Any, value: Any, pointer: Any) -> None:
    builder.store(value, builder.bitcast(pointer, _WIDE.as_pointer()), align=8)


def _spread(builder: Any, pointer: Any) -> Any:
    """A number in all lanes."""
    single = builder.insert_element(ir.Constant(_WIDE, ir.Undefined), builder.load(pointer), ir.IntType(32)(0))
    return builder.shuffle_vector(single, single, ir.Constant(ir.VectorType(ir.IntType(32), ROWS), [0] * ROWS))


def _minus_product(builder: Any, c: Any, a: Any, b: Any) -> Any:
    """c - a b; `contract` lets the target fuse them where it can."""
    return builder.fsub(c, builder.fmul(a, b, flags=("contract",)), flags=("contract",))


def _arguments(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    """The arrays' data pointers, the integers as int64, and a literal as Python's int."""
    out: list[Any] = []
    for kind, value in zip(signature.args, args, strict=True):
        if isinstance(kind, types.Array):
            out.append(context.make_array(kind)(context, builder, value).data)
        elif isinstance(kind, types.IntegerLiteral):
            out.append(kind.literal_value)
        else:
            out.append(context.cast(builder, value, kind, types.int64))
    return out


def _signature(*kinds: Any) -> Any:
    """Nothing returned; the last argument, the count of columns, is compiled in."""
    if not isinstance(kinds[-1], types.IntegerLiteral):
        raise TypingError("the count of columns must be a literal")
    return types.void(*(types.unliteral(kind) for kind in kinds[:-1]), kinds[-1])


def _subtract_product(typingctx: Any, L: Any, at: Any, top: Any, stride: Any, depth: Any, C: Any, to: Any, step: Any,
                      columns: Any) -> Any:  # fmt: skip
    """C[to + r + step j] -= sum over k < depth of L[at + r + stride k] L[top + j + stride k], r < 8, j < columns."""
    signature = _signature(L, at, top, stride, depth, C, to, step, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, top, stride, depth, C, to, step, columns = _arguments(context, builder, signature, args)
        left, above = builder.gep(L, [at]), builder.gep(L, [top])
        targets = [builder.gep(C, [builder.add(to, builder.mul(step, _I64(j)))]) for j in range(columns)]
        sums = [cgutils.alloca_once(builder, _WIDE) for _ in range(columns)]
        for accumulator, target in zip(sums, targets, strict=True):
            builder.store(_load(builder, target), accumulator)
        with cgutils.for_range(builder, depth) as loop:
            column = builder.mul(loop.index, stride)
            rows = _load(builder, builder.gep(left, [column]))
            across = builder.gep(above, [column])
            for j, accumulator in enumerate(sums):
                factor = _spread(builder, builder.gep(across, [_I64(j)]))
                builder.store(_minus_product(builder, builder.load(accumulator), rows, factor), accumulator)
        for accumulator, target in zip(sums, targets, strict=True):
            _store(builder, builder.load(accumulator), target)
        return context.get_dummy_value()

    return signature, generate


def _divide(typingctx: Any, L: Any, at: Any, stride: Any, triangle: Any, columns: Any) -> Any:
    """Eight rows X of a tile, at `at`, become X T^-T; triangle (TILE, TILE): T, its diagonal inverted."""
    signature = _signature(L, at, stride, triangle, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, triangle, columns = _arguments(context, builder, signature, args)
        done: list[Any] = []
        for j in range(columns):
            pointer = builder.gep(L, [builder.add(at, builder.mul(stride, _I64(j)))])
            x = _load(builder, pointer)
            for k in range(j):
                x = _minus_product(builder, x, done[k], _spread(builder, builder.gep(triangle, [_I64(TILE * j + k)])))
            x = builder.fmul(x, _spread(builder, builder.gep(triangle, [_I64(TILE * j + j)])))
            _store(builder, x, pointer)
            done.append(x)
        return context.get_dummy_value()

    return signature, generate


def _subtract_columns(typingctx: Any, L: Any, at: Any, stride: Any, x: Any, to: Any, strips: Any, y: Any,
                      columns: Any) -> Any:  # fmt: skip
    """x[to + r] -= sum over j < columns of L[at + r + stride j] y[j], for as many strips of eight r."""
    signature = _signature(L, at, stride, x, to, strips, y, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, x, to, strips, y, columns = _arguments(context, builder, signature, args)
        factors = [_spread(builder, builder.gep(y, [_I64(j)])) for j in range(columns)]
        starts = [builder.gep(L, [builder.add(at, builder.mul(stride, _I64(j)))]) for j in range(columns)]
        x = builder.gep(x, [to])
        with cgutils.for_range(builder, strips) as loop:
            row = builder.mul(loop.index, _I64(ROWS))
            target = builder.gep(x, [row])
            total = _load(builder, target)
            for start, factor in zip(starts, factors, strict=True):
                total = _minus_product(builder, total, _load(builder, builder.gep(start, [row])), factor)
            _store(builder, total, target)
        return context.get_dummy_value()

    return signature, generate


def _subtract_rows(typingctx: Any, L: Any, at: Any, stride: Any, x: Any, to: Any, strips: Any, y: Any,
                   columns: Any) -> Any:  # fmt: skip
    """y[j] -= sum over r of L[at + r + stride j] x[to + r], for as many strips of eight r and for j < columns."""
    signature = _signature(L, at, stride, x, to, strips, y, columns)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        L, at, stride, x, to, strips, y, columns = _arguments(context, builder, signature, args)
        starts = [builder.gep(L, [builder.add(at, builder.mul(stride, _I64(j)))]) for j in range(columns)]
        sums = [cgutils.alloca_once(builder, _WIDE) for _ in range(columns)]
        for accumulator in sums:
            builder.store(ir.Constant(_WIDE, [0.0] * ROWS), accumulator)
        x = builder.gep(x, [to])
        with cgutils.for_range(builder, strips) as loop:
            row = builder.mul(loop.index, _I64(ROWS))
            factor = _load(builder, builder.gep(x, [row]))
            for start, accumulator in zip(starts, sums, strict=True):
                column = _load(builder, builder.gep(start, [row]))
                builder.store(_minus_product(builder, builder.load(accumulator), column, factor), accumulator)
        for j, accumulator in enumerate(sums):
            lanes = builder.load(accumulator)
            terms = [builder.extract_element(lanes, ir.IntType(32)(lane)) for lane in range(ROWS)]
            while len(terms) > 1:
                terms = [builder.fadd(a, b) for a, b in zip(terms[::2], terms[1::2], strict=True)]
            place = builder.gep(y, [_I64(j)])
            builder.store(builder.fadd(builder.load(place), terms[0]), place)
        return context.get_dummy_value()

    return signature, generate


def _add(typingctx: Any, source: Any, at: Any, target: Any, to: Any, count: Any) -> Any:
    """target[to + r] += source[at + r] for r < count, a multiple of three."""
    signature = types.void(source, at, target, to, count)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        source, at, target, to, count = _arguments(context, builder, signature, args)
        source, target = builder.gep(source, [at]), builder.gep(target, [to])
        with cgutils.for_range(builder, builder.udiv(count, _I64(ROWS))) as loop:
            row = builder.mul(loop.index, _I64(ROWS))
            place = builder.gep(target, [row])
            _store(builder, builder.fadd(_load(builder, place), _load(builder, builder.gep(source, [row]))), place)
        done = builder.sub(count, builder.urem(count, _I64(ROWS)))
        with cgutils.for_range_slice(builder, done, count, _I64(1), _I64) as (row, _):
            place = builder.gep(target, [row])
            builder.store(builder.fadd(builder.load(place), builder.load(builder.gep(source, [row]))), place)
        return context.get_dummy_value()

    return signature, generate


# Numba passes the first argument itself, which type checkers do not know.
subtract_product: Any = intrinsic(_subtract_product)
add: Any = intrinsic(_add)
divide: Any = intrinsic(_divide)
subtract_columns: Any = intrinsic(_subtract_columns)
subtract_rows: Any = intrinsic(_subtract_rows)
