"""What kernels share that are written with an LLVM builder, and a prefetch for those that are not.

`contract` lets the target fuse a product with a sum where it can.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

I8, I32, I64, F64 = ir.IntType(8), ir.IntType(32), ir.IntType(64), ir.DoubleType()

_BYTES = {ir.HalfType(): 2, ir.FloatType(): 4}


def signature(*kinds: Any, compiled_in: int = 1) -> Any:
    """Nothing returned; so many of the last arguments, integers, are compiled in. Raises TypingError."""
    usual, literal = map(types.unliteral, kinds[:-compiled_in]), kinds[-compiled_in:]
    if not all(isinstance(kind, types.IntegerLiteral) for kind in literal):
        raise TypingError(f"the last {compiled_in} arguments must be literal integers")
    return types.void(*usual, *literal)


def unpacked(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    """A kernel's arguments: of arrays where they begin, of numbers int64, of what is compiled in Python's int, of named
    tuples the same of each field."""
    return [_unpacked(context, builder, *both) for both in zip(signature.args, args, strict=True)]


def _unpacked(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, types.Array):
        return context.make_array(kind)(context, builder, value).data
    if isinstance(kind, types.IntegerLiteral):
        return kind.literal_value
    if hasattr(kind, "instance_class"):
        fields = [builder.extract_value(value, k) for k in range(len(kind))]
        return kind.instance_class(*(_unpacked(context, builder, *both) for both in zip(kind, fields, strict=True)))
    return context.cast(builder, value, kind, types.int64)


class Vectors:
    """Vectors of numbers, written with a builder. wide: whether registers hold 512 bits."""

    def __init__(self, context: Any, builder: Any) -> None:
        self.builder = builder
        self.wide = "+avx512f" in context.codegen().magic_tuple()[2]

    def load(self, pointer: Any, kind: Any) -> Any:
        """A number or a vector; NumPy promises no more than its items' alignment."""
        return self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()), align=_alignment(kind))

    def store(self, value: Any, pointer: Any) -> None:
        """The same, the other way."""
        place = self.builder.bitcast(pointer, value.type.as_pointer())
        self.builder.store(value, place, align=_alignment(value.type))

    def shuffle(self, a: Any, b: Any, lanes: Any) -> Any:
        """These lanes of two vectors, counted through both."""
        lanes = list(lanes)
        return self.builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, len(lanes)), lanes))

    def spread(self, value: Any, lanes: int) -> Any:
        """A number in all lanes."""
        kind = ir.VectorType(value.type, lanes)
        single = self.builder.insert_element(ir.Constant(kind, ir.Undefined), value, I32(0))
        return self.shuffle(single, single, [0] * lanes)

    def multiply_add(self, a: Any, b: Any, c: Any) -> Any:
        """a b + c; a b for no c."""
        product = self.builder.fmul(a, b, flags=("contract",))
        return product if c is None else self.builder.fadd(product, c, flags=("contract",))

    def subtract_product(self, c: Any, a: Any, b: Any) -> Any:
        """c - a b."""
        return self.builder.fsub(c, self.builder.fmul(a, b, flags=("contract",)), flags=("contract",))

    def total(self, a: Any) -> Any:
        """The sum of the lanes, taken pairwise."""
        return self.paired([self.builder.extract_element(a, I32(lane)) for lane in range(a.type.count)])

    def paired(self, terms: list[Any]) -> Any:
        """The sum of as many terms as a power of two, taken pairwise."""
        while len(terms) > 1:
            terms = [self.builder.fadd(p, q) for p, q in zip(terms[::2], terms[1::2], strict=True)]
        return terms[0]

    def folded(self, a: Any) -> Any:
        """The sum of the lanes, half of them added to the other half."""
        while (count := a.type.count // 2) > 0:
            a = self.builder.fadd(*(self.shuffle(a, a, range(k, k + count)) for k in (0, count)))
        return self.builder.extract_element(a, I32(0))

    def any(self, mask: Any) -> Any:
        """Whether one of eight is true."""
        return self.builder.icmp_unsigned("!=", self.builder.bitcast(mask, I8), I8(0))


def _alignment(kind: Any) -> int:
    return _BYTES.get(getattr(kind, "element", kind), 8)


def ask(builder: Any, pointer: Any, distance: int = 0) -> None:
    """Ask memory for the cache line that lies so many bytes behind a pointer."""
    byte = I8.as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
    at = builder.gep(builder.bitcast(pointer, byte), [I64(distance)])
    builder.call(builder.module.declare_intrinsic("llvm.prefetch.p0", fnty=kind), [at, I32(0), I32(3), I32(1)])


def _ask_for(typingctx: Any, array: Any, place: Any) -> Any:
    """Ask memory for the entry of a contiguous array at a place, counted through all its axes."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        start, at = unpacked(context, builder, signature, args)
        ask(builder, builder.gep(start, [at]))
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


ask_for: Any = intrinsic(_ask_for)  # Numba passes the first argument itself, which type checkers do not know
