"""A panel times four interleaved right-hand sides, both ways, in LLVM vectors that a compiler does not find by itself.

A panel W has rows of 4 m entries (m = 1 to 4), one after the other; a work vector has rows of 4: x, y, z and padding.
In a pass forwards, row r of W meets the panel's 4 m rows of x, which stay in registers, and its result is added to the
row of y that `index` names. In a pass backwards each row of y that `index` names meets its row of W, four columns
of which are a vector, and the sums are transposed at the end: no padding is multiplied. Panels have the work vector's
type, or are float16, seen as uint16, beside float32.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

_I32 = ir.IntType(32)
_I64 = ir.IntType(64)
_I8P = ir.IntType(8).as_pointer()
_AHEAD = 2048
"""How many bytes ahead a panel is asked for: rows are short, and the hardware's own guess comes too late."""


class _Vectors:
    """Vectors of the element type of the work vector, written with a builder."""

    def __init__(self, context, builder, element: types.Float) -> None:
        self.builder = builder
        self.element = context.get_value_type(element)
        self.size = element.bitwidth // 8
        self.narrow = element.bitwidth == 32

    def zero(self, lanes: int) -> ir.Constant:
        return ir.Constant(ir.VectorType(self.element, lanes), [0.0] * lanes)

    def load(self, pointer: ir.Value, lanes: int) -> ir.Value:
        wide = self.builder.bitcast(pointer, ir.VectorType(self.element, lanes).as_pointer())
        return self.builder.load(wide, align=self.size)

    def entries(self, pointer: Any, kind: types.Array, lanes: int, times: int = 1) -> ir.Value:
        """Entries of a panel of this kind, all of them so many times; float16 is widened."""
        half = kind.dtype == types.uint16
        stored = ir.VectorType(ir.HalfType() if half else self.element, lanes)
        found = self.builder.load(self.builder.bitcast(pointer, stored.as_pointer()), align=2 if half else self.size)
        if times > 1:
            found = self.shuffle(found, found, list(range(lanes)) * times)
        return self.builder.fpext(found, ir.VectorType(self.element, lanes * times)) if half else found

    def interleaved(self, rows: list[Any]) -> Any:
        """Two or four vectors as one: the first entries of all, then the second ones, ..."""
        while len(rows) > 1:
            half = len(rows) // 2
            lanes = rows[0].type.count
            mixed = [k + side * lanes for k in range(lanes) for side in range(2)]
            rows = [self.shuffle(a, b, mixed) for a, b in zip(rows[:half], rows[half:], strict=True)]
        return rows[0]

    def summed(self, rows: list[Any]) -> list[Any]:
        """Of two or four vectors of as many neighbours four times, the sums of neighbours: four of each vector."""
        many, size = len(rows), 1
        while len(rows) > 1:  # each vector now holds parts of the sums of `size` of them
            half = many // 2
            sides = [
                [4 * many * k + c * many + i + j
                 for c in range(4) for i in range(begin, begin + half, size) for k in range(2) for j in range(size)]
                for begin in (0, half)
            ]  # fmt: skip
            rows = [
                self.builder.fadd(*(self.shuffle(a, b, lanes) for lanes in sides))
                for a, b in zip(rows[::2], rows[1::2], strict=True)
            ]
            size *= 2
        return [self.shuffle(rows[0], rows[0], [c * many + r for c in range(4)]) for r in range(many)]

    def prefetch(self, row: ir.Value, kind: Any, quads: int, distance: int) -> None:
        """Ask for the cache lines `distance` bytes on from a row of a panel of this kind."""
        call = self.builder.module.declare_intrinsic(
            "llvm.prefetch.p0", fnty=ir.FunctionType(ir.VoidType(), [_I8P, _I32, _I32, _I32])
        )
        byte = self.builder.bitcast(row, _I8P)
        for line in range(0, quads * kind.dtype.bitwidth // 2, 64):
            self.builder.call(call, [self.builder.gep(byte, [_I64(distance + line)]), _I32(0), _I32(3), _I32(1)])

    def store(self, value: Any, pointer: ir.Value) -> None:
        wide = self.builder.bitcast(pointer, value.type.as_pointer())
        self.builder.store(value, wide, align=self.size)

    def shuffle(self, a: ir.Value, b: ir.Value, lanes) -> ir.Value:
        lanes = list(lanes)
        return self.builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, len(lanes)), lanes))

    def broadcast(self, pointer: ir.Value, lanes: int) -> ir.Value:
        single = self.builder.insert_element(self.zero(lanes), self.builder.load(pointer, align=self.size), _I32(0))
        return self.shuffle(single, single, [0] * lanes)

    def multiply_add(self, a: ir.Value, b: ir.Value, c: ir.Value | None) -> ir.Value:
        """a b + c; a b for no c. `contract` lets the target fuse them where it can."""
        product = self.builder.fmul(a, b, flags=("contract",))
        return product if c is None else self.builder.fadd(product, c, flags=("contract",))

    def total(self, terms: list[ir.Value]) -> ir.Value:
        """The sum, taken pairwise: a short chain of dependent additions."""
        while len(terms) > 1:
            pairs = [self.builder.fadd(a, b) for a, b in zip(terms[::2], terms[1::2], strict=False)]
            terms = pairs + terms[len(pairs) * 2 :]
        return terms[0]


def _arguments(context, builder, signature, args):
    """The arrays' data pointers, the integers as int64, and the last, a literal, as Python's int."""
    out = []
    for kind, value in zip(signature.args[:-1], args, strict=False):
        if isinstance(kind, types.Array):
            out.append(context.make_array(kind)(context, builder, value).data)
        else:
            out.append(context.cast(builder, value, kind, types.int64))
    return [*out, signature.args[-1].literal_value]


def _signature(*kinds):
    """Nothing returned; the last argument, the count of quads, is compiled in."""
    if not isinstance(kinds[-1], types.IntegerLiteral):
        raise TypingError("the count of quads must be a literal")
    return types.void(*(types.unliteral(kind) for kind in kinds[:-1]), kinds[-1])


def _add_forward(typingctx, panel, offset, index, at, count, x, x_row, y, y_row, quads):
    """y[y_row + index[at + r]] += sum_j panel[offset + 4 quads r + j] x[x_row + j], for r < count."""
    signature = _signature(panel, offset, index, at, count, x, x_row, y, y_row, quads)

    def generate(context, builder, signature, args):
        panel, offset, index, at, count, x, x_row, y, y_row, quads = _arguments(context, builder, signature, args)
        kind = signature.args[0]
        vectors = _Vectors(context, builder, signature.args[7].dtype)
        panel = builder.gep(panel, [offset])
        index = builder.gep(index, [at])
        x = builder.gep(x, [builder.mul(x_row, _I64(4))])
        y = builder.gep(y, [builder.mul(y_row, _I64(4))])
        # 512 bits are as many columns of W as x has numbers in a row, for each of these numbers.
        together = 4 if vectors.narrow else 2
        rows = [vectors.load(builder.gep(x, [_I64(4 * j)]), 4) for j in range(4 * quads)]
        xs = [vectors.interleaved(rows[j : j + together]) for j in range(0, 4 * quads, together)]

        def product(r):
            """Row r times x, before the sums over columns that lie side by side."""
            row = builder.gep(panel, [builder.mul(r, _I64(4 * quads))])
            vectors.prefetch(row, kind, quads, _AHEAD)
            total = None
            for j, wide in enumerate(xs):
                w = vectors.entries(builder.gep(row, [_I64(together * j)]), kind, together, 4)
                total = vectors.multiply_add(w, wide, total)
            return total

        def add(r, row):
            place = builder.zext(builder.load(builder.gep(index, [r])), _I64)
            target = builder.gep(y, [builder.mul(place, _I64(4))])
            vectors.store(builder.fadd(row, vectors.load(target, 4)), target)

        whole = builder.udiv(count, _I64(together))
        with cgutils.for_range(builder, whole) as loop:
            first = builder.mul(loop.index, _I64(together))
            places = [builder.add(first, _I64(k)) for k in range(together)]
            for r, row in zip(places, vectors.summed([product(r) for r in places]), strict=True):
                add(r, row)
        done = builder.mul(whole, _I64(together))
        with cgutils.for_range(builder, builder.sub(count, done)) as loop:
            r = builder.add(done, loop.index)
            add(r, vectors.summed([product(r)] * together)[0])
        return context.get_dummy_value()

    return signature, generate


def _set_backward(typingctx, square, start, own, panel, offset, index, at, below, y, x_row, quads):
    """y[x_row + j] = sum over r < own of square[start + 4 quads r + j] y[x_row + r]
    + sum over r < below of panel[offset + 4 quads r + j] y[index[at + r]]."""
    signature = _signature(square, start, own, panel, offset, index, at, below, y, x_row, quads)

    def generate(context, builder, signature, args):
        square, start, own, panel, offset, index, at, below, y, x_row, quads = _arguments(
            context, builder, signature, args
        )
        square_kind, panel_kind = signature.args[0], signature.args[3]
        vectors = _Vectors(context, builder, signature.args[8].dtype)
        square = builder.gep(square, [start])
        panel = builder.gep(panel, [offset])
        index = builder.gep(index, [at])
        out = builder.gep(y, [builder.mul(x_row, _I64(4))])
        group = 16 if vectors.narrow else 8  # entries in 512 bits
        groups = [(j, min(group, 4 * quads - j)) for j in range(0, 4 * quads, group)]
        # Enough sums side by side to hide the latency of an addition.
        unroll = max(1, 4 // len(groups))
        sums = [
            [[cgutils.alloca_once_value(builder, vectors.zero(lanes)) for _ in range(3)] for _, lanes in groups]
            for _ in range(unroll)
        ]
        for accumulators in sums:  # alloca_once_value sets them at the entry of the function alone
            for (_, lanes), triple in zip(groups, accumulators, strict=True):
                for accumulator in triple:
                    builder.store(vectors.zero(lanes), accumulator)

        def add(row, kind, source, accumulators):
            for (j, lanes), triple in zip(groups, accumulators, strict=True):
                w = vectors.entries(builder.gep(row, [_I64(j)]), kind, lanes)
                for c, accumulator in enumerate(triple):
                    factor = vectors.broadcast(builder.gep(source, [_I64(c)]), lanes)
                    builder.store(vectors.multiply_add(w, factor, builder.load(accumulator)), accumulator)

        def add_below(r, accumulators):
            row = builder.gep(panel, [builder.mul(r, _I64(4 * quads))])
            vectors.prefetch(row, panel_kind, quads, -_AHEAD)
            place = builder.zext(builder.load(builder.gep(index, [r])), _I64)
            add(row, panel_kind, builder.gep(y, [builder.mul(place, _I64(4))]), accumulators)

        # From the last row to the first: the panels are then read strictly downwards, as they were read upwards before,
        # so that what is still in the cache is read first.
        last = builder.sub(below, _I64(1))
        whole = builder.udiv(below, _I64(unroll))
        with cgutils.for_range(builder, whole) as loop:
            first = builder.sub(last, builder.mul(loop.index, _I64(unroll)))
            for k in range(unroll):
                add_below(builder.sub(first, _I64(k)), sums[k])
        if unroll > 1:
            with cgutils.for_range(builder, builder.urem(below, _I64(unroll))) as loop:
                add_below(loop.index, sums[0])
        bottom = builder.sub(own, _I64(1))
        with cgutils.for_range(builder, own) as loop:
            r = builder.sub(bottom, loop.index)
            row = builder.gep(square, [builder.mul(r, _I64(4 * quads))])
            vectors.prefetch(row, square_kind, quads, -_AHEAD)
            add(row, square_kind, builder.gep(out, [builder.mul(r, _I64(4))]), sums[-1])

        for g, (j, lanes) in enumerate(groups):
            a, b, c = (vectors.total([builder.load(s[g][k]) for s in sums]) for k in range(3))
            ab = vectors.shuffle(a, b, range(2 * lanes))
            c0 = vectors.shuffle(c, vectors.zero(lanes), range(2 * lanes))
            for i in range(lanes):
                row = vectors.shuffle(ab, c0, [i, lanes + i, 2 * lanes + i, 3 * lanes + i])
                vectors.store(row, builder.gep(out, [_I64(4 * (j + i))]))
        return context.get_dummy_value()

    return signature, generate


# Numba passes the first argument itself, which type checkers do not know.
add_forward: Any = intrinsic(_add_forward)
set_backward: Any = intrinsic(_set_backward)
