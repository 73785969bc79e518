"""Shared tools of kernels written with an LLVM builder, and a prefetch for all kernels.

`contract` permits the target to fuse a product with a sum.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.errors import TypingError
from numba.extending import intrinsic

I8, I32, I64, F64 = ir.IntType(8), ir.IntType(32), ir.IntType(64), ir.DoubleType()

_ELEMENT_BYTES = {ir.HalfType(): 2, ir.FloatType(): 4}


def literal_signature(*kinds: Any, compiled_in: int = 1) -> Any:
    """Return a void signature whose last arguments are literal integers.

    Args:
        *kinds: Numba types of the arguments.
        compiled_in: number of arguments at the end that are compiled into the code.

    Raises:
        TypingError: one of these is not a literal integer.
    """
    usual, literal = map(types.unliteral, kinds[:-compiled_in]), kinds[-compiled_in:]
    if not all(isinstance(kind, types.IntegerLiteral) for kind in literal):
        raise TypingError(f"the last {compiled_in} arguments must be literal integers")
    return types.void(*usual, *literal)


def unpack_arguments(context: Any, builder: Any, signature: Any, args: Any) -> list[Any]:
    """Return a kernel's arguments as LLVM values.

    Arrays become pointers to their data, numbers int64, literals Python integers, None stays None, and named tuples are
    unpacked alike.

    Args:
        context, builder: Numba's target context and the builder of the code.
        signature: Numba signature, whose types determine the conversion.
        args: LLVM values of the arguments as Numba passes them.
    """
    return [_unpack_argument(context, builder, *both) for both in zip(signature.args, args, strict=True)]


def _unpack_argument(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, types.Array):
        return context.make_array(kind)(context, builder, value).data
    if isinstance(kind, types.IntegerLiteral):
        return kind.literal_value
    if isinstance(kind, types.NoneType):
        return None
    if hasattr(kind, "instance_class"):
        fields = [builder.extract_value(value, k) for k in range(len(kind))]
        return kind.instance_class(
            *(_unpack_argument(context, builder, *both) for both in zip(kind, fields, strict=True))
        )
    return context.cast(builder, value, kind, types.int64)


class VectorBuilder:
    """Builder of vector code; has_avx512: whether registers have 512 bits."""

    def __init__(self, context: Any, builder: Any) -> None:
        self.builder = builder
        self.has_avx512 = "+avx512f" in context.codegen().magic_tuple()[2]

    def load(self, pointer: Any, kind: Any) -> Any:
        """Load a number or a vector, with the alignment of its items.

        That is the only alignment that NumPy guarantees.

        Args:
            pointer: pointer to the first item, of any type.
            kind: LLVM type of the number or vector.
        """
        return self.builder.load(self.builder.bitcast(pointer, kind.as_pointer()), align=_alignment_of(kind))

    def store(self, value: Any, pointer: Any) -> None:
        """Store a number or a vector, with the alignment of its items.

        Args:
            value: the number or vector.
            pointer: pointer to the first item, of any type.
        """
        place = self.builder.bitcast(pointer, value.type.as_pointer())
        self.builder.store(value, place, align=_alignment_of(value.type))

    def shuffle(self, a: Any, b: Any, lanes: Any) -> Any:
        """Return lanes of two vectors, numbered through both.

        Args:
            a, b: vectors of one type with n lanes.
            lanes: number of each lane of the result, from n on those of b.
        """
        lanes = list(lanes)
        return self.builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, len(lanes)), lanes))

    def broadcast_scalar(self, value: Any, lanes: int) -> Any:
        """Return a vector with a number in all lanes.

        Args:
            value: the number, whose type is that of the lanes.
            lanes: number of lanes.
        """
        kind = ir.VectorType(value.type, lanes)
        single = self.builder.insert_element(ir.Constant(kind, ir.Undefined), value, I32(0))
        return self.shuffle(single, single, [0] * lanes)

    def multiply_add(self, a: Any, b: Any, c: Any) -> Any:
        """Return a b + c, or a b if c is None.

        Args:
            a, b, c: floating-point numbers or vectors of one type.
        """
        product = self.builder.fmul(a, b, flags=("contract",))
        return product if c is None else self.builder.fadd(product, c, flags=("contract",))

    def subtract_product(self, c: Any, a: Any, b: Any) -> Any:
        """Return c - a b.

        Args:
            c, a, b: floating-point numbers or vectors of one type.
        """
        return self.builder.fsub(c, self.builder.fmul(a, b, flags=("contract",)), flags=("contract",))

    def sum_lanes(self, a: Any) -> Any:
        """Return the sum of the lanes, taken pairwise."""
        return self.sum_pairwise([self.builder.extract_element(a, I32(lane)) for lane in range(a.type.count)])

    def sum_pairwise(self, terms: list[Any]) -> Any:
        """Return the sum of a power of two of terms, taken pairwise."""
        while len(terms) > 1:
            terms = [self.builder.fadd(p, q) for p, q in zip(terms[::2], terms[1::2], strict=True)]
        return terms[0]

    def sum_by_halves(self, a: Any) -> Any:
        """Return the sum of the lanes by repeatedly adding one half to the other."""
        while (count := a.type.count // 2) > 0:
            a = self.builder.fadd(*(self.shuffle(a, a, range(k, k + count)) for k in (0, count)))
        return self.builder.extract_element(a, I32(0))

    def any_lane(self, mask: Any) -> Any:
        """Return whether any of eight lanes is true."""
        return self.builder.icmp_unsigned("!=", self.builder.bitcast(mask, I8), I8(0))


def _alignment_of(kind: Any) -> int:
    return _ELEMENT_BYTES.get(getattr(kind, "element", kind), 8)


def prefetch_line(builder: Any, pointer: Any, distance: int = 0) -> None:
    """Prefetch the cache line at a distance from a pointer.

    Args:
        builder: LLVM builder of the code.
        pointer: pointer of any type.
        distance: distance in bytes, which may be negative.
    """
    byte = I8.as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, I32, I32, I32])
    at = builder.gep(builder.bitcast(pointer, byte), [I64(distance)])
    builder.call(builder.module.declare_intrinsic("llvm.prefetch.p0", fnty=kind), [at, I32(0), I32(3), I32(1)])


def _prefetch_entry_code(typingctx: Any, array: Any, place: Any) -> Any:
    """Prefetch the entry of a contiguous array at a flat index."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        start, at = unpack_arguments(context, builder, signature, args)
        prefetch_line(builder, builder.gep(start, [at]))
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


# Numba passes the first argument itself, which type checkers cannot see.
prefetch_entry: Any = intrinsic(_prefetch_entry_code)
