"""Methods that take a step from where it is on the device, and steps that follow each other there.

    target = p + dt v,    f = load + c rate p,    p <- x,    v <- rate (x - p)             implicit Euler, one by one

A host is asked for where moving pins are, and for nothing else; it may look at the end of any step, or at none. Of two
who look at different ends both find the same bits. c: of drag, whose force is at rest where the step starts.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from solvers.core.driver import Iterating, Iterative
from solvers.cuda import device, sums
from solvers.cuda.run import DeviceIterating, DeviceIterative
from solvers.cuda.steps import Step, Uploaded
from solvers.cuda.target import cuda
from solvers.device import Course, Marks
from solvers.energies.dashpots import Dashpots
from solvers.energies.quadratic import Quadratic, Viscous, drag_of_vertices
from solvers.filters import Decay, QuadraticDrag
from solvers.problem import Positions, Solution, StepProblem, StopRule, Unsupported, is_lagged

GUESSES = {"assignment": 0, "current": 1, "inertial": 2}
"""First guesses that follow from a step's start alone: as it is; pins on their targets; where inertia alone leads."""

AT_ONCE = 2
"""Solves that are on the device: that of the steps, and one that tells a residual elsewhere."""


class ResidentIterating(DeviceIterating):
    """A solve on a device, of one step after the other; its memory is made once."""

    def __init__(self, uploaded: Uploaded) -> None:
        super().__init__(uploaded.stream)
        self.of = uploaded

    @abstractmethod
    def take(self, step: Step) -> None:
        """Begin to solve a step, which is on the device."""

    @abstractmethod
    def settled(self) -> Any:
        """Where it is, in rows (n, 3) [m], on the device."""

    def fetch(self) -> Positions:
        """See DeviceIterating."""
        return self.of.network.fetched(self.stream.download(self.settled()))


class Resident(DeviceIterative):
    """A method that is ready on a device. uploaded: its network."""

    uploaded: Uploaded

    @abstractmethod
    def iterating(self) -> ResidentIterating:
        """Memory for solves, one after the other."""

    def begin(self, problem: StepProblem, guess: Positions) -> ResidentIterating:
        """See Iterative; the problem is a host's."""
        with device.guarded():
            run = self.iterating()
            run.begun()
            step = self.uploaded.step(problem, guess)
            run.uploaded()
            run.take(step)
            return run

    def stepping(self, course: Course) -> Stepping:
        """See Remote. Raises Unsupported with what has to be computed by the host before each step."""
        return Stepping(self, course)


class Stepping(Iterative):
    """Steps on the device, from the course's start on. Its `solve` does the next one, of which the host's problem is
    told to whoever judges where it ends, and is not computed with."""

    def __init__(self, made: Resident, course: Course) -> None:
        """Raises Unsupported."""
        self._made, self._course, system = made, course, course.system
        constant, drag = np.array(course.load), np.zeros(system.vertices)
        for energy in system.energies:
            name = type(energy).__name__
            if isinstance(energy, Viscous):
                own = drag_of_vertices(energy)
                if own is None:
                    raise Unsupported(f"the host states {name} before each step: it couples velocities of vertices")
                drag += system.rate * own
            elif is_lagged(energy) and not isinstance(energy, Dashpots):
                raise Unsupported(f"the host states {name} before each step")
            elif isinstance(energy, Quadratic):
                energy.add_projection(course.positions, constant)
        unknown = [type(one).__name__ for one in course.filters if not isinstance(one, Decay | QuadraticDrag)]
        if unknown:
            raise Unsupported(f"the host changes the velocity before each step, by {', '.join(unknown)}")
        if course.first_guess not in GUESSES:
            raise Unsupported(
                f"the host makes first_guess: {course.first_guess} for each step; not {', '.join(GUESSES)}"
            )
        up, stream = made.uploaded.stream.upload, made.uploaded.stream
        self._stream, self._frame, shape = stream, 0, constant.shape
        with device.guarded():
            self._run = made.iterating()
            self._load, self._drag = up(constant), up(drag)
            self._filters = [_on_device(one, up) for one in course.filters]
            pin = np.full(system.vertices, -1, np.int32)
            pin[system.pins.vertices] = np.arange(len(system.pins.vertices))
            self._pin, self._pins = up(pin), up(self._targets(1))
            self._p, self._v, self._target, self._force, self._guess = (
                stream.zeros(shape, np.float64) for _ in range(5)
            )

    def restart(self) -> None:
        """Bring the start to the device; waits for it."""
        with device.guarded():
            self._frame = 0
            self._stream.put(self._course.positions, self._p)
            self._stream.put(self._course.velocity, self._v)
            self._stream.put(self._targets(1), self._pins)
            self._stream.wait()

    def step(self, iterations: int) -> Marks | None:
        """The next step by so many iterations, and no look at it; waits for its end."""
        with device.guarded():
            self._begin()
            self._run.launch(iterations)
            self._end()
            done = self._stream.mark()
            self._stream.wait()
            return self._run.marks_until(done)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The next step up to where `stop` ends it, and a copy of that."""
        with device.guarded():
            found = super().solve(problem, stop)
            self._end()
            return found

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """The next step's solve."""
        self._begin()
        return self._run

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """See Iterative."""
        return self._made.residual_at(problem, p)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return self._made.scale(problem)

    def positions(self) -> Positions:
        """A copy of where the last step ended, (n, 3) [m]."""
        with device.guarded():
            return self._stream.download(self._p)

    def _targets(self, frame: int) -> Positions:
        """Where pins want their vertices at a frame's end; one row where there are none."""
        there = self._course.pins_at(frame * self._course.system.time_step)
        return there if len(there) else np.zeros((1, 3))

    def _begin(self) -> None:
        run, over = self._run, self._over()
        self._frame += 1
        run.begun()
        if self._course.pins_move:
            self._stream.put(self._targets(self._frame), self._pins)
        run.uploaded()
        for kernel, arguments in self._filters:
            kernel[over](self._v, *arguments)
        predict[over](
            self._p, self._v, self._course.system.time_step, self._load, self._drag, self._pin, self._pins,
            GUESSES[self._course.first_guess], self._target, self._force, self._guess,
        )  # fmt: skip
        run.take(Step(self._target, self._force, self._guess, self._pins, self._p, self._p))

    def _end(self) -> None:
        vertex = self._made.uploaded.places.vertex
        advance[self._over()](vertex, self._run.settled(), self._course.system.rate, self._p, self._v)

    def _over(self) -> tuple[int, int, Any]:
        return sums.blocks(len(self._p)), sums.THREADS, self._stream.queue


def _on_device(one: Any, up: Any) -> tuple[Any, tuple[Any, ...]]:
    """The kernel of a filter, and what it takes beside the velocity."""
    if isinstance(one, Decay):
        return decay, (one.kept,)
    return slow, (up(one.mass), up(one.coefficient))


@cuda.jit
def decay(v, kept):
    """`solvers.filters.Decay`."""
    i = cuda.grid(1)
    while i < v.shape[0]:
        v[i, 0], v[i, 1], v[i, 2] = kept * v[i, 0], kept * v[i, 1], kept * v[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def slow(v, mass, coefficient):
    """`solvers.filters.QuadraticDrag`."""
    i = cuda.grid(1)
    while i < v.shape[0]:
        drag = coefficient[i] * (v[i, 0] * v[i, 0] + v[i, 1] * v[i, 1] + v[i, 2] * v[i, 2]) ** 0.5
        if drag > 0.0:
            left = mass[i] / (mass[i] + drag)
            v[i, 0], v[i, 1], v[i, 2] = left * v[i, 0], left * v[i, 1], left * v[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def predict(p, v, dt, load, drag, pin, pins, kind, target, force, guess):
    """Write target, force and first guess of a step of implicit Euler."""
    i = cuda.grid(1)
    while i < p.shape[0]:
        for c in range(3):
            target[i, c] = p[i, c] + dt * v[i, c]
            force[i, c] = load[i, c] + drag[i] * p[i, c]
            begun = target[i, c] if kind == 2 else p[i, c]
            guess[i, c] = pins[pin[i], c] if kind > 0 and pin[i] >= 0 else begun
        i += cuda.gridsize(1)


@cuda.jit
def advance(vertex, rows, rate, p, v):
    """Take where a solve ended, in rows, for the step's end."""
    r = cuda.grid(1)
    while r < vertex.shape[0]:
        i = vertex[r]
        for c in range(3):
            v[i, c] = rate * (rows[r, c] - p[i, c])
            p[i, c] = rows[r, c]
        r += cuda.gridsize(1)
