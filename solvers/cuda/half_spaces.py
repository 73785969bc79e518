"""Vertex contact with obstacles on a device: half-spaces, built at the start of a step and used in sweeps.

The host only provides the frames of moving obstacles. The functions are shared with the CPU: the half-space of a vertex
(`solvers.contact.planes`), its terms in the gradient and block of the vertex, and the trial steps
(`solvers.kernels.half_spaces`). They compute in float64, as few vertices are in contact. The springs'
terms come from the kernels of `solvers.cuda.vbd_kernels` in their type.
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
"""Number of float64 values per row and obstacle."""

_plane, _deeper = shared(planes.plane), shared(half_spaces.deeper)
_Rounded = planes.Rounded


class Bodies(NamedTuple):
    """Obstacles on the device.

    Attributes:
        low, high: (o, 3) [m], corners of the rounded boxes.
        radius: (o,) [m], including the thickness.
        margin: (o,) [m].
        friction: (o,), Coulomb coefficients.
        creep: (o,) [m/s], sliding speed below which friction counts as sticking.
        stiffness: (o, n) [N/m], of each row.
    """

    low: Any
    high: Any
    radius: Any
    margin: Any
    friction: Any
    creep: Any
    stiffness: Any


class Spaces:
    """Half-spaces of a solve on the device, one per free row and obstacle."""

    def __init__(self, stream: Stream, system: System, order: NDArray[np.int64], vertex: Any, free: int) -> None:
        """Allocate the half-spaces; `order` and `vertex` (n,) are the vertices of the rows on host and device."""
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
        """Build the half-spaces of a step."""
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
    """Update out[0] to the largest |v|^2, a maximum that is independent of the order of threads."""
    most, i = 0.0, cuda.grid(1)
    while i < v.shape[0]:
        most = max(most, v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2])
        i += cuda.gridsize(1)
    cuda.atomic.max(out, 0, most)


@cuda.jit
def find(vertex, p, v, dt, when, square, frames, bodies, found, rounds, pressed, spaces):
    """Write the half-spaces of the free rows, one per obstacle.

    A half-space is empty if the vertex is not near the obstacle.

    See `solvers.contact.energy`.

    Args:
        p: positions [m] at the start of the step, by vertices.
        v: velocities [m/s] at the start of the step, by vertices.
        when: time of the stage within the step, 1 at its end.
        square: largest squared speed.
        frames: (o, 2, 4, 3), frames of the obstacles.
        found: a view of `spaces`.
        rounds: whether friction uses the normal forces at `pressed` (n, 3) [m], by vertices.
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
    """Kernels in one floating-point type."""

    push: Any
    press: Any


@cache
def kernels(real: Any) -> Kernels:
    """Build the kernels for the floating-point type of the displacements."""
    of_springs = vbd_kernels.kernels(real)
    gathered, lowering = of_springs.gathered, shared(half_spaces.trying(of_springs.risen_there))

    @cuda.jit
    def push(
        begin, end, own, start, neighbour, kind, weights, spring, direction, arrows,
        nobody, far, held, majorant, force, u, before, x, spaces,
    ):  # fmt: skip
        """Recompute the steps of a colour's vertices with half-spaces, from their positions before the sweep.

        x is the reference, in rows of four [m]; `solvers.cuda.vbd_kernels` documents the other arguments.
        """
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
        # A spring of zero length has no Hessian: the step of the majorant separates its ends.
        level = MAJORANT if lengthless else EXACT
        most = float64(majorant[t])
        d = lowering(spaces, i, at, (most, 0.0, 0.0, most, 0.0, most), level, gradient, block, lane)
        u[i, 0], u[i, 1], u[i, 2] = real(u0 + d[0]), real(u1 + d[1]), real(u2 + d[2])

    @cuda.jit
    def press(spaces, x, u, asked, control, first, out):
        """Write the change of the half-space energy from the reference to u [J], one number per block.

        The numbers are stored in `out` from `first` on; see `level` in `solvers.cuda.vbd_kernels`.
        """
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
