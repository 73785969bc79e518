"""Forces of the springs of eight vertices, and their norm, in LLVM vectors (see `solvers.vectors.springs`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from solvers.vectors.intrinsics import I64, unpacked
from solvers.vectors.springs import LANES, MOST, WIDE, Bundle, Eights, constant


def _over_bundle(correct: bool) -> Callable[..., Any]:
    """Return the code that adds a packet's forces to rows of `out`, or none if a spring is too short, which it returns.

    correct: whether to add the negative gradient; else the constant right-hand side and the spring
    projections.
    """

    def declare(typingctx: Any, bundles: Any, number: Any, x: Any, right: Any, out: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            bundles, number, x, right, out = unpacked(context, builder, signature, args)
            v, springs = Eights(context, builder), Bundle.of(builder, bundles, number)
            places = v.places(springs.own, number)
            centre = v.gather(x, places)
            v.ask_ahead(springs, places, right, out)
            sums, short = _sums(v, springs, x, centre, correct)
            with builder.if_then(builder.not_(short), likely=True):
                *constants, held = v.right(right, number)
                total = [builder.fadd(a, b) for a, b in zip(sums, constants, strict=True)]
                if correct:
                    total = [v.subtract_product(a, held, b) for a, b in zip(total, centre, strict=True)]
                places = v.places(springs.own, number)  # again: they would not stay in registers
                for place, row in zip(places, v.rows(total, out.type.pointee), strict=True):
                    v.add_to(builder.gep(out, [place]), row)
            return short

        return types.boolean(bundles, number, x, right, out), generate

    return declare


def _sums(v: Eights, springs: Bundle, x: Any, centre: list[Any], correct: bool) -> tuple[list[Any], Any]:
    """Return the sums of a packet's springs, (k r/|v| - k) v or k r/|v| v, and whether a spring is too short."""
    builder: Any = v.builder
    sums, shortest = v.sums(3), cgutils.alloca_once_value(builder, constant(MOST))

    def read(entry: Any) -> list[Any]:
        """Load the data of an entry's springs: k r, k, and the vector from their other ends with its square."""
        arrow = v.arrow(x, centre, springs.neighbour, entry)
        return [*v.eights(springs.weights, springs.kind, entry), v.dot(arrow), *arrow]

    def scale(values: list[Any]) -> list[Any]:
        """Return the factor of the vectors, as an estimate and its correction terms."""
        pull, stiffness, squared, *arrow = values
        v.note_least(squared, shortest)
        y, e = v.guess(squared)
        guess = builder.fmul(pull, y)
        more = builder.fmul(guess, e)
        return [builder.fsub(guess, stiffness) if correct else guess, more, e, *arrow]

    def add(values: list[Any]) -> None:
        """Add an entry's springs to the sums."""
        guess, more, e, *arrow = values
        v.add_products([v.multiply_add(more, v.correction(e), guess)] * 3, arrow, sums)

    v.over_entries(springs.begin, springs.end, read, scale, add)
    return [builder.load(total) for total in sums], v.short(shortest)


def _energy(typingctx: Any, bundles: Any, number: Any, x: Any, measure: Any) -> Any:
    """Return a packet's share of the squared norm of x: half of its springs', and `measure` times squared positions."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        bundles, number, x, measure = unpacked(context, builder, signature, args)
        v, springs = Eights(context, builder), Bundle.of(builder, bundles, number)
        centre, (total,) = v.gather(x, v.places(springs.own, number)), v.sums(1)

        def read(entry: Any) -> list[Any]:
            arrow = v.arrow(x, centre, springs.neighbour, entry)
            return [v.eights(springs.weights, springs.kind, entry)[1], v.dot(arrow)]

        def add(values: list[Any]) -> None:
            v.add_products(values[:1], values[1:], [total])

        v.over_entries(springs.begin, springs.end, read, add)
        held = v.load(builder.gep(measure, [builder.mul(number, I64(LANES))]), WIDE)
        return v.total(v.multiply_add(v.dot(centre), held, builder.fmul(constant(0.5), builder.load(total))))

    return types.float64(bundles, number, x, measure), generate


# Numba passes the first argument itself, which type checkers cannot see.
project: Any = intrinsic(_over_bundle(correct=False))
correct: Any = intrinsic(_over_bundle(correct=True))
energy: Any = intrinsic(_energy)
