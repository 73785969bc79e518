"""Scalar products that add up in one order, whoever compiles them.

A sum that may be reordered becomes vectors, but in an order that the compiler chooses anew wherever it puts the code:
the process that compiles a kernel and later ones, which load it, would differ in the last bits. So the vectors are
written here: lane l adds the terms l, l + 8, ..., the lanes are added pairwise, and what is left over one by one.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from solvers.kernels.springs_vectors import F64, I64, LANES, WIDE, Vectors, constant, unpacked


def _sums(*pairs: tuple[int, int]):
    """The code for the scalar products of these pairs of arrays, over their first `count` entries."""

    def generate(context, builder: Any, signature, args):
        *arrays, count = unpacked(context, builder, signature, args)
        v = Vectors(context, builder)
        whole = builder.and_(count, I64(-LANES))

        def add(place: Any, kind: ir.Type, sums: list[Any]) -> None:
            terms = [v.load(builder.gep(array, [place]), kind) for array in arrays]
            for (a, b), total in zip(pairs, sums, strict=True):
                builder.store(v.multiply_add(terms[a], terms[b], builder.load(total)), total)

        lanes = [cgutils.alloca_once_value(builder, constant(0.0)) for _ in pairs]
        with cgutils.for_range_slice(builder, I64(0), whole, I64(LANES), I64) as (place, _):
            add(place, WIDE, lanes)
        sums = [cgutils.alloca_once_value(builder, v.total(builder.load(total))) for total in lanes]
        with cgutils.for_range_slice(builder, whole, count, I64(1), I64) as (place, _):
            add(place, F64, sums)
        found = [builder.load(total) for total in sums]
        return found[0] if len(found) == 1 else context.make_tuple(builder, signature.return_type, found)

    return generate


def _dot(typingctx, a, b, count):
    """a b."""
    return types.float64(a, b, count), _sums((0, 1))


def _dots(typingctx, s, w, g, y, count):
    """s g, s y, w g and w y."""
    return types.UniTuple(types.float64, 4)(s, w, g, y, count), _sums((0, 2), (0, 3), (1, 2), (1, 3))


# Numba passes the first argument itself, which type checkers do not know.
dot: Any = intrinsic(_dot)
dots: Any = intrinsic(_dots)
