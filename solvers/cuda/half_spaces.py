"""Contact of vertices with obstacles on a device: what a step's half-spaces are, from where it starts there.

A host is asked for the frames of obstacles that move, and for nothing else.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from solvers.contact import planes
from solvers.contact.energy import Contact
from solvers.cuda import half_space_kernels, sums
from solvers.cuda.half_space_kernels import Bodies
from solvers.cuda.run import Stream
from solvers.cuda.steps import Step
from solvers.kernels.half_spaces import HalfSpaces
from solvers.problem import System

NUMBERS = 12
"""Float64 of each row and obstacle."""


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
        half_space_kernels.fastest[self.over](step.velocity, self._square)
        half_space_kernels.find[self.over](
            self._vertex, step.positions, step.velocity, self._dt, (end - begin) / self._dt, self._square, self._frames,
            self._bodies, self._found, step.pressed is not None,
            step.positions if step.pressed is None else step.pressed, self.given,
        )  # fmt: skip

    def add_gradient(self, rows: Any, out: Any) -> None:
        """Add the gradient at rows (n, 3) [m] to `out` (f, 3) [N]."""
        half_space_kernels.add_gradient[self.over](self.given, rows, out)

    def _frames_at(self, time: float) -> NDArray[np.float64]:
        return np.concatenate([contact.frames(time) for contact in self._contacts])
