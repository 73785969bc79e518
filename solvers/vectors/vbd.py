"""The Newton steps of eight vertices of one colour, in LLVM vectors (see `solvers.vectors.springs`)."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from solvers.vectors.intrinsics import unpacked
from solvers.vectors.springs import I64, LANES, LEAST, MASK, WIDE, Vectors, constant

NUMBERS = 4
"""What is kept of each spring between the two passes: its vector and its length."""

_ROUND_OFF = 1e-14
"""Pivots up to this share of the diagonal's sum are round-off, of some ten springs."""

_ZERO, _HALF, _ONE = constant(0.0), constant(0.5), constant(1.0)


def _newton(v: Vectors, block: list[Any], g: list[Any]) -> tuple[list[Any], Any]:
    """-B^-1 g for B = [[a, b, c], [b, d, e], [c, e, f]] by its factors L D L', and where B is positive definite."""
    builder: Any = v.builder
    a, b, c, d, e, f = block
    by_a = builder.fdiv(_ONE, a)
    l1, l2 = builder.fmul(b, by_a), builder.fmul(c, by_a)
    second = v.subtract_product(d, l1, b)
    by_second = builder.fdiv(_ONE, second)
    below = v.subtract_product(e, l2, b)
    l3 = builder.fmul(below, by_second)
    third = v.subtract_product(v.subtract_product(f, l2, c), l3, below)
    y1 = v.subtract_product(g[1], l1, g[0])
    y2 = v.subtract_product(v.subtract_product(g[2], l2, g[0]), l3, y1)
    x2 = builder.fdiv(builder.fsub(_ZERO, y2), third)
    x1 = v.subtract_product(builder.fmul(builder.fsub(_ZERO, y1), by_second), l3, x2)
    x0 = v.subtract_product(builder.fmul(builder.fsub(_ZERO, g[0]), by_a), l1, x1)
    x0 = v.subtract_product(x0, l2, x2)
    least = builder.fmul(constant(_ROUND_OFF), builder.fadd(builder.fadd(a, d), f))
    large = [builder.fcmp_ordered(">", pivot, least) for pivot in (a, second, third)]
    return [x0, x1, x2], builder.and_(builder.and_(large[0], large[1]), large[2])


def _bundle(typingctx, x, own, bundle, neighbour, kind, weights, begin, end, right, majorant, near):
    """A bundle's code: moves its vertices in x, and returns whether a spring is too short, when it moves none."""

    def generate(context, builder: Any, signature, args):
        x, own, bundle, neighbour, kind, weights, begin, end, right, majorant, near = unpacked(
            context, builder, signature, args
        )
        v = Vectors(context, builder)
        places = v.places(own, bundle)

        def kept(entry):
            begins = builder.mul(builder.sub(entry, begin), I64(LANES * NUMBERS))
            return [builder.gep(near, [builder.add(begins, I64(LANES * k))]) for k in range(NUMBERS)]

        centre = v.gather(x, places)
        *constants, weight = v.right(right, bundle)
        load = [v.subtract_product(here, weight, p) for here, p in zip(constants, centre, strict=True)]
        # Minus the gradient, then the block's upper triangle, row by row.
        first = [*load, weight, _ZERO, _ZERO, weight, _ZERO, weight]
        sums = [cgutils.alloca_once_value(builder, value) for value in first]
        short = cgutils.alloca_once_value(builder, ir.Constant(MASK, [0] * LANES))
        with cgutils.for_range_slice(builder, begin, end, I64(1), I64) as (entry, _):
            others = v.gather(x, v.places(neighbour, entry))
            arrow = [builder.fsub(a, b) for a, b in zip(centre, others, strict=True)]
            squared = v.dot(arrow)
            tiny = builder.fcmp_ordered("<=", squared, constant(LEAST))
            builder.store(builder.or_(builder.load(short), tiny), short)
            root = v.inverse_root(v.clamped(squared))
            for value, pointer in zip([*arrow, builder.fmul(squared, root)], kept(entry), strict=True):
                builder.store(value, builder.bitcast(pointer, WIDE.as_pointer()), align=8)
            pull, k = v.eights(weights, kind, entry)
            inward = builder.fmul(pull, root)
            tension = builder.fsub(inward, k)
            # A spring whose k is negative is a form's, has no rest length and is never compressed.
            compressed = [builder.fcmp_ordered(">", force, _ZERO) for force in (tension, inward)]
            lateral = builder.select(builder.and_(*compressed), _ZERO, builder.fsub(_ZERO, tension))
            axial = builder.fsub(k, lateral)
            n = [builder.fmul(component, root) for component in arrow]
            along = [builder.fmul(axial, component) for component in n]
            added = [(tension, component) for component in arrow]
            added += [(along[i], n[j]) for i in range(3) for j in range(i, 3)]
            for index, ((one, other), accumulator) in enumerate(zip(added, sums, strict=True)):
                total = v.multiply_add(one, other, builder.load(accumulator))
                builder.store(builder.fadd(total, lateral) if index in (3, 6, 8) else total, accumulator)
        force, block = [builder.load(s) for s in sums[:3]], [builder.load(s) for s in sums[3:]]
        d, definite = _newton(v, block, [builder.fsub(_ZERO, component) for component in force])

        # By how much the step raises the energy, from differences of lengths, which do not cancel.
        half = builder.fmul(_HALF, weight)
        rise = builder.fmul(half, v.dot(d))
        for component, own_force in zip(d, load, strict=True):
            rise = v.subtract_product(rise, component, own_force)
        rises = cgutils.alloca_once_value(builder, rise)
        with cgutils.for_range_slice(builder, begin, end, I64(1), I64) as (entry, _):
            *arrow, length = [v.load(pointer, WIDE) for pointer in kept(entry)]
            moved = [builder.fadd(a, b) for a, b in zip(arrow, d, strict=True)]
            squared = v.dot(moved)
            both = v.multiply_add(squared, v.inverse_root(v.clamped(squared)), length)
            change = builder.fmul(builder.fadd(arrow[0], moved[0]), d[0])
            for c in (1, 2):
                change = v.multiply_add(builder.fadd(arrow[c], moved[c]), d[c], change)
            pull, k = v.eights(weights, kind, entry)
            factor = builder.fsub(builder.fmul(_HALF, k), builder.fdiv(pull, both))
            builder.store(v.multiply_add(factor, change, builder.load(rises)), rises)
        better = builder.and_(definite, builder.fcmp_ordered("<=", builder.load(rises), _ZERO))
        scale = builder.fdiv(_ONE, v.load(builder.gep(majorant, [builder.mul(bundle, I64(LANES))]), WIDE))
        safe = [builder.fmul(scale, component) for component in force]
        ends = [builder.fadd(p, builder.select(better, a, b)) for p, a, b in zip(centre, d, safe, strict=True)]
        any_short = v.any(builder.load(short))
        with builder.if_then(builder.not_(any_short), likely=True):
            for place, row in zip(places, v.rows(ends), strict=True):
                builder.store(row, builder.bitcast(builder.gep(x, [place]), row.type.as_pointer()), align=8)
        return any_short

    arguments = x, own, bundle, neighbour, kind, weights, begin, end, right, majorant, near
    return types.boolean(*arguments), generate


# Numba passes the first argument itself, which type checkers do not know.
descend: Any = intrinsic(_bundle)
