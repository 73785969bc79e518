"""Vertex contact with obstacles on a device, by half-spaces.

They are built at the start of a step and used in sweeps. The host only provides the frames of moving obstacles. The
functions are shared with the CPU: the half-space of a vertex
(`springbench.solvers.contact.half_space.separating_planes`), its terms in the gradient and block of the vertex, and the
trial steps (`springbench.solvers.contact.half_space.half_space_steps`). They compute in float64, as few vertices are in
contact. The springs' terms come from the kernels of `springbench.solvers.methods.vertex_block.device_vbd_kernels` in
their type.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import float64
from numpy.typing import NDArray
from springbench.solvers.contact.half_space import half_space_steps, separating_planes
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact
from springbench.solvers.contact.half_space.half_space_steps import EXACT_BLOCK, SPRING_MAJORANT, HalfSpaces
from springbench.solvers.cuda import device_sums
from springbench.solvers.cuda.cuda_target import DeviceStream, cuda
from springbench.solvers.cuda.device_step import DeviceStep
from springbench.solvers.cuda.function_sharing import share_with_device
from springbench.solvers.methods.vertex_block import device_vbd_kernels
from springbench.solvers.methods.vertex_block.device_vbd_kernels import EXTRAPOLATION, IS_REQUESTED
from springbench.solvers.model.step_problem import System

FLOATS_PER_ROW = 12
"""Number of float64 values per row and obstacle."""

_plane, _deeper = (
    share_with_device(separating_planes.write_separating_plane),
    share_with_device(half_space_steps.add_half_space_change),
)
_Rounded = separating_planes.RoundedBox


class ObstacleBodies(NamedTuple):
    """Obstacles on the device.

    Attributes:
        low, high: (o, 3) [m], corners of the rounded boxes.
        radius: (o,) [m], radius of the rounded boxes, including the thickness.
        force_margin: (o,) [m], distance within which an obstacle gets a half-space.
        friction_coefficient: (o,), Coulomb coefficients.
        eps_v: (o,) [m/s], sliding speed below which friction counts as sticking.
        stiffness: (o, n) [N/m], of each row.
    """

    low: Any
    high: Any
    radius: Any
    force_margin: Any
    friction_coefficient: Any
    eps_v: Any
    stiffness: Any


class DeviceHalfSpaces:
    """Half-spaces of a solve on the device, one per free row and obstacle."""

    def __init__(
        self, stream: DeviceStream, system: System, order: NDArray[np.int64], vertex: Any, num_free: int
    ) -> None:
        """Allocate the half-spaces of a solve and upload the obstacles.

        Args:
            stream: stream of the copies and kernels.
            system: system with vertex contact.
            order: vertex of each row (n,), on the host.
            vertex: vertex of each row (n,), on the device.
            num_free: number of free rows, which come first.
        """
        self._stream, self._vertex, self._dt = stream, vertex, system.time_step
        self._contacts = [energy for energy in system.energies if isinstance(energy, HalfSpaceContact)]
        all_of = [(contact, one) for contact in self._contacts for one in contact.obstacles]
        many, up = len(all_of), stream.upload_array
        self._obstacle_bodies = ObstacleBodies(
            up(np.array([one.low for _, one in all_of], np.float64)),
            up(np.array([one.high for _, one in all_of], np.float64)),
            up(np.array([one.radius + contact.min_distance for contact, one in all_of])),
            up(np.array([contact.safety_margin for contact, _ in all_of], np.float64)),
            up(np.array([contact.friction for contact, _ in all_of], np.float64)),
            up(np.array([contact.eps_v for contact, _ in all_of], np.float64)),
            up(np.array([contact.stiffness[order] for contact, _ in all_of])),
        )
        slots = max(1, many * num_free)
        near: Any = stream.allocate_zeros(max(1, num_free), np.bool_)
        normal, anchor = (stream.allocate_zeros((slots, 3), np.float64) for _ in range(2))
        offset, stiffness, friction_force, slip = (stream.allocate_zeros(slots, np.float64) for _ in range(4))
        first = up(many * np.arange(num_free + 1))
        self.half_spaces = HalfSpaces(
            first, near, normal, anchor, offset, stiffness, friction_force, slip, is_two_sided=False
        )
        given, one = self.half_spaces, stream.allocate_zeros(1, np.int64)
        self._found = separating_planes.SeparatingPlanes(one, given.normal, given.offset, given.friction_anchor)
        self._max_squared_speed, self._frames = stream.allocate_zeros(1, np.float64), up(self._obstacle_frames(0.0))
        self._has_moving_obstacles = any(one.frame(0.0) is not one.frame(1.0) for _, one in all_of)
        self.launch_shape = device_sums.count_blocks(num_free), device_sums.THREADS_PER_BLOCK, stream.cuda_stream

    def load_step(self, step: DeviceStep) -> None:
        """Build the half-spaces of a step."""
        begin, end = step.start_and_stage_time
        if self._has_moving_obstacles:
            self._stream.overwrite_array(self._obstacle_frames(begin), self._frames)
        self._stream.overwrite_array(np.zeros(1), self._max_squared_speed)
        measure_max_speed[self.launch_shape](step.velocity, self._max_squared_speed)
        build_half_spaces[self.launch_shape](
            self._vertex, step.positions, step.velocity, self._dt, (end - begin) / self._dt,
            self._max_squared_speed, self._frames,
            self._obstacle_bodies, self._found, step.normal_force_positions is not None,
            step.positions if step.normal_force_positions is None else step.normal_force_positions,
            self.half_spaces,
        )  # fmt: skip

    def _obstacle_frames(self, time: float) -> NDArray[np.float64]:
        return np.concatenate([contact.compute_frames(time) for contact in self._contacts])


@cuda.jit
def measure_max_speed(v, out):
    """Update out[0] to the largest |v|^2.

    The maximum is independent of the order of threads.

    Args:
        v: velocities (n, 3) [m/s].
        out: largest squared speed so far (1,) [m^2/s^2], updated; the caller sets it to 0 first.
    """
    most, i = 0.0, cuda.grid(1)
    while i < v.shape[0]:
        most = max(most, v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
        i += cuda.gridsize(1)
    cuda.atomic.max(out, 0, most)


@cuda.jit
def build_half_spaces(vertex, p, v, dt, when, square, frames, bodies, found, rounds, pressed, spaces):
    """Write the half-spaces of the free rows, one per obstacle.

    A half-space is empty if the vertex is not near the obstacle.

    They are those of `springbench.solvers.contact.half_space.half_space_potential`.

    Args:
        vertex: vertex of each row (n,).
        p: positions [m] at the start of the step, by vertices.
        v: velocities [m/s] at the start of the step, by vertices.
        dt: step size [s].
        when: time of the stage within the step, 1 at its end.
        square: largest squared speed.
        frames: (o, 2, 4, 3), frames of the obstacles.
        bodies: the obstacles.
        found: a view of `spaces`.
        rounds: whether friction uses the normal forces at `pressed`.
        pressed: positions of these normal forces (n, 3) [m], by vertices.
        spaces: receives the half-spaces.
    """
    work = cuda.local.array((5, 3), np.float64)
    i, many = cuda.grid(1), bodies.radius.shape[0]
    travel = dt * math.sqrt(square[0])
    while i < spaces.has_half_space.shape[0]:
        spaces.has_half_space[i] = False
        x = vertex[i]
        for o in range(many):
            k, body = many * i + o, _Rounded(bodies.low[o], bodies.high[o], bodies.radius[o])
            if _plane(p, v, x, dt, frames[o], body, bodies.force_margin[o] + travel, found, k, work):
                before, lagged, taken, stiffness = 0.0, 0.0, 0.0, bodies.stiffness[o, i]
                for c in range(3):
                    n, here, carried = spaces.normal[k, c], p[x, c], spaces.friction_anchor[k, c]
                    before += n * here
                    lagged += n * carried
                    taken += n * pressed[x, c]
                    spaces.friction_anchor[k, c] = here + when * (carried - here)
                depth = when * (spaces.offset[k] - lagged)
                spaces.offset[k] = before + when * (spaces.offset[k] - before)
                depth = spaces.offset[k] - taken if rounds else depth
                spaces.stiffness[k], spaces.smoothing_length[k] = stiffness, bodies.eps_v[o] * (when * dt)
                spaces.friction_limit[k] = bodies.friction_coefficient[o] * stiffness * max(0.0, depth)
                spaces.has_half_space[i] = True
            else:
                for c in range(3):
                    spaces.normal[k, c], spaces.friction_anchor[k, c] = 0.0, 0.0
                spaces.offset[k], spaces.stiffness[k], spaces.friction_limit[k], spaces.smoothing_length[k] = (
                    -1.0,
                    0.0,
                    0.0,
                    1.0,
                )
        i += cuda.gridsize(1)


class HalfSpaceKernels(NamedTuple):
    """Kernels in one floating-point type."""

    push_with_model: Any
    evaluate_penalty: Any


@cache
def build_half_space_kernels(real: Any) -> HalfSpaceKernels:
    """Build the kernels for the floating-point type of the displacements."""
    of_springs = device_vbd_kernels.build_vbd_kernels(real)
    gather_force_and_block, lowering = (
        of_springs.gather_force_and_block,
        share_with_device(half_space_steps.build_block_step(of_springs.vertex_energy_change)),
    )

    @cuda.jit
    def push_with_model(
        begin, end, own, start, neighbour, kind, weights, spring, direction, arrows,
        padding_row, far, anchor_stiffness, majorant, force, u, before, x, spaces,
    ):  # fmt: skip
        """Recompute the steps of a colour's vertices with half-spaces, from their positions before the sweep.

        x is the reference, in rows of four [m]; `springbench.solvers.methods.vertex_block.device_vbd_kernels`
        documents the other arguments.
        """
        t = begin + cuda.grid(1)
        if t >= end or own[t] == padding_row or not spaces.has_half_space[own[t]]:
            return
        i, b = own[t], t // device_vbd_kernels.LANES
        first, last = start[b], start[b + 1]
        u0, u1, u2 = before[i, 0], before[i, 1], before[i, 2]
        f0, f1, f2, b00, b01, b02, b11, b12, b22, lengthless = gather_force_and_block(
            t,
            first,
            last,
            u0,
            u1,
            u2,
            neighbour,
            kind,
            weights,
            spring,
            direction,
            arrows,
            far,
            anchor_stiffness,
            force,
            u,
        )
        at = x[i, 0] + u0, x[i, 1] + u1, x[i, 2] + u2
        gradient = -float64(f0), -float64(f1), -float64(f2)
        block = float64(b00), float64(b01), float64(b02), float64(b11), float64(b12), float64(b22)
        lane = t, first, last, (u0, u1, u2), (f0, f1, f2), neighbour, kind, weights, arrows, far, anchor_stiffness, u
        # A spring of zero length has no Hessian: the step of the majorant separates its ends.
        level = SPRING_MAJORANT if lengthless else EXACT_BLOCK
        most = float64(majorant[t])
        d = lowering(spaces, i, at, (most, 0.0, 0.0, most, 0.0, most), level, gradient, block, lane)
        u[i, 0], u[i, 1], u[i, 2] = real(u0 + d[0]), real(u1 + d[1]), real(u2 + d[2])

    @cuda.jit
    def evaluate_penalty(spaces, x, u, sequence_number, control, first, out):
        """Write the change of the half-space energy from the reference to u [J].

        It is a sum per thread block. The sums are stored in `out` from `first` on; `sum_objective` of
        `springbench.solvers.methods.vertex_block.device_vbd_kernels` adds them.
        """
        if sequence_number == IS_REQUESTED and not control[IS_REQUESTED] > 0.0:
            return
        if sequence_number == EXTRAPOLATION and not control[EXTRAPOLATION] > 1.0:
            return
        total, i = 0.0, cuda.grid(1)
        while i < spaces.has_half_space.shape[0]:
            if spaces.has_half_space[i]:
                d = float64(u[i, 0]), float64(u[i, 1]), float64(u[i, 2])
                total = _deeper(spaces, i, (x[i, 0], x[i, 1], x[i, 2]), d, total)
            i += cuda.gridsize(1)
        total = device_sums.sum_block(total)
        if cuda.threadIdx.x == 0:
            out[first + cuda.blockIdx.x] = total

    return HalfSpaceKernels(push_with_model, evaluate_penalty)
