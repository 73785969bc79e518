"""Objective of eight vertices and their springs, and its negative gradient, in explicit LLVM vectors.

See `solvers.kernels.accelerate_springs` for the formula, and `solvers.vectors.springs` for the lanes.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from solvers.vectors.intrinsics import F64, I64, unpacked
from solvers.vectors.springs import LANES, MOST, WIDE, Bundle, Eights, constant


def _bundle(typingctx: Any, bundles: Any, shares: Any, number: Any, x: Any, right: Any, out: Any) -> Any:
    """Write a packet's rows of `out` and return its energy; return -1 without writing if a spring is too short."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bundles, shares, number, x, right, out = unpacked(context, builder, signature, args)
        v, springs = Eights(context, builder), Bundle.of(builder, bundles, number)
        centre = v.gather(x, v.places(springs.own, number))
        sums, shortest = v.sums(4), cgutils.alloca_once_value(builder, constant(MOST))

        def read(entry: Any) -> list[Any]:
            """Load the data of an entry's springs: k r, k, 1/(4 k), and the vector from their other ends."""
            numbers = [*v.eights(springs.weights, springs.kind, entry), *v.eights(shares.shares, shares.kind, entry, 1)]
            return [*numbers, *v.arrow(x, centre, springs.neighbour, entry)]

        def add(values: list[Any]) -> None:
            """Add an entry's springs to the sums."""
            pull, k, share, *arrow = values
            squared = v.dot(arrow)
            v.note_least(squared, shortest)
            scale = builder.fsub(builder.fmul(pull, v.inverse_root(squared)), k)
            energy = builder.fmul(builder.fmul(share, scale), scale)
            v.add_products([scale] * 3 + [energy], [*arrow, squared], sums)

        v.over_entries(springs.begin, springs.end, read, add)
        *total, energy = [builder.load(accumulator) for accumulator in sums]
        short = v.short(shortest)
        with builder.if_then(builder.not_(short), likely=True):
            *constants, held = v.right(right, number)
            away = [v.subtract_product(a, held, b) for a, b in zip(constants, centre, strict=True)]
            half = v.load(builder.gep(shares.inverse, [builder.mul(number, I64(LANES))]), WIDE)
            builder.store(v.multiply_add(half, v.dot(away), energy), sums[3])
            total = [builder.fadd(a, b) for a, b in zip(total, away, strict=True)]
            for place, row in zip(v.places(springs.own, number), v.rows(total), strict=True):
                v.store(row, builder.gep(out, [place]))
        return builder.select(short, F64(-1.0), v.total(builder.load(sums[3])))

    return types.float64(bundles, shares, number, x, right, out), generate


descend: Any = intrinsic(_bundle)  # Numba passes the first argument itself, which type checkers do not know
