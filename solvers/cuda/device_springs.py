"""Springs on a device in correction form: reference x in float64 plus displacement u.

    D = x_i - x_j,   w = u_i - u_j,   v = D + w,   |v| - |D| = (D + v).w / (|v| + |D|)
    force(v) - force(D) = k r (v/|v| - D/|D|) - k w = (k r/|v| - k) w - (k r/|v|) (|v| - |D|)/|D| D
    E(v) - E(D) - grad E(D).w = k/2 |w|^2 - k r (|w|^2 - (D.w/|D|) (|v| - |D|)) / (|v| + |D|)

No difference of large numbers occurs: each term is accurate to the last digits of w, so the error of float32 is
relative to the change since the reference. The force at the reference itself is computed in float64.

A thread processes one lane of `springbench.solvers.kernels.spring_local_step`'s packets, with rows as indices:
eight adjacent vertices read eight neighbours, eight spring vectors and one weight offset. Positions are in rows of four
numbers, so that a neighbour is one memory sector.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import float64
from numpy.typing import NDArray
from springbench.solvers.cuda.cuda_target import DeviceStream, cuda
from springbench.solvers.kernels.spring_local_step import ZERO_LENGTH_SQUARED, SpringPackets
from springbench.solvers.simd.spring_packets import LANES

MIN_SQUARED_LENGTH = {np.float32: 1e-36, np.float64: ZERO_LENGTH_SQUARED}
"""Squared length [m^2] at or below which a spring counts as having zero length, as smaller values have no digits."""


class DeviceLanes(NamedTuple):
    """Spring packets on the device.

    Attributes:
        lane_row: (L,), the row of each lane.
        packet_start: (b + 1,).
        neighbour_row: (8 e,).
        weight_offset: (e,).
        spring_weights: in the kernels' type.
        float64_weights: in float64.
        spring_index, rest_direction: (8 e,) and (m, 3), as in the host's packets.
        spring_vectors: (3, 8 e), D [m] of the reference.
        padding_row, padding_end_row: rows of padding lanes, and of the ends of padding springs.
    """

    lane_row: Any
    packet_start: Any
    neighbour_row: Any
    weight_offset: Any
    spring_weights: Any
    float64_weights: Any
    spring_index: Any
    rest_direction: Any
    spring_vectors: Any
    padding_row: int
    padding_end_row: int

    @classmethod
    def from_packets(cls, stream: DeviceStream, packets: SpringPackets, padding_row: int, real: Any) -> DeviceLanes:
        """Copy packets of springs to the device.

        Args:
            stream: stream of the copies.
            packets: packets on the host; their strain limits and dashpots are not copied.
            padding_row: row of the padding lanes; the next row is that of the ends of padding springs.
            real: floating-point type of the kernels, for their weights and spring vectors.
        """
        entries = len(packets.neighbour_offset)
        direction = packets.rest_direction if len(packets.rest_direction) else np.zeros((1, 3))
        return cls(
            stream.upload_array(packets.row_offset // 4, np.int32),
            stream.upload_array(packets.packet_start, np.int32),
            stream.upload_array(_nonempty_array(packets.neighbour_offset // 4), np.int32),
            stream.upload_array(_nonempty_array(packets.weight_offset), np.int32),
            stream.upload_array(_nonempty_array(packets.weights), real),
            stream.upload_array(_nonempty_array(packets.weights), np.float64),
            stream.upload_array(_nonempty_array(packets.spring_index), np.int32),
            stream.upload_array(direction, np.float64),
            stream.allocate_zeros((3, max(1, entries)), real),
            padding_row,
            padding_row + 1,
        )

    @property
    def single_type_arguments(self) -> tuple[Any, ...]:
        """The arguments of the kernels that compute in their own floating-point type."""
        return (
            self.lane_row,
            self.packet_start,
            self.neighbour_row,
            self.weight_offset,
            self.spring_weights,
            self.spring_index,
            self.rest_direction,
            self.spring_vectors,
        )

    @property
    def float64_arguments(self) -> tuple[Any, ...]:
        """The arguments of the float64 kernel that writes the spring vectors."""
        return (
            self.lane_row,
            self.packet_start,
            self.neighbour_row,
            self.weight_offset,
            self.float64_weights,
            self.spring_index,
            self.rest_direction,
            self.spring_vectors,
        )


def _nonempty_array(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array, or one element, as a device does not support empty arrays."""
    return array if len(array) else np.zeros(1, array.dtype)


def compute_spring_bytes(packets: SpringPackets, real: Any) -> int:
    """Return the bytes of the lanes on the device.

    Args:
        packets: packets on the host.
        real: floating-point type of the kernels.
    """
    size = np.dtype(real).itemsize
    return (
        len(packets.neighbour_offset) * (8 + 3 * size) + 8 * len(packets.row_offset) + (8 + size) * packets.weights.size
    )


class SpringKernels(NamedTuple):
    """Device functions and kernels in one floating-point type."""

    spring_direction: Any
    force_change: Any
    clear_rows: Any
    write_positions: Any
    linearise_springs: Any


@cache
def build_spring_kernels(real: Any) -> SpringKernels:
    """Build the kernels of one floating-point type.

    All literals have this type, as a float64 literal would promote the arithmetic.
    """
    zero, one, short = real(0.0), real(1.0), real(MIN_SQUARED_LENGTH[real])
    tiny = ZERO_LENGTH_SQUARED

    @cuda.jit(device=True)
    def compute_direction(v0, v1, v2, squared, name, direction):
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
    def compute_force_change(d0, d1, d2, w0, w1, w2, pull, k, name, direction):
        """Return the change (3) of a spring's force on its first end.

        Also return its length, and whether it has zero length.
        """
        v0, v1, v2 = d0 + w0, d1 + w1, d2 + w2
        begin, end = d0 * d0 + d1 * d1 + d2 * d2, v0 * v0 + v1 * v1 + v2 * v2
        if begin <= short or end <= short:
            a0, a1, a2 = compute_direction(d0, d1, d2, begin, name, direction)
            b0, b1, b2 = compute_direction(v0, v1, v2, end, name, direction)
            return pull * (b0 - a0) - k * w0, pull * (b1 - a1) - k * w1, pull * (b2 - a2) - k * w2, zero, True
        was, length = real(math.sqrt(begin)), real(math.sqrt(end))
        longer = ((d0 + v0) * w0 + (d1 + v1) * w1 + (d2 + v2) * w2) / (was + length)
        inward = pull / length
        back, tension = inward * longer / was, inward - k
        return tension * w0 - back * d0, tension * w1 - back * d1, tension * w2 - back * d2, length, False

    @cuda.jit
    def clear_rows(x, u, older, before):
        """Set rows of four to zero."""
        i = cuda.grid(1)
        if i < len(x):
            for c in range(4):
                x[i, c], u[i, c], older[i, c], before[i, c] = 0.0, zero, zero, zero

    @cuda.jit
    def write_positions(x, u, out):
        """Write positions x + u [m] in rows of three."""
        i = cuda.grid(1)
        if i < len(out):
            for c in range(3):
                out[i, c] = x[i, c] + float64(u[i, c])

    @cuda.jit
    def linearise_springs(
        own, start, neighbour, kind, weights, spring, direction, arrows, padding_row, far, given, x, force
    ):
        """Write the spring vectors of the reference, and the negative gradient there (3, lanes) [N].

        Both are computed in float64.
        """
        t = cuda.grid(1)
        if t >= len(own) or own[t] == padding_row:
            return
        i, b, lane = own[t], t // LANES, t % LANES
        anchor_stiffness, x0, x1, x2 = given.anchor_stiffness[i], x[i, 0], x[i, 1], x[i, 2]
        f0 = anchor_stiffness * (given.anchor_positions[i, 0] - x0) + given.external_force[i, 0]
        f1 = anchor_stiffness * (given.anchor_positions[i, 1] - x1) + given.external_force[i, 1]
        f2 = anchor_stiffness * (given.anchor_positions[i, 2] - x2) + given.external_force[i, 2]
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

    return SpringKernels(compute_direction, compute_force_change, clear_rows, write_positions, linearise_springs)
