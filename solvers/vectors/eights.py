"""Eight float64 as one number of a kernel: the same source computes with one, and with eight in a vector register.

`+`, `-`, `*` and comparisons take two of them, or one and a float, lane by lane; comparisons of eight give eight flags,
which `&` and `|` join. What a kernel would branch on it chooses with `where`. No product is fused with a sum, so that
each lane has the bits that a float would have. `ratio` divides without asking what by: what it makes of zero, `where`
leaves out.
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
    """Eight float64."""

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """A float is eight times itself."""
        return Conversion.promote if isinstance(other, types.Float) else None


class _Flags(types.Type):
    """Eight truth values."""


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
    """What an operator of two makes of two eights, or of flags."""

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
    """x where the flag is set, else y, of floats or of eights."""
    kind = EIGHT if flag is FLAGS else types.float64

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(*args)

    return kind(flag, kind, kind), generate


def _divide(typingctx: Any, x: Any, y: Any) -> Any:
    """x/y of floats or of eights."""
    kind = EIGHT if EIGHT in (x, y) else types.float64

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fdiv(*args)

    return kind(kind, kind), generate


def _square_root(typingctx: Any, x: Any) -> Any:
    """The square root of a float or of eight."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        name, kind = "llvm.sqrt.v8f64" if x is EIGHT else "llvm.sqrt.f64", args[0].type
        found = builder.module.globals.get(name) or ir.Function(builder.module, ir.FunctionType(kind, [kind]), name)
        return builder.call(found, args)

    return x(x), generate


def _rows(typingctx: Any, x: Any, vertices: Any, first: Any, last: Any, column: Any) -> Any:
    """x, y and z of the rows of x (n, 4) that vertices (m, k), contiguous, have in a column, of eight from `first` on;
    beyond `last`, of that one."""

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
    """Eight numbers of a contiguous array from a place on, counted through all its axes."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return Eights(context, builder).load(builder.gep(data, [args[1]]), WIDE)

    return EIGHT(array, types.int64), generate


def _stored(typingctx: Any, value: Any, array: Any, place: Any) -> Any:
    """Write eight numbers to a contiguous array from a place on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[1])(context, builder, args[1]).data
        Eights(context, builder).store(args[0], builder.gep(data, [args[2]]))
        return context.get_dummy_value()

    return types.void(EIGHT, array, types.int64), generate


def _as_bits(typingctx: Any, flags: Any) -> Any:
    """Flags as the bits of a number, that of the first lane the lowest."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], I8), I64)

    return types.int64(flags), generate


def _lowest_bit(typingctx: Any, bits: Any) -> Any:
    """Which bit of a number that is not zero is the lowest."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(types.int64), generate


# Numba passes the first argument itself, which type checkers do not know.
where: Any = intrinsic(_choose)
ratio: Any = intrinsic(_divide)
root: Any = intrinsic(_square_root)
rows: Any = intrinsic(_rows)
loaded: Any = intrinsic(_loaded)
stored: Any = intrinsic(_stored)
bits: Any = intrinsic(_as_bits)
lowest: Any = intrinsic(_lowest_bit)
