"""What kernels share that are written with an LLVM builder, and a prefetch for those that are not."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic


def signature(*kinds: Any, compiled_in: int = 1) -> Any:
    """Nothing returned; so many of the last arguments, integers, are compiled in. Raises TypingError."""
    usual, literal = map(types.unliteral, kinds[:-compiled_in]), kinds[-compiled_in:]
    if not all(isinstance(kind, types.IntegerLiteral) for kind in literal):
        raise TypingError(f"the last {compiled_in} arguments must be literal integers")
    return types.void(*usual, *literal)


def unpacked(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    """A kernel's arguments: of arrays where they begin, of numbers int64, of what is compiled in Python's int."""
    out: list[Any] = []
    for kind, value in zip(signature.args, args, strict=True):
        if isinstance(kind, types.Array):
            out.append(context.make_array(kind)(context, builder, value).data)
        elif isinstance(kind, types.IntegerLiteral):
            out.append(kind.literal_value)
        else:
            out.append(context.cast(builder, value, kind, types.int64))
    return out


def ask(builder: Any, pointer: Any, distance: int = 0) -> None:
    """Ask memory for the cache line that lies so many bytes behind a pointer."""
    byte, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [byte, i32, i32, i32])
    at = builder.gep(builder.bitcast(pointer, byte), [ir.IntType(64)(distance)])
    builder.call(builder.module.declare_intrinsic("llvm.prefetch.p0", fnty=kind), [at, i32(0), i32(3), i32(1)])


def _ask_for(typingctx, array, place):
    """Ask memory for the entry of a contiguous array at a place, counted through all its axes."""

    def generate(context, builder, signature, args):
        start, at = unpacked(context, builder, signature, args)
        ask(builder, builder.gep(start, [at]))
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


ask_for: Any = intrinsic(_ask_for)  # Numba passes the first argument itself, which type checkers do not know
