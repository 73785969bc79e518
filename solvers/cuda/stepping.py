"""Steps that follow each other on a device, by any integrator of one unknown x a step (`solvers.integrators.single`).

    origin = p + a (p - p'),    target = origin + b v + c (v - v'),    f = load + rate drag origin
    p <- x,   v <- rate (x - origin)       or, of an unknown in the middle,    p <- 2 x - p,   v <- 2 rate (x - p) - v

with p', v' one step before. A host is asked for where moving pins are, and for nothing else; it may look at the end of
any step, or at none. Of two who look at different ends both find the same bits. The force of drag is at rest where the
unknown's velocity is taken from. A method that integrates a step by itself writes its own p and v.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import numpy as np

from solvers.contact.energy import Contact
from solvers.contact.friction_rounds import has_friction
from solvers.contact.self_contact import PairContact
from solvers.core.driver import Iterating, Iterative
from solvers.cuda import device, sums
from solvers.cuda.run import Stream
from solvers.cuda.stepping_kernels import Gives, Motions, Weights, advance, arrive, decay, lag, predict, slow
from solvers.cuda.steps import Step, pin_numbers
from solvers.device import Course, Marks, Rule
from solvers.energies.dashpots import Dashpots
from solvers.energies.quadratic import Quadratic, Viscous, drag_of_vertices
from solvers.filters import Decay, QuadraticDrag
from solvers.problem import Positions, ResidualOf, Solution, StepProblem, StopRule, System, Unsupported, is_lagged

GUESSES = {"assignment": 0, "current": 1, "inertial": 2}
"""First guesses that follow from a step's start alone: as it is; pins on their targets; where inertia alone leads."""


class Method(Protocol):
    """What of a method steps ask for: `solvers.cuda.resident.Resident`, which imports this."""

    own: ClassVar[bool]
    system: System
    stream: Stream

    def iterating(self) -> Any:
        """Memory for solves, one after the other."""
        ...

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """See Iterative."""
        ...

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        ...


class _Turn:
    """What takes a step: a method, ready for a system, its memory, and the integrator's rule."""

    def __init__(self, made: Method, rule: Rule) -> None:
        self.made, self.run = made, made.iterating()
        self.system, self.stream = made.system, made.stream
        self.weights = Weights(*rule, self.system.rate)
        self.lags = not made.own and any(isinstance(energy, Dashpots) for energy in self.system.energies)


class Stepping(Iterative):
    """Steps on the device, from the course's start on. Its `solve` does the next one, of which the host's problem is
    told to whoever judges where it ends, and is not computed with."""

    def __init__(self, made: Method, course: Course) -> None:
        """Raises Unsupported."""
        self._course, system = course, course.system
        constant, drag = _constant(system, course, own=made.own)
        unknown = [type(one).__name__ for one in course.filters if not isinstance(one, Decay | QuadraticDrag)]
        if unknown:
            raise Unsupported(f"the host changes the velocity before each step, by {', '.join(unknown)}")
        if course.first_guess not in GUESSES:
            raise Unsupported(
                f"the host makes first_guess: {course.first_guess} for each step; not {', '.join(GUESSES)}"
            )
        up, stream = made.stream.upload, made.stream
        self._stream, self._frame, shape = stream, 0, constant.shape
        with device.guarded():
            self._usual = self._turn = _Turn(made, course.rule)
            ready: Any = course.first
            self._first = _Turn(*ready) if ready else self._usual
            self._load, self._drag = up(constant), up(drag)
            self._filters = [_on_device(one, up) for one in course.filters]
            self._pin, self._wanted = up(pin_numbers(system)), up(self._targets(1))
            self._p, self._v, self._target, self._force, self._guess = (
                stream.zeros(shape, np.float64) for _ in range(5)
            )
            recalls, lags = self._first is not self._usual, self._usual.lags
            before = (stream.zeros(shape, np.float64) for _ in range(2)) if recalls else (self._p, self._v)
            self._motions = Motions(self._p, self._v, *before)
            self._origin, self._lagged = (stream.zeros(shape, np.float64) if lags else self._p for _ in range(2))
            self._pins = self._wanted if course.rule.when == 1.0 else up(self._targets(1))

    def restart(self) -> None:
        """Bring the start to the device; waits for it."""
        with device.guarded():
            self._frame = 0
            for begun, there in ((self._course.positions, self._p), (self._course.velocity, self._v)):
                self._stream.put(begun, there)
            self._stream.put(self._targets(1), self._wanted)
            self._stream.wait()

    def step(self, iterations: int) -> Marks | None:
        """The next step by so many iterations, and no look at it; waits for its end."""
        with device.guarded():
            self._begin()
            run = self._turn.run
            run.launch(iterations)
            self._end()
            done = run.stream.mark()
            run.stream.wait()
            return run.marks_until(done)

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The next step up to where `stop` ends it, and a copy of that."""
        with device.guarded():
            found = super().solve(problem, stop)
            self._end()
            self._turn.stream.wait()  # the next one may be in another stream
            return found

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """The next step's solve."""
        self._begin()
        return self._turn.run

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """See Iterative."""
        return self._turn.made.residual_at(problem, p)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return self._turn.made.scale(problem)

    def positions(self) -> Positions:
        """A copy of where the last step ended, (n, 3) [m]."""
        with device.guarded():
            return self._stream.download(self._p)

    def _targets(self, frame: int) -> Positions:
        """Where pins want their vertices at a frame's end; one row where there are none."""
        there = self._course.pins_at(frame * self._course.system.time_step)
        return there if len(there) else np.zeros((1, 3))

    @property
    def _times(self) -> tuple[float, float]:
        """Where the step that is done starts, and of its unknown [s]."""
        dt = self._course.system.time_step
        begun = (self._frame - 1) * dt
        return begun, begun + self._course.rule.when * dt

    def _begin(self) -> None:
        self._frame += 1
        self._turn = turn = self._first if self._frame == 1 else self._usual
        run, over, motions = turn.run, self._over(), self._motions
        run.begun()
        if self._course.pins_move:
            turn.stream.put(self._targets(self._frame), self._wanted)
        run.uploaded()
        for kernel, arguments in self._filters:
            for v in (motions.v,) if motions.v is motions.v_before else (motions.v, motions.v_before):
                kernel[over](v, *arguments)
        gives = Gives(self._target, self._force, self._guess, self._pins)
        kind = GUESSES[self._course.first_guess]
        predict[over](motions, turn.weights, self._load, self._drag, self._pin, self._wanted, kind, gives)
        if turn.lags:
            lag[over](motions, turn.weights, self._origin, self._lagged)
        run.take(Step(*gives, self._origin, self._lagged, self._p, self._v, self._times))

    def _end(self) -> None:
        run, speeds, over = self._turn.run, self._turn.run.speeds(), self._over()
        if speeds is None:
            advance[over](run.vertex, run.settled(), self._turn.weights, self._motions)
        else:
            arrive[over](run.vertex, run.settled(), speeds, self._p, self._v)

    def _over(self) -> tuple[int, int, Any]:
        return sums.blocks(len(self._p)), sums.THREADS, self._turn.stream.queue


class Unjudged(Stepping):
    """Of a method that does not minimise."""

    residual_of: ClassVar[ResidualOf] = "none"


def _constant(system: System, course: Course, *, own: bool) -> tuple[Positions, Any]:
    """The forces (n, 3) [N] that are the same in all steps, with those of forms, and drag of vertices (n,) [N s/m] that
    is part of steps; own: whether the method has that by itself. Raises Unsupported for what the host states."""
    constant, drag = np.array(course.load), np.zeros(system.vertices)
    for energy in system.energies:
        name = type(energy).__name__
        if isinstance(energy, Viscous):
            damps = drag_of_vertices(energy)
            if damps is None:
                raise Unsupported(f"the host states {name} before each step: it couples velocities of vertices")
            drag += 0.0 if own else damps
        elif has_friction(energy) and energy.friction_rounds > 1:
            raise Unsupported(f"the host iterates the normal forces of {name}'s friction within each step")
        elif is_lagged(energy) and not isinstance(energy, Dashpots | Contact | PairContact):
            raise Unsupported(f"the host states {name} before each step")
        elif isinstance(energy, Quadratic):
            energy.add_projection(course.positions, constant)
    return constant, drag


def _on_device(one: Any, up: Any) -> tuple[Any, tuple[Any, ...]]:
    """The kernel of a filter, and what it takes beside the velocity."""
    if isinstance(one, Decay):
        return decay, (one.kept,)
    return slow, (up(one.mass), up(one.coefficient))
