"""The springs of eight vertices at a time, in LLVM vectors that a compiler does not find by itself.

Positions have rows of four numbers, x, y, z and padding: one load brings a vertex, and eight loaded rows are transposed
into vectors of x, y and z. Lane l holds a spring of vertex l, so that no two lanes add to one place. A row is named by
the place of its first number: processors add that to an address for nothing, and instructions are what these loops
take time for.

    1/|v|   from a guess, e = 1 - s y^2, y <- y (1 - e)^(-1/2) by its series, to about one unit in the last place:
            from AVX-512's estimate, 2^-14 off, by a step of degree 3;
            from one by Lomont's trick (2003), 3.4 % off, by a step of degree 4 and one of degree 2
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from llvmlite import ir
from numba.core import cgutils

from solvers.energies.springs import TINY
from solvers.vectors.intrinsics import F64, I8, I64, Vectors, ask

LANES = 8
RIGHT = 4 * LANES
"""Numbers of a bundle's constant right-hand side: x, y and z of eight vertices, and what holds each [N/m]."""
ROW, WIDE, MASK = ir.VectorType(F64, 4), ir.VectorType(F64, LANES), ir.VectorType(ir.IntType(1), LANES)
BITS = ir.VectorType(I64, LANES)
_GUESS, _ESTIMATE = 0x5FE6EB50C7B537A9, "llvm.x86.avx512.rsqrt14.pd.512"
LEAST, MOST = TINY * TINY, 1.7e308
"""Between these, a squared length has a guess that is finite."""

AHEAD = 128
"""How many rows ahead memory is asked for what is read once an iteration: of large meshes it is in no cache by then."""


def constant(value: float) -> ir.Constant:
    """Eight times one number."""
    return ir.Constant(WIDE, [value] * LANES)


class Bundle(NamedTuple):
    """The springs of eight vertices in memory: where the arrays of `solvers.kernels.springs.Bundles` begin, the
    bundle's number, and its first entry and the one behind its last."""

    own: Any
    neighbour: Any
    kind: Any
    weights: Any
    number: Any
    begin: Any
    end: Any

    @classmethod
    def of(cls, builder: Any, bundles: Any, number: Any) -> Bundle:
        """The bundle of this number."""
        begin, end = (builder.load(builder.gep(bundles.start, [builder.add(number, I64(k))])) for k in (0, 1))
        return cls(bundles.own, bundles.neighbour, bundles.kind, bundles.weights, number, begin, end)


class Eights(Vectors):
    """Vectors of eight float64: of the springs that end at eight vertices, one each."""

    def places(self, indices: Any, bundle: Any) -> list[Any]:
        """The places of eight rows, the bundle's of those that are listed, int32."""
        b = self.builder
        first = b.mul(bundle, I64(LANES))
        return [b.zext(b.load(b.gep(indices, [b.add(first, I64(lane))])), I64) for lane in range(LANES)]

    def gather(self, array: Any, places: list[Any]) -> list[Any]:
        """x, y and z of eight rows."""
        rows = [self.load(self.builder.gep(array, [place]), ROW) for place in places]
        pairs = [self.shuffle(rows[lane], rows[lane + 2], list(range(8))) for lane in (0, 1, 4, 5)]
        low = [0, 8, 2, 10, 4, 12, 6, 14]
        xz = [self.shuffle(pairs[i], pairs[i + 1], low) for i in (0, 2)]
        y = [self.shuffle(pairs[i], pairs[i + 1], [k + 1 for k in low]) for i in (0, 2)]
        first, second = [0, 1, 4, 5, 8, 9, 12, 13], [2, 3, 6, 7, 10, 11, 14, 15]
        return [self.shuffle(a[0], a[1], lanes) for a, lanes in ((xz, first), (y, first), (xz, second))]

    def eights(self, table: Any, kind: Any, entry: Any, many: int = 2) -> list[Any]:
        """The vectors of an entry's kind (see `kinds`)."""
        b = self.builder
        begin = b.zext(b.load(b.gep(kind, [entry])), I64)
        return [self.load(b.gep(table, [b.add(begin, I64(LANES * k))]), WIDE) for k in range(many)]

    def sums(self, many: int) -> list[Any]:
        """So many vectors to add up in, of zeros."""
        return [cgutils.alloca_once_value(self.builder, constant(0.0)) for _ in range(many)]

    def arrow(self, x: Any, centre: list[Any], neighbour: Any, entry: Any) -> list[Any]:
        """The vectors to eight vertices from the other ends of an entry's springs."""
        others = self.gather(x, self.places(neighbour, entry))
        return [self.builder.fsub(a, b) for a, b in zip(centre, others, strict=True)]

    def add_products(self, factors: list[Any], terms: list[Any], sums: list[Any]) -> None:
        """Add a factor times a term to each sum."""
        for factor, term, total in zip(factors, terms, sums, strict=True):
            self.builder.store(self.multiply_add(factor, term, self.builder.load(total)), total)

    def note_least(self, value: Any, least: Any) -> None:
        """Keep the lesser of a vector's numbers and those in memory."""
        self.builder.store(self.least(self.builder.load(least), value), least)

    def short(self, least: Any) -> Any:
        """Whether one of the least squares in memory is too small for an inverse root."""
        return self.any(self.builder.fcmp_ordered("<=", self.builder.load(least), constant(LEAST)))

    def over_entries(
        self, begin: Any, end: Any, read: Callable[[Any], list[Any]], *stages: Callable[[list[Any]], Any]
    ) -> None:
        """Read one entry while each stage is at one of those before it: none waits long for what it needs. There are
        as many entries as stages at least."""
        b, depth = self.builder, len(stages)
        waiting: list[list[Any]] = []  # for each stage, the last one first
        for k in range(depth):
            values = read(b.add(begin, I64(k)))
            for stage in stages[: depth - 1 - k]:
                values = stage(values)
            waiting.append([cgutils.alloca_once(b, value.type) for value in values])
            for value, place in zip(values, waiting[-1], strict=True):
                b.store(value, place)
        with cgutils.for_range_slice(b, b.add(begin, I64(depth)), end, I64(1), I64) as (entry, _):
            fresh = read(entry)
            for stage, places in zip(stages, reversed(waiting), strict=True):
                values = [b.load(place) for place in places]
                for value, place in zip(fresh, places, strict=True):
                    b.store(value, place)
                fresh = stage(values)
        for k, places in enumerate(waiting):
            values = [b.load(place) for place in places]
            for stage in stages[depth - 1 - k :]:
                values = stage(values)

    def rows(self, vectors: list[Any], element: ir.Type = F64) -> list[Any]:
        """Eight rows of x, y, z and zero, rounded to float32 where that is the element."""
        zero, pairs = ir.Constant(ir.VectorType(element, LANES), [0.0] * LANES), [0, 2, 4, 6]
        if element != F64:
            vectors = [self.builder.fptrunc(a, zero.type) for a in vectors]
            pairs = [0, 1, 4, 5]  # so that shuffles stay within 128 bits
        (x, y, z), apart, halves = vectors, pairs[1], []
        for half in (0, 2 // apart):
            lanes = [lane for k in pairs for lane in (k + half, k + half + LANES)]
            halves.append((self.shuffle(x, y, lanes), self.shuffle(z, zero, lanes)))
        out: list[Any] = [None] * LANES
        for lane in range(LANES // 2):  # two rows at a time, four lanes apart
            half, begin = (lane % 2, lane - lane % 2) if apart == 2 else (lane // 2, 2 * (lane % 2))
            places = [begin, begin + 1, begin + 8, begin + 9, begin + 4, begin + 5, begin + 12, begin + 13]
            both = self.shuffle(halves[half][0], halves[half][1], places)
            out[lane], out[lane + 4] = (self.shuffle(both, both, list(range(k, k + 4))) for k in (0, 4))
        return out

    def dot(self, a: list[Any]) -> Any:
        """|a|^2 of eight vectors."""
        squared = self.builder.fmul(a[0], a[0], flags=("contract",))
        for component in a[1:]:
            squared = self.multiply_add(component, component, squared)
        return squared

    def add_to(self, pointer: Any, row: Any) -> None:
        """Add a row to one in memory."""
        self.store(self.builder.fadd(self.load(pointer, row.type), row), pointer)

    def clamped(self, s: Any) -> Any:
        """s, between LEAST and MOST."""
        return self.least(self.least(s, constant(LEAST), ">="), constant(MOST))

    def least(self, a: Any, b: Any, order: str = "<=") -> Any:
        """The lesser of two vectors' numbers, or the greater with the order ">="; a, where that is not a number."""
        return self.builder.select(self.builder.fcmp_ordered(order, b, a), b, a)

    def right(self, array: Any, bundle: Any) -> list[Any]:
        """The constant right-hand side of a bundle, and what holds its vertices."""
        at = self.builder.gep(array, [self.builder.mul(bundle, I64(RIGHT))])
        return [self.load(self.builder.gep(at, [I64(LANES * k)]), WIDE) for k in range(4)]

    def ask_ahead(self, springs: Bundle, places: list[Any], right: Any, out: Any) -> None:
        """Ask for what a bundle reads AHEAD rows on."""
        b = self.builder
        first = b.mul(b.add(springs.number, I64(AHEAD // LANES)), I64(RIGHT))
        for k in range(4):
            ask(b, b.gep(right, [b.add(first, I64(LANES * k))]))
        for place in places[::2]:
            ask(b, b.gep(out, [b.add(place, I64(4 * AHEAD))]))
        first = b.mul(b.add(springs.begin, I64(AHEAD)), I64(LANES))  # about as many entries as rows
        for k in range(LANES // 2):
            ask(b, b.gep(springs.neighbour, [b.add(first, I64(2 * LANES * k))]))

    def guess(self, s: Any) -> tuple[Any, Any]:
        """y, nearly 1/sqrt(s), and 1 - s y^2, for s between LEAST and MOST; `correction` does the rest."""
        b = self.builder
        if self.wide:
            kind = ir.FunctionType(WIDE, [WIDE, WIDE, I8])
            estimate = b.module.globals.get(_ESTIMATE) or ir.Function(b.module, kind, _ESTIMATE)
            y = b.call(estimate, [s, constant(0.0), I8(-1)])
        else:
            half = b.lshr(b.bitcast(s, BITS), ir.Constant(BITS, [1] * LANES))
            y = b.bitcast(b.sub(ir.Constant(BITS, [_GUESS] * LANES), half), WIDE)
            e = self.subtract_product(constant(1.0), b.fmul(s, y), y)
            y = self.multiply_add(b.fmul(y, e), self.series(e, 35 / 128, 5 / 16, 3 / 8, 1 / 2), y)
        return y, self.subtract_product(constant(1.0), b.fmul(s, y), y)

    def correction(self, e: Any) -> Any:
        """((1 - e)^(-1/2) - 1)/e, as far as a guess needs it."""
        return self.series(e, *(5 / 16, 3 / 8, 1 / 2) if self.wide else (3 / 8, 1 / 2))

    def series(self, e: Any, *coefficients: float) -> Any:
        """The polynomial in e with these coefficients, the highest power's first."""
        first, *others = map(constant, coefficients)
        for c in others:
            first = self.multiply_add(first, e, c)
        return first

    def inverse_root(self, s: Any) -> Any:
        """1/sqrt(s), for s between LEAST and MOST."""
        y, e = self.guess(s)
        return self.multiply_add(self.builder.fmul(y, e), self.correction(e), y)
