"""Contact of vertices with obstacles on a device: half-spaces, found where a step starts there, and swept with.

A host is asked for the frames of obstacles that move, and for nothing else. The functions are the processor's: which
half-space a vertex has (`solvers.contact.planes`), what it adds to the vertex's gradient and block, and the steps that
are tried (`solvers.kernels.half_spaces`). They compute in float64, for few vertices touch; what springs do comes from
the kernels of `solvers.cuda.vbd_kernels` in their type.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import float64
from numpy.typing import NDArray

from solvers.contact import planes
from solvers.contact.energy import Contact
from solvers.cuda import sums, vbd_kernels
from solvers.cuda.shared import shared
from solvers.cuda.steps import Step
from solvers.cuda.target import Stream, cuda
from solvers.cuda.vbd_kernels import ASKED, WEIGHT
from solvers.kernels import half_spaces
from solvers.kernels.half_spaces import EXACT, MAJORANT, HalfSpaces
from solvers.problem import System

NUMBERS = 12
"""Float64 of each row and obstacle."""

_plane, _deeper = shared(planes.plane), shared(half_spaces.deeper)
_Rounded = planes.Rounded


class Bodies(NamedTuple):
    """Of each obstacle: low, high (o, 3) and radius (o,) of its rounded box, thickness included [m]; margin (o,) [m],
    friction (o,); creep (o,) [m/s]; stiffness (o, n) of each row [N/m]."""

    low: Any
    high: Any
    radius: Any
    margin: Any
    friction: Any
    creep: Any
    stiffness: Any


class Spaces:
    """The half-spaces of a solve, one of each free row for each obstacle. given: on the device."""

    def __init__(self, stream: Stream, system: System, order: NDArray[np.int64], vertex: Any, free: int) -> None:
        """order, vertex (n,): of each row, here and on the device; free: how many rows move."""
        self._stream, self._vertex, self._dt = stream, vertex, system.time_step
        self._contacts = [energy for energy in system.energies if isinstance(energy, Contact)]
        all_of = [(contact, one) for contact in self._contacts for one in contact.obstacles]
        many, up = len(all_of), stream.upload
        self._bodies = Bodies(
            up(np.array([one.low for _, one in all_of], np.float64)),
            up(np.array([one.high for _, one in all_of], np.float64)),
            up(np.array([one.radius + contact.thickness for contact, one in all_of])),
            up(np.array([contact.margin for contact, _ in all_of], np.float64)),
            up(np.array([contact.friction for contact, _ in all_of], np.float64)),
            up(np.array([contact.creep for contact, _ in all_of], np.float64)),
            up(np.array([contact.stiffness[order] for contact, _ in all_of])),
        )
        slots = max(1, many * free)
        near: Any = stream.zeros(max(1, free), np.bool_)
        normal, anchor = (stream.zeros((slots, 3), np.float64) for _ in range(2))
        offset, stiffness, grip, slip = (stream.zeros(slots, np.float64) for _ in range(4))
        first = up(many * np.arange(free + 1))
        self.given = HalfSpaces(first, near, normal, anchor, offset, stiffness, grip, slip, both=False)
        given, one = self.given, stream.zeros(1, np.int64)
        self._found = planes.HalfSpaces(one, given.normal, given.offset, given.anchor)
        self._square, self._frames = stream.zeros(1, np.float64), up(self._frames_at(0.0))
        self._move = any(one.frame(0.0) is not one.frame(1.0) for _, one in all_of)
        self.over = sums.blocks(free), sums.THREADS, stream.queue

    def take(self, step: Step) -> None:
        """Those of a step."""
        begin, end = step.times
        if self._move:
            self._stream.put(self._frames_at(begin), self._frames)
        self._stream.put(np.zeros(1), self._square)
        fastest[self.over](step.velocity, self._square)
        find[self.over](
            self._vertex, step.positions, step.velocity, self._dt, (end - begin) / self._dt, self._square, self._frames,
            self._bodies, self._found, step.pressed is not None,
            step.positions if step.pressed is None else step.pressed, self.given,
        )  # fmt: skip

    def _frames_at(self, time: float) -> NDArray[np.float64]:
        return np.concatenate([contact.frames(time) for contact in self._contacts])


@cuda.jit
def fastest(v, out):
    """The largest |v|^2, if it is larger than out[0]; which it is depends on no order."""
    most, i = 0.0, cuda.grid(1)
    while i < v.shape[0]:
        most = max(most, v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
        i += cuda.gridsize(1)
    cuda.atomic.max(out, 0, most)


@cuda.jit
def find(vertex, p, v, dt, when, square, frames, bodies, found, rounds, pressed, spaces):
    """Write the half-spaces of the free rows, one for each obstacle; where a vertex comes near none of them it is
    empty. See `solvers.contact.energy.Contact`.

    p [m], v [m/s]: at the step's start, by vertices; when: the unknown's time within the step, 1 at its end; square: of
    the largest speed; frames (o, 2, 4, 3): of obstacles; found: a view of `spaces`;
    rounds: whether friction takes its normal forces at `pressed` (n, 3) [m], by vertices.
    """
    work = cuda.local.array((5, 3), np.float64)
    i, many = cuda.grid(1), bodies.radius.shape[0]
    way = dt * math.sqrt(square[0])
    while i < spaces.near.shape[0]:
        spaces.near[i] = False
        x = vertex[i]
        for o in range(many):
            k, body = many * i + o, _Rounded(bodies.low[o], bodies.high[o], bodies.radius[o])
            if _plane(p, v, x, dt, frames[o], body, bodies.margin[o] + way, found, k, work):
                before, lagged, taken, stiffness = 0.0, 0.0, 0.0, bodies.stiffness[o, i]
                for c in range(3):
                    n, here, carried = spaces.normal[k, c], p[x, c], spaces.anchor[k, c]
                    before += n * here
                    lagged += n * carried
                    taken += n * pressed[x, c]
                    spaces.anchor[k, c] = here + when * (carried - here)
                depth = when * (spaces.offset[k] - lagged)
                spaces.offset[k] = before + when * (spaces.offset[k] - before)
                depth = spaces.offset[k] - taken if rounds else depth
                spaces.stiffness[k], spaces.slip[k] = stiffness, bodies.creep[o] * (when * dt)
                spaces.grip[k] = bodies.friction[o] * stiffness * max(0.0, depth)
                spaces.near[i] = True
            else:
                for c in range(3):
                    spaces.normal[k, c], spaces.anchor[k, c] = 0.0, 0.0
                spaces.offset[k], spaces.stiffness[k], spaces.grip[k], spaces.slip[k] = -1.0, 0.0, 0.0, 1.0
        i += cuda.gridsize(1)


class Kernels(NamedTuple):
    """Kernels in one type of numbers."""

    push: Any
    press: Any


@cache
def kernels(real: Any) -> Kernels:
    """Those of a type, that of displacements."""
    of_springs = vbd_kernels.kernels(real)
    gathered, lowering = of_springs.gathered, shared(half_spaces.trying(of_springs.risen_there))

    @cuda.jit
    def push(
        begin, end, own, start, neighbour, kind, weights, spring, direction, arrows,
        nobody, far, held, majorant, force, u, before, x, spaces,
    ):  # fmt: skip
        """Move those vertices of a colour anew that have half-spaces, from where they were before its sweep; x: the
        reference, in rows of four [m]. See `solvers.cuda.vbd_kernels` for all else."""
        t = begin + cuda.grid(1)
        if t >= end or own[t] == nobody or not spaces.near[own[t]]:
            return
        i, b = own[t], t // vbd_kernels.LANES
        first, last = start[b], start[b + 1]
        u0, u1, u2 = before[i, 0], before[i, 1], before[i, 2]
        f0, f1, f2, b00, b01, b02, b11, b12, b22, lengthless = gathered(
            t, first, last, u0, u1, u2, neighbour, kind, weights, spring, direction, arrows, far, held, force, u
        )
        at = x[i, 0] + u0, x[i, 1] + u1, x[i, 2] + u2
        gradient = -float64(f0), -float64(f1), -float64(f2)
        block = float64(b00), float64(b01), float64(b02), float64(b11), float64(b12), float64(b22)
        lane = t, first, last, (u0, u1, u2), (f0, f1, f2), neighbour, kind, weights, arrows, far, held, u
        # Where a spring has no length there is no Hessian: the majorant's step takes it apart.
        level = MAJORANT if lengthless else EXACT
        most = float64(majorant[t])
        d = lowering(spaces, i, at, (most, 0.0, 0.0, most, 0.0, most), level, gradient, block, lane)
        u[i, 0], u[i, 1], u[i, 2] = real(u0 + d[0]), real(u1 + d[1]), real(u2 + d[2])

    @cuda.jit
    def press(spaces, x, u, asked, control, first, out):
        """Write by how much half-spaces' energy rises from the reference to u, to `out` from `first` on, a number a
        block [J]; see `solvers.cuda.vbd_kernels.level`."""
        if asked == ASKED and not control[ASKED] > 0.0:
            return
        if asked == WEIGHT and not control[WEIGHT] > 1.0:
            return
        total, i = 0.0, cuda.grid(1)
        while i < spaces.near.shape[0]:
            if spaces.near[i]:
                d = float64(u[i, 0]), float64(u[i, 1]), float64(u[i, 2])
                total = _deeper(spaces, i, (x[i, 0], x[i, 1], x[i, 2]), d, total)
            i += cuda.gridsize(1)
        total = sums.of_block(total)
        if cuda.threadIdx.x == 0:
            out[first + cuda.blockIdx.x] = total

    return Kernels(push, press)
