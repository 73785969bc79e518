"""SIMD packets of eight float64 for kernels: the same source computes with scalars and with vector registers.

`+`, `-`, `*` and comparisons act lane by lane on two packets, or on a packet and a float. Comparisons of packets give
masks, which `&` and `|` combine. `where` replaces branches. No product is fused with a sum, so that each lane is
bitwise identical to a scalar computation. `ratio` divides without a test for zero; `where` discards such
results.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

from solvers.vectors.intrinsics import I8, I64
from solvers.vectors.springs import LANES, MASK, WIDE, Eights


class _Eight(types.Type):
    """Numba type of a packet of eight float64."""

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Permit the promotion of a float, which is broadcast to all lanes."""
        return Conversion.promote if isinstance(other, types.Float) else None


class _Flags(types.Type):
    """Numba type of a mask of eight lanes."""


EIGHT, FLAGS = _Eight("eight float64"), _Flags("eight flags")


@register_model(_Eight)
class _EightModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, WIDE)


@register_model(_Flags)
class _FlagsModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, MASK)


@lower_cast(types.Float, EIGHT)
def _spread(context: Any, builder: Any, kind: Any, wanted: Any, value: Any) -> Any:
    return Eights(context, builder).spread(context.cast(builder, value, kind, types.float64), LANES)


def _state(symbol: Any, kind: Any, result: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Register a binary operator of two packets, or of two masks."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            known = kind in args and all(arg is kind or isinstance(arg, types.Float) for arg in args)
            return signature(result, kind, kind) if known and len(args) == 2 else None

    register: Any = infer_global(symbol)
    register(Template)
    lower_builtin(symbol, kind, kind)(lambda context, builder, sig, args: emit(builder, *args))


_state(operator.add, EIGHT, EIGHT, lambda b, x, y: b.fadd(x, y))
_state(operator.sub, EIGHT, EIGHT, lambda b, x, y: b.fsub(x, y))
_state(operator.mul, EIGHT, EIGHT, lambda b, x, y: b.fmul(x, y))
_state(operator.lt, EIGHT, FLAGS, lambda b, x, y: b.fcmp_ordered("<", x, y))
_state(operator.le, EIGHT, FLAGS, lambda b, x, y: b.fcmp_ordered("<=", x, y))
_state(operator.gt, EIGHT, FLAGS, lambda b, x, y: b.fcmp_ordered(">", x, y))
_state(operator.ge, EIGHT, FLAGS, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_state(operator.and_, FLAGS, FLAGS, lambda b, x, y: b.and_(x, y))
_state(operator.or_, FLAGS, FLAGS, lambda b, x, y: b.or_(x, y))


def _choose(typingctx: Any, flag: Any, x: Any, y: Any) -> Any:
    """Return x where the flag is set, else y, for floats or packets."""
    kind = EIGHT if flag is FLAGS else types.float64

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(*args)

    return kind(flag, kind, kind), generate


def _divide(typingctx: Any, x: Any, y: Any) -> Any:
    """Return x/y of floats or packets."""
    kind = EIGHT if EIGHT in (x, y) else types.float64

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fdiv(*args)

    return kind(kind, kind), generate


def _square_root(typingctx: Any, x: Any) -> Any:
    """Return the square root of a float or a packet."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        name, kind = "llvm.sqrt.v8f64" if x is EIGHT else "llvm.sqrt.f64", args[0].type
        found = builder.module.globals.get(name) or ir.Function(builder.module, ir.FunctionType(kind, [kind]), name)
        return builder.call(found, args)

    return x(x), generate


def _rows(typingctx: Any, x: Any, vertices: Any, first: Any, last: Any, column: Any) -> Any:
    """Gather x, y and z of eight rows of x (n, 4) as packets.

    The rows are those in a column of vertices (m, k), contiguous, from `first` on; lanes beyond `last` repeat that one.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        (kind, known, *_), (rows, named, *numbers), v = signature.args, args, Eights(context, builder)
        start, names = (context.make_array(a)(context, builder, b) for a, b in ((kind, rows), (known, named)))
        begin, end, at = numbers
        width, places = builder.extract_value(names.shape, 1), []
        for lane in range(LANES):
            here = builder.add(begin, I64(lane))
            here = builder.select(builder.icmp_signed("<", here, end), here, end)
            place = builder.gep(names.data, [builder.add(builder.mul(here, width), at)])
            places.append(builder.mul(builder.load(place), I64(4)))
        return context.make_tuple(builder, signature.return_type, v.gather(start.data, places))

    integers = types.int64, types.int64, types.int64
    return types.UniTuple(EIGHT, 3)(x, vertices, *integers), generate


def _loaded(typingctx: Any, array: Any, place: Any) -> Any:
    """Load eight numbers of a contiguous array from a flat index on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return Eights(context, builder).load(builder.gep(data, [args[1]]), WIDE)

    return EIGHT(array, types.int64), generate


def _stored(typingctx: Any, value: Any, array: Any, place: Any) -> Any:
    """Store eight numbers in a contiguous array from a flat index on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[1])(context, builder, args[1]).data
        Eights(context, builder).store(args[0], builder.gep(data, [args[2]]))
        return context.get_dummy_value()

    return types.void(EIGHT, array, types.int64), generate


def _as_bits(typingctx: Any, flags: Any) -> Any:
    """Return a mask as the bits of an integer, with the first lane as the lowest bit."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], I8), I64)

    return types.int64(flags), generate


def _lowest_bit(typingctx: Any, bits: Any) -> Any:
    """Return the index of the lowest set bit of a nonzero integer."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(types.int64), generate


# Numba passes the first argument itself, which type checkers cannot see.
where: Any = intrinsic(_choose)
ratio: Any = intrinsic(_divide)
root: Any = intrinsic(_square_root)
rows: Any = intrinsic(_rows)
loaded: Any = intrinsic(_loaded)
stored: Any = intrinsic(_stored)
bits: Any = intrinsic(_as_bits)
lowest: Any = intrinsic(_lowest_bit)
