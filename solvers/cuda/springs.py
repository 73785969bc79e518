"""What springs do on a device, in correction form: positions x + u of a reference x in float64 and a displacement u.

    D = x_i - x_j,   w = u_i - u_j,   v = D + w,   |v| - |D| = (D + v).w / (|v| + |D|)
    force(v) - force(D) = k r (v/|v| - D/|D|) - k w = (k r/|v| - k) w - (k r/|v|) (|v| - |D|)/|D| D
    E(v) - E(D) - grad E(D).w = k/2 |w|^2 - k r (|w|^2 - (D.w/|D|) (|v| - |D|)) / (|v| + |D|)

Nothing here is a difference of large numbers: each is known to the last digits of w, so that float32 errs by a part of
the change since the reference, and of nothing else. The force at the reference itself is computed in float64.

A thread has a lane of `solvers.kernels.springs.Bundles`, with rows in the place of its places: eight vertices side by
side read eight neighbours, eight arrows and one kind. Positions are in rows of four numbers, so that a neighbour is one
sector of memory.
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
"""Squared lengths [m^2] up to which a spring counts as one without length, where smaller ones have no digits."""


class Lanes(NamedTuple):
    """Bundles on the device. own (L,): the row of each lane; start (b + 1,); neighbour (8 e,): rows; kind (e,);
    weights: of the kernels' type, exact: in float64; spring (8 e,), direction (m, 3): as in `Bundles`; nobody, far:
    rows of what fills up; arrows (3, 8 e): D [m], of the reference."""

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
        """The bundles, on the device. nobody: the row of what fills them up; the next one is that of springs' ends."""
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
        """What kernels in the kernels' type take."""
        return self.own, self.start, self.neighbour, self.kind, self.weights, self.spring, self.direction, self.arrows

    @property
    def written(self) -> tuple[Any, ...]:
        """What the kernel in float64 takes that writes the arrows."""
        return self.own, self.start, self.neighbour, self.kind, self.exact, self.spring, self.direction, self.arrows


def _some(array: NDArray[Any]) -> NDArray[Any]:
    """The array, or one number, for a device has no empty ones."""
    return array if len(array) else np.zeros(1, array.dtype)


def needed(bundles: Bundles, real: Any) -> int:
    """Bytes of these lanes on the device."""
    size = np.dtype(real).itemsize
    return len(bundles.neighbour) * (8 + 3 * size) + 8 * len(bundles.own) + (8 + size) * bundles.weights.size


class Kernels(NamedTuple):
    """Device functions and kernels in one type of numbers; see where they are written."""

    unit: Any
    change: Any
    clear: Any
    settle: Any
    linearise: Any


@cache
def kernels(real: Any) -> Kernels:
    """Those of a type. All literals are of it: one in float64 would make all that it meets float64."""
    zero, one, short = real(0.0), real(1.0), real(SHORT[real])
    tiny = TINY_SQUARED

    @cuda.jit(device=True)
    def unit(v0, v1, v2, squared, name, direction):
        """The direction of a spring, where it has no length that of its rest shape."""
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
        """What a spring's force on its first end changes by (3), its length there, and whether it has none."""
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
        """Zeros in rows of four."""
        i = cuda.grid(1)
        if i < len(x):
            for c in range(4):
                x[i, c], u[i, c], older[i, c], before[i, c] = 0.0, zero, zero, zero

    @cuda.jit
    def settle(x, u, out):
        """Positions x + u [m], in rows of three."""
        i = cuda.grid(1)
        if i < len(out):
            for c in range(3):
                out[i, c] = x[i, c] + float64(u[i, c])

    @cuda.jit
    def linearise(own, start, neighbour, kind, weights, spring, direction, arrows, nobody, far, given, x, force):
        """Write the arrows of the reference, and minus the gradient there, in float64, to `force` (3, lanes) [N]."""
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
