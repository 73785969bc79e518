"""SIMD packets of eight float64 in kernels; the same source also computes with scalars.

`+`, `-`, `*` and comparisons act lane by lane on two packets, or on a packet and a float. Comparisons of packets give
masks, which `&` and `|` combine. `where` replaces branches. No product is fused with a sum, so that each lane is
bitwise identical to a scalar computation. `divide_packet` divides without a test for zero; `where` discards such
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
from springbench.solvers.simd.llvm_vectors import I8, I64
from springbench.solvers.simd.spring_packets import LANES, MASK_TYPE, PACKET_TYPE, PacketBuilder


class _Float64x8Type(types.Type):
    """Numba type of a packet of eight float64."""

    def can_convert_from(self, typingctx: Any, other: Any) -> Any:
        """Permit the promotion of a float, which is broadcast to all lanes."""
        return Conversion.promote if isinstance(other, types.Float) else None


class _Mask8Type(types.Type):
    """Numba type of a mask of eight lanes."""


FLOAT64X8, MASK8 = _Float64x8Type("eight float64"), _Mask8Type("eight flags")


@register_model(_Float64x8Type)
class _Float64x8Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, PACKET_TYPE)


@register_model(_Mask8Type)
class _Mask8Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, MASK_TYPE)


@lower_cast(types.Float, FLOAT64X8)
def _broadcast_scalar(context: Any, builder: Any, kind: Any, expected: Any, value: Any) -> Any:
    return PacketBuilder(context, builder).broadcast_scalar(context.cast(builder, value, kind, types.float64), LANES)


def _register_operator(symbol: Any, kind: Any, result: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Register a binary operator of two packets, or of two masks."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            known = kind in args and all(arg is kind or isinstance(arg, types.Float) for arg in args)
            return signature(result, kind, kind) if known and len(args) == 2 else None

    register: Any = infer_global(symbol)
    register(Template)
    lower_builtin(symbol, kind, kind)(lambda context, builder, sig, args: emit(builder, *args))


_register_operator(operator.add, FLOAT64X8, FLOAT64X8, lambda b, x, y: b.fadd(x, y))
_register_operator(operator.sub, FLOAT64X8, FLOAT64X8, lambda b, x, y: b.fsub(x, y))
_register_operator(operator.mul, FLOAT64X8, FLOAT64X8, lambda b, x, y: b.fmul(x, y))
_register_operator(operator.lt, FLOAT64X8, MASK8, lambda b, x, y: b.fcmp_ordered("<", x, y))
_register_operator(operator.le, FLOAT64X8, MASK8, lambda b, x, y: b.fcmp_ordered("<=", x, y))
_register_operator(operator.gt, FLOAT64X8, MASK8, lambda b, x, y: b.fcmp_ordered(">", x, y))
_register_operator(operator.ge, FLOAT64X8, MASK8, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_register_operator(operator.and_, MASK8, MASK8, lambda b, x, y: b.and_(x, y))
_register_operator(operator.or_, MASK8, MASK8, lambda b, x, y: b.or_(x, y))


def _where_code(typingctx: Any, flag: Any, x: Any, y: Any) -> Any:
    """Return x where the flag is set, else y, for floats or packets."""
    kind = FLOAT64X8 if flag is MASK8 else types.float64

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(*args)

    return kind(flag, kind, kind), generate


def _divide_packet_code(typingctx: Any, x: Any, y: Any) -> Any:
    """Return x/y of floats or packets."""
    kind = FLOAT64X8 if FLOAT64X8 in (x, y) else types.float64

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fdiv(*args)

    return kind(kind, kind), generate


def _sqrt_packet_code(typingctx: Any, x: Any) -> Any:
    """Return the square root of a float or a packet."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        name, kind = "llvm.sqrt.v8f64" if x is FLOAT64X8 else "llvm.sqrt.f64", args[0].type
        found = builder.module.globals.get(name) or ir.Function(builder.module, ir.FunctionType(kind, [kind]), name)
        return builder.call(found, args)

    return x(x), generate


def _gather_rows_code(typingctx: Any, x: Any, vertices: Any, first: Any, last: Any, column: Any) -> Any:
    """Gather x, y and z of eight rows of x (n, 4) as packets.

    The rows are those in a column of vertices (m, k), contiguous, from `first` on; lanes beyond `last` repeat that one.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        (kind, known, *_), (rows, named, *numbers), v = signature.args, args, PacketBuilder(context, builder)
        start, names = (context.make_array(a)(context, builder, b) for a, b in ((kind, rows), (known, named)))
        begin, end, at = numbers
        width, places = builder.extract_value(names.shape, 1), []
        for lane in range(LANES):
            here = builder.add(begin, I64(lane))
            here = builder.select(builder.icmp_signed("<", here, end), here, end)
            place = builder.gep(names.data, [builder.add(builder.mul(here, width), at)])
            places.append(builder.mul(builder.load(place), I64(4)))
        return context.make_tuple(builder, signature.return_type, v.gather_rows(start.data, places))

    integers = types.int64, types.int64, types.int64
    return types.UniTuple(FLOAT64X8, 3)(x, vertices, *integers), generate


def _load_packet_code(typingctx: Any, array: Any, place: Any) -> Any:
    """Load eight numbers of a contiguous array from a flat index on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return PacketBuilder(context, builder).load(builder.gep(data, [args[1]]), PACKET_TYPE)

    return FLOAT64X8(array, types.int64), generate


def _store_packet_code(typingctx: Any, value: Any, array: Any, place: Any) -> Any:
    """Store eight numbers in a contiguous array from a flat index on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[1])(context, builder, args[1]).data
        PacketBuilder(context, builder).store(args[0], builder.gep(data, [args[2]]))
        return context.get_dummy_value()

    return types.void(FLOAT64X8, array, types.int64), generate


def _mask_to_bits_code(typingctx: Any, flags: Any) -> Any:
    """Return a mask as the bits of an integer, the first lane lowest."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], I8), I64)

    return types.int64(flags), generate


def _lowest_set_bit_code(typingctx: Any, bits: Any) -> Any:
    """Return the index of the lowest set bit of a nonzero integer."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.IntType(1)(1))

    return types.int64(types.int64), generate


# Numba passes the first argument itself, which type checkers cannot see.
where: Any = intrinsic(_where_code)
divide_packet: Any = intrinsic(_divide_packet_code)
sqrt_packet: Any = intrinsic(_sqrt_packet_code)
gather_rows: Any = intrinsic(_gather_rows_code)
load_packet: Any = intrinsic(_load_packet_code)
store_packet: Any = intrinsic(_store_packet_code)
mask_to_bits: Any = intrinsic(_mask_to_bits_code)
lowest_set_bit: Any = intrinsic(_lowest_set_bit_code)
