"""Dot products with a fixed order of summation, independent of the compilation.

A compiler that may reorder a sum vectorises it, but in an order that depends on where the code is inlined. The process
that compiles a kernel, and later ones that load it from the cache, would then differ in the last bits. The vectors are
therefore explicit. Four vectors of eight lanes hide the latency of an addition, and lane l adds the terms l, l + 32,
... The vectors and then the lanes are added pairwise, and the remaining terms one by one. Arrays may be float32; sums
are float64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from springbench.solvers.simd.llvm_vectors import F64, I64, VectorBuilder, unpack_arguments
from springbench.solvers.simd.spring_packets import LANES, PACKET_TYPE, constant_packet

_NUM_ACCUMULATORS = 4
"""Number of vectors that accumulate in parallel."""


def _dot_products_code(*pairs: tuple[int, int]) -> Callable[..., Any]:
    """Return the code of the dot products of pairs of arrays.

    The products are over the first `count` entries of the arrays.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        *arrays, count = unpack_arguments(context, builder, signature, args)
        v = VectorBuilder(context, builder)
        whole = builder.and_(count, I64(-_NUM_ACCUMULATORS * LANES))

        def read(array: Any, place: Any, lanes: int) -> Any:
            element_type = array.type.pointee
            narrow, wide = (ir.VectorType(element_type, lanes), PACKET_TYPE) if lanes > 1 else (element_type, F64)
            term = v.load(builder.gep(array, [place]), narrow)
            return term if element_type == F64 else builder.fpext(term, wide)

        def add(place: Any, lanes: int, sums: list[Any]) -> None:
            terms = [read(array, place, lanes) for array in arrays]
            for (a, b), total in zip(pairs, sums, strict=True):
                builder.store(v.multiply_add(terms[a], terms[b], builder.load(total)), total)

        wide = [[cgutils.alloca_once(builder, PACKET_TYPE) for _ in pairs] for _ in range(_NUM_ACCUMULATORS)]
        for total in (total for sums in wide for total in sums):
            builder.store(constant_packet(0.0), total)
        with cgutils.for_range_slice(builder, I64(0), whole, I64(_NUM_ACCUMULATORS * LANES), I64) as (place, _):
            for k, sums in enumerate(wide):
                add(builder.add(place, I64(k * LANES)), LANES, sums)
        sums = [
            cgutils.alloca_once_value(builder, v.sum_lanes(v.sum_pairwise([builder.load(total) for total in totals])))
            for totals in zip(*wide, strict=True)
        ]
        with cgutils.for_range_slice(builder, whole, count, I64(1), I64) as (place, _):
            add(place, 1, sums)
        found = [builder.load(total) for total in sums]
        return found[0] if len(found) == 1 else context.make_tuple(builder, signature.return_type, found)

    return generate


def _dot_code(typingctx: Any, a: Any, b: Any, count: Any) -> Any:
    """Return the dot product of a and b."""
    return types.float64(a, b, count), _dot_products_code((0, 1))


def _dot_pair_code(typingctx: Any, s: Any, w: Any, g: Any, count: Any) -> Any:
    """Return the dot products of s and g, and of w and g."""
    return types.UniTuple(types.float64, 2)(s, w, g, count), _dot_products_code((0, 2), (1, 2))


# Numba passes the first argument itself, which type checkers cannot see.
ordered_dot: Any = intrinsic(_dot_code)
ordered_dot_pair: Any = intrinsic(_dot_pair_code)
