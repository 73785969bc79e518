"""Springs on a device in correction form: reference x in float64 plus displacement u.

    D = x_i - x_j,   w = u_i - u_j,   v = D + w,   |v| - |D| = (D + v).w / (|v| + |D|)
    force(v) - force(D) = k r (v/|v| - D/|D|) - k w = (k r/|v| - k) w - (k r/|v|) (|v| - |D|)/|D| D
    E(v) - E(D) - grad E(D).w = k/2 |w|^2 - k r (|w|^2 - (D.w/|D|) (|v| - |D|)) / (|v| + |D|)

No difference of large numbers occurs: each term is accurate to the last digits of w, so the error of float32 is
relative to the change since the reference. The force at the reference itself is computed in float64.

A thread processes one lane of `solvers.kernels.springs`'s packets, with rows as indices: eight adjacent
vertices read eight neighbours, eight spring vectors and one weight offset. Positions are in rows of four numbers, so
that a neighbour is one memory sector.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import float64
from numpy.typing import NDArray

from solvers.cuda.target import Stream, cuda
from solvers.kernels.springs import TINY_SQUARED, Bundles
from solvers.vectors.springs import LANES

SHORT = {np.float32: 1e-36, np.float64: TINY_SQUARED}
"""Squared length [m^2] at or below which a spring counts as having zero length, as smaller values have no digits."""


class Lanes(NamedTuple):
    """Spring packets on the device.

    Attributes:
        own: (L,), the row of each lane.
        start: (b + 1,).
        neighbour: (8 e,).
        kind: (e,).
        weights: in the kernels' type.
        exact: in float64.
        spring, direction: (8 e,) and (m, 3), as in the host's packets.
        arrows: (3, 8 e), D [m] of the reference.
        nobody, far: rows of padding lanes, and of the ends of padding springs.
    """

    own: Any
    start: Any
    neighbour: Any
    kind: Any
    weights: Any
    exact: Any
    spring: Any
    direction: Any
    arrows: Any
    nobody: int
    far: int

    @classmethod
    def of(cls, stream: Stream, bundles: Bundles, nobody: int, real: Any) -> Lanes:
        """Copy the packets to the device.

        `nobody` + 1 is the row of the ends of padding springs.
        """
        entries = len(bundles.neighbour)
        direction = bundles.direction if len(bundles.direction) else np.zeros((1, 3))
        return cls(
            stream.upload(bundles.own // 4, np.int32),
            stream.upload(bundles.start, np.int32),
            stream.upload(_some(bundles.neighbour // 4), np.int32),
            stream.upload(_some(bundles.kind), np.int32),
            stream.upload(_some(bundles.weights), real),
            stream.upload(_some(bundles.weights), np.float64),
            stream.upload(_some(bundles.spring), np.int32),
            stream.upload(direction, np.float64),
            stream.zeros((3, max(1, entries)), real),
            nobody,
            nobody + 1,
        )

    @property
    def read(self) -> tuple[Any, ...]:
        """Return the arguments of the kernels in the kernels' type."""
        return self.own, self.start, self.neighbour, self.kind, self.weights, self.spring, self.direction, self.arrows

    @property
    def written(self) -> tuple[Any, ...]:
        """Return the arguments of the float64 kernel that writes the spring vectors."""
        return self.own, self.start, self.neighbour, self.kind, self.exact, self.spring, self.direction, self.arrows


def _some(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array, or one element, as a device does not support empty arrays."""
    return array if len(array) else np.zeros(1, array.dtype)


def needed(bundles: Bundles, real: Any) -> int:
    """Return the bytes of the lanes on the device."""
    size = np.dtype(real).itemsize
    return len(bundles.neighbour) * (8 + 3 * size) + 8 * len(bundles.own) + (8 + size) * bundles.weights.size


class Kernels(NamedTuple):
    """Device functions and kernels in one floating-point type."""

    unit: Any
    change: Any
    clear: Any
    settle: Any
    linearise: Any


@cache
def kernels(real: Any) -> Kernels:
    """Build the kernels of one floating-point type.

    All literals have this type, as a float64 literal would promote the arithmetic.
    """
    zero, one, short = real(0.0), real(1.0), real(SHORT[real])
    tiny = TINY_SQUARED

    @cuda.jit(device=True)
    def unit(v0, v1, v2, squared, name, direction):
        """Return the direction of a spring; that of its rest shape at zero length."""
        if squared <= short:
            sign = one
            if name < 0:
                sign, name = -one, ~name
            return (
                sign * real(direction[name, 0]),
                sign * real(direction[name, 1]),
                sign * real(direction[name, 2]),
            )
        scale = one / real(math.sqrt(squared))
        return scale * v0, scale * v1, scale * v2

    @cuda.jit(device=True)
    def change(d0, d1, d2, w0, w1, w2, pull, k, name, direction):
        """Return the change (3) of a spring's force on its first end.

        Also return its length, and whether it has zero length.
        """
        v0, v1, v2 = d0 + w0, d1 + w1, d2 + w2
        begin, end = d0 * d0 + d1 * d1 + d2 * d2, v0 * v0 + v1 * v1 + v2 * v2
        if begin <= short or end <= short:
            a0, a1, a2 = unit(d0, d1, d2, begin, name, direction)
            b0, b1, b2 = unit(v0, v1, v2, end, name, direction)
            return pull * (b0 - a0) - k * w0, pull * (b1 - a1) - k * w1, pull * (b2 - a2) - k * w2, zero, True
        was, length = real(math.sqrt(begin)), real(math.sqrt(end))
        longer = ((d0 + v0) * w0 + (d1 + v1) * w1 + (d2 + v2) * w2) / (was + length)
        inward = pull / length
        back, tension = inward * longer / was, inward - k
        return tension * w0 - back * d0, tension * w1 - back * d1, tension * w2 - back * d2, length, False

    @cuda.jit
    def clear(x, u, older, before):
        """Set rows of four to zero."""
        i = cuda.grid(1)
        if i < len(x):
            for c in range(4):
                x[i, c], u[i, c], older[i, c], before[i, c] = 0.0, zero, zero, zero

    @cuda.jit
    def settle(x, u, out):
        """Write positions x + u [m] in rows of three."""
        i = cuda.grid(1)
        if i < len(out):
            for c in range(3):
                out[i, c] = x[i, c] + float64(u[i, c])

    @cuda.jit
    def linearise(own, start, neighbour, kind, weights, spring, direction, arrows, nobody, far, given, x, force):
        """Write the spring vectors of the reference and the negative gradient there, in float64 (3, lanes) [N]."""
        t = cuda.grid(1)
        if t >= len(own) or own[t] == nobody:
            return
        i, b, lane = own[t], t // LANES, t % LANES
        held, x0, x1, x2 = given.hold[i], x[i, 0], x[i, 1], x[i, 2]
        f0 = held * (given.centre[i, 0] - x0) + given.force[i, 0]
        f1 = held * (given.centre[i, 1] - x1) + given.force[i, 1]
        f2 = held * (given.centre[i, 2] - x2) + given.force[i, 2]
        for entry in range(start[b], start[b + 1]):
            e = LANES * entry + lane
            j = neighbour[e]
            if j == far:
                continue
            v0, v1, v2 = x0 - x[j, 0], x1 - x[j, 1], x2 - x[j, 2]
            arrows[0, e], arrows[1, e], arrows[2, e] = real(v0), real(v1), real(v2)
            pull, k = weights[kind[entry] + lane], weights[kind[entry] + LANES + lane]
            squared = v0 * v0 + v1 * v1 + v2 * v2
            f0, f1, f2 = f0 - k * v0, f1 - k * v1, f2 - k * v2
            if squared <= tiny:
                name = spring[e]
                if name < 0:
                    pull, name = -pull, ~name
                v0, v1, v2 = direction[name, 0], direction[name, 1], direction[name, 2]
            else:
                pull = pull / math.sqrt(squared)
            f0, f1, f2 = f0 + pull * v0, f1 + pull * v1, f2 + pull * v2
        force[0, t], force[1, t], force[2, t] = real(f0), real(f1), real(f2)

    return Kernels(unit, change, clear, settle, linearise)
