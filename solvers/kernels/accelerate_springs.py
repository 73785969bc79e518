"""The objective and minus its gradient in one pass over a factor's rows, eight vertices at a time.

    b_i = y_i - h_i p_i + sum of s v over the springs (i, j),   s = k r / |v| - k,   v = p_i - p_j    minus the gradient
    g   = sum of s^2 |v|^2 / (2 k) + sum of |y_i - h_i p_i|^2 / (2 h_i)                          up to a constant

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

    share: of each bundled entry, 1/(4 k) [m/N], or 1/(2 k) where the other end is pinned exactly and so has no entry;
    inverse: 1/(2 h) [m/N] of each row, 0 where h is; massless: the rows where it is; size: the sum of k r^2 [J].
    """

    share: NDArray[np.float64]
    inverse: NDArray[np.float64]
    massless: NDArray[np.int32]
    size: float

    @classmethod
    def of(cls, bundles: Bundles, held: NDArray[np.float64], pinned: NDArray[np.int64]) -> Shares:
        """The shares of springs in bundles, of which the rows `pinned` do not move."""
        k, pull, own = bundles.stiffness, bundles.pull, bundles.own
        share = aligned(len(k))
        np.divide(np.where(np.isin(bundles.neighbour, pinned), 0.5, 0.25), k, out=share, where=k != 0.0)
        inverse = np.divide(0.5, held, out=np.zeros_like(held), where=held > 0.0)
        return cls(share, inverse, np.unique(own[held[own] == 0.0]), 2.0 * float(share @ pull**2))


def _bundle(typingctx, x, own, chunk, neighbour, pull, stiffness, share, begin, end, y, held, inverse, out):
    """A bundle's code: writes its rows of `out`, returns its energy; -1, and writes none, if a spring is short."""

    def generate(context, builder: Any, signature, args):
        x, own, chunk, neighbour, pull, stiffness, share, begin, end, y, held, inverse, out = unpacked(
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

        def read(entry):
            """What an entry's springs need: k r, k, 1/(4 k), and the vector from their other ends."""
            first = builder.mul(entry, I64(LANES))
            others = v.gather(x, v.places(builder.gep(neighbour, [first])))
            weights = [v.load(builder.gep(array, [first]), WIDE) for array in (pull, stiffness, share)]
            return [*weights, *(builder.fsub(a, b) for a, b in zip(centre, others, strict=True))]

        def add(values):
            """Add an entry's springs to the sums."""
            pulls, k, shares, *arrow = values
            squared = v.dot(arrow)
            tiny = builder.fcmp_ordered("<=", squared, constant(LEAST))
            builder.store(builder.or_(builder.load(short), tiny), short)
            scale = builder.fsub(builder.fmul(pulls, v.inverse_root(squared)), k)
            energy = builder.fmul(builder.fmul(shares, scale), scale)
            factors, terms = [scale] * 3 + [energy], [*arrow, squared]
            for factor, term, accumulator in zip(factors, terms, sums, strict=True):
                builder.store(v.multiply_add(factor, term, builder.load(accumulator)), accumulator)

        # One entry is read while the one before is added, as in `springs_vectors`.
        waiting = [cgutils.alloca_once_value(builder, value) for value in read(begin)]
        with cgutils.for_range_slice(builder, builder.add(begin, I64(1)), end, I64(1), I64) as (entry, _):
            following = read(entry)
            add([builder.load(value) for value in waiting])
            for value, place in zip(following, waiting, strict=True):
                builder.store(value, place)
        add([builder.load(value) for value in waiting])
        *total, energy = [builder.load(accumulator) for accumulator in sums]
        any_short = builder.icmp_unsigned("!=", builder.bitcast(builder.load(short), I8), I8(0))
        with builder.if_then(builder.not_(any_short), likely=True):
            halves = []
            for place, row in zip(places, v.rows(*total), strict=True):
                here = v.load(v.row(x, place), row.type)
                weight, half = (v.broadcast(builder.load(builder.gep(array, [place]))) for array in (held, inverse))
                away = v.subtract_product(v.load(v.row(y, place), row.type), weight, here)
                halves.append(builder.fmul(builder.fmul(half, away), away))
                builder.store(
                    builder.fadd(row, away), builder.bitcast(v.row(out, place), row.type.as_pointer()), align=8
                )
            inertia = v.paired(halves)
            builder.store(v.shuffle(inertia, ir.Constant(inertia.type, [0.0] * 4), list(range(LANES))), sums[0])
        energy = v.total(builder.fadd(energy, builder.load(sums[0])))
        return builder.select(any_short, F64(-1.0), energy)

    return types.float64(x, own, chunk, neighbour, pull, stiffness, share, begin, end, y, held, inverse, out), generate


_descend: Any = intrinsic(_bundle)


@inner
def descend(bundles, shares, p, y, held, out):
    """Write minus the gradient at p to the rows of `out`, and return the objective."""
    own, start, neighbour, pull, stiffness, _spring, _direction = bundles
    total = 0.0
    for b in range(len(start) - 1):
        energy = _descend(
            p, own, b, neighbour, pull, stiffness, shares.share, start[b], start[b + 1], y, held, shares.inverse, out
        )
        if energy < 0.0:
            for lane in range(LANES):
                for c in range(4):
                    out[4 * own[LANES * b + lane] + c] = 0.0
            one_by_one(bundles, b, p, y, held, out, 0, True)
            energy = _short(bundles, shares, b, p, y, held)
        total += energy
    for i in shares.massless:
        for k in range(4 * i, 4 * i + 3):
            total -= y[k] * p[k]
    return total


@inner
def _short(bundles, shares, b, p, y, held):
    """The energy of a bundle in which a spring has no length."""
    total = 0.0
    for lane in range(LANES):
        i = bundles.own[LANES * b + lane]
        for k in range(4 * i, 4 * i + 3):
            total += shares.inverse[i] * (y[k] - held[i] * p[k]) ** 2
    for entry in range(LANES * bundles.start[b], LANES * bundles.start[b + 1]):
        i, j = bundles.own[LANES * b + entry % LANES], bundles.neighbour[entry]
        squared = 0.0
        for c in range(3):
            squared += (p[4 * i + c] - p[4 * j + c]) ** 2
        length = 0.0 if squared <= TINY_SQUARED else np.sqrt(squared)
        total += shares.share[entry] * (bundles.pull[entry] - bundles.stiffness[entry] * length) ** 2
    return total
