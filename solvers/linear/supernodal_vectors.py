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

    def entries(self, pointer: Any, kind: types.Array, lanes: int) -> ir.Value:
        """Entries of a panel of this kind; float16 is widened."""
        if kind.dtype != types.uint16:
            return self.load(pointer, lanes)
        half = ir.VectorType(ir.HalfType(), lanes)
        short = self.builder.load(self.builder.bitcast(pointer, half.as_pointer()), align=2)
        return self.builder.fpext(short, ir.VectorType(self.element, lanes))

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
        # As many rows of x in a vector as make 512 bits of float32; one of float64.
        together = 4 if vectors.narrow else 1
        xs = [vectors.load(builder.gep(x, [_I64(4 * j)]), 4 * together) for j in range(0, 4 * quads, together)]
        with cgutils.for_range(builder, count) as loop:
            row = builder.gep(panel, [builder.mul(loop.index, _I64(4 * quads))])
            vectors.prefetch(row, kind, quads, _AHEAD)
            place = builder.zext(builder.load(builder.gep(index, [loop.index])), _I64)
            target = builder.gep(y, [builder.mul(place, _I64(4))])
            sums = []
            if vectors.narrow:
                pairs = [
                    vectors.entries(builder.gep(row, [_I64(4 * q)]), kind, 4 * min(2, quads - q))
                    for q in range(0, quads, 2)
                ]
                for q in range(quads):
                    w = pairs[q // 2]
                    spread = vectors.shuffle(w, w, [4 * (q % 2) + j // 4 for j in range(16)])
                    sums.append(vectors.multiply_add(spread, xs[q], sums.pop() if q >= 2 else None))
                total = vectors.total(sums)
                for lanes in (8, 4):
                    low = vectors.shuffle(total, total, range(lanes))
                    total = builder.fadd(low, vectors.shuffle(total, total, range(lanes, 2 * lanes)))
                total = builder.fadd(total, vectors.load(target, 4))
            else:
                start = vectors.load(target, 4)
                for q in range(quads):
                    acc = start if q == 0 else None
                    for j in range(4 * q, 4 * q + 4):
                        acc = vectors.multiply_add(vectors.broadcast(builder.gep(row, [_I64(j)]), 4), xs[j], acc)
                    sums.append(acc)
                total = vectors.total(sums)
            vectors.store(total, target)
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
        group = 8 if vectors.narrow else 4  # entries in 256 bits
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
