"""The objective and minus its gradient in one pass over a factor's rows, eight vertices at a time.

    b_i = y_i - h_i p_i + sum of (k r / |v| - k) v over the springs (i, j),   v = p_i - p_j       minus the gradient
    g   = sum of k/2 (|v| - r)^2 + sum of |y_i - h_i p_i|^2 / (2 h_i)                          up to a constant

with h = c m/dt^2 + w and y = c M target/dt^2 + f + w C'C p_pin. All terms of g are squares: it is known to some units
in the last place of the energy that is at stake. A massless vertex that no pin holds (h = 0) adds -y_i p_i.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from solvers.compiling import inner
from solvers.kernels.springs import TINY_SQUARED, Bundles, aligned, one_by_one
from solvers.kernels.springs_vectors import F64, I8, I64, LANES, LEAST, MASK, WIDE, Vectors, constant, unpacked


class Shares(NamedTuple):
    """What the objective needs beside the gradient's arrays.

    weight: of each bundled entry, k/4 [N/m], or k/2 where the other end is pinned exactly and so has no entry; rest:
    its rest length [m]; inverse: 1/h [m/N] of each row, 0 where h is; size: the sum of k r^2 [J].
    """

    weight: NDArray[np.float64]
    rest: NDArray[np.float64]
    inverse: NDArray[np.float64]
    size: float

    @classmethod
    def of(cls, bundles: Bundles, held: NDArray[np.float64], pinned: NDArray[np.int64]) -> Shares:
        """The shares of springs in bundles, of which the rows `pinned` do not move."""
        k, pull = bundles.stiffness, bundles.pull
        weight, rest = aligned(len(k)), aligned(len(k))
        weight[:] = np.where(np.isin(bundles.neighbour, pinned), 0.5, 0.25) * k
        np.divide(pull, k, out=rest, where=k > 0.0)
        inverse = np.divide(1.0, held, out=np.zeros_like(held), where=held > 0.0)
        return cls(weight, rest, inverse, 2.0 * float(weight @ rest**2))


def _bundle(typingctx, x, own, chunk, neighbour, pull, stiffness, weight, rest, begin, end, y, held, out):
    """A bundle's code: writes its rows of `out`, returns its springs' energy; -1, and writes none, if one is short."""

    def generate(context, builder: Any, signature, args):
        x, own, chunk, neighbour, pull, stiffness, weight, rest, begin, end, y, held, out = unpacked(
            context, builder, signature, args
        )
        v = Vectors(context, builder)
        places = v.places(builder.gep(own, [builder.mul(chunk, I64(LANES))]))
        centre = v.gather(x, places)
        sums = [cgutils.alloca_once(builder, WIDE) for _ in range(4)]
        for accumulator in sums:
            builder.store(constant(0.0), accumulator)
        short = cgutils.alloca_once(builder, MASK)
        builder.store(ir.Constant(MASK, [0] * LANES), short)
        with cgutils.for_range_slice(builder, begin, end, I64(1), I64) as (entry, _):
            first = builder.mul(entry, I64(LANES))

            def wide(array, first=first):
                return v.load(builder.gep(array, [first]), WIDE)

            others = v.gather(x, v.places(builder.gep(neighbour, [first])))
            arrow = [builder.fsub(a, b) for a, b in zip(centre, others, strict=True)]
            squared = v.dot(arrow)
            tiny = builder.fcmp_ordered("<=", squared, constant(LEAST))
            builder.store(builder.or_(builder.load(short), tiny), short)
            root = v.inverse_root(squared)
            scale = builder.fsub(builder.fmul(wide(pull), root), wide(stiffness))
            longer = builder.fsub(builder.fmul(squared, root), wide(rest))
            scales = [scale] * 3 + [builder.fmul(wide(weight), longer)]
            for factor, term, accumulator in zip(scales, [*arrow, longer], sums, strict=True):
                builder.store(v.multiply_add(factor, term, builder.load(accumulator)), accumulator)
        *total, energy = [builder.load(accumulator) for accumulator in sums]
        any_short = builder.icmp_unsigned("!=", builder.bitcast(builder.load(short), I8), I8(0))
        with builder.if_then(builder.not_(any_short), likely=True):
            for place, row in zip(places, v.rows(*total), strict=True):
                here = v.load(v.row(x, place), row.type)
                weight_here = v.broadcast(builder.load(builder.gep(held, [place])))
                row = builder.fadd(row, v.load(v.row(y, place), row.type))
                row = v.subtract_product(row, weight_here, here)
                builder.store(row, builder.bitcast(v.row(out, place), row.type.as_pointer()), align=8)
        return builder.select(any_short, F64(-1.0), v.total(energy))

    return types.float64(x, own, chunk, neighbour, pull, stiffness, weight, rest, begin, end, y, held, out), generate


_descend: Any = intrinsic(_bundle)


@inner
def descend(bundles, shares, p, y, held, rows, out):
    """Write minus the gradient at p to the rows of `out`, and return the objective; the first `rows` are unknowns."""
    own, start, neighbour, pull, stiffness, _spring, _direction = bundles
    total = 0.0
    for b in range(len(start) - 1):
        energy = _descend(
            p, own, b, neighbour, pull, stiffness, shares.weight, shares.rest, start[b], start[b + 1], y, held, out
        )
        if energy < 0.0:
            for lane in range(LANES):
                for c in range(4):
                    out[4 * own[LANES * b + lane] + c] = 0.0
            one_by_one(bundles, b, p, y, held, out, 0, True)
            energy = _short(bundles, shares, b, p)
        total += energy
    for i in range(rows):
        k, h = 4 * i, held[i]
        e0, e1, e2 = y[k] - h * p[k], y[k + 1] - h * p[k + 1], y[k + 2] - h * p[k + 2]
        total += 0.5 * shares.inverse[i] * (e0 * e0 + e1 * e1 + e2 * e2)
        if h == 0.0:
            total -= e0 * p[k] + e1 * p[k + 1] + e2 * p[k + 2]
    return total


@inner
def _short(bundles, shares, b, p):
    """The energy of a bundle in which a spring has no length."""
    total = 0.0
    for entry in range(LANES * bundles.start[b], LANES * bundles.start[b + 1]):
        i, j = bundles.own[LANES * b + entry % LANES], bundles.neighbour[entry]
        squared = 0.0
        for c in range(3):
            squared += (p[4 * i + c] - p[4 * j + c]) ** 2
        length = 0.0 if squared <= TINY_SQUARED else np.sqrt(squared)
        total += shares.weight[entry] * (length - shares.rest[entry]) ** 2
    return total
