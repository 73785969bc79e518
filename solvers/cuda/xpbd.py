"""XPBD on a device: the iterates of `solvers.methods.xpbd`, with one launch per colour.

Each thread processes one spring. No two springs of a colour share a vertex, so no thread writes what another reads.
`solvers.cuda.xpbd_kernels` documents the precision of each quantity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.core import vertex_terms
from solvers.cuda import device, sums
from solvers.cuda.run import DeviceIterating, DeviceIterative
from solvers.cuda.steps import Step, pin_numbers, pins_of
from solvers.cuda.target import Stream, cuda
from solvers.cuda.xpbd_kernels import kernels, moved, predict, settle
from solvers.kernels.xpbd import Constraints
from solvers.problem import Positions, ResidualOf, StepProblem, System

Real = type[np.float32] | type[np.float64]


def prepare(
    system: System, constraints: Constraints, first: NDArray[np.int64], real: Real, choice: str, *, small: bool
) -> PreparedXpbd:
    """Prepare the method on an available device.

    Args:
        system: the system.
        constraints: the springs by colour.
        first: (colours + 1,), the first spring of each colour.
        real: floating-point type of the kernels.
        choice: description of the solver.
        small: whether in small steps.

    Raises:
        Unsupported: if the device memory is too small.
    """
    m, n, size = len(constraints.stiffness), system.vertices, np.dtype(real).itemsize
    solve = m * 5.0 * size + n * (5 * 24 + 8 + 5.0 * size)
    device.require_memory("xpbd", m * (8 + 8 + 24.0 + size) + n * (6 * 24 + 32) + solve)
    with device.guarded():
        stream = Stream()
        there = Springs.of(stream, constraints, real), Places.of(stream, system)
        told = f"{choice}; kernels in {np.dtype(real)}, from a reference in float64"
        made = PreparedSmallSteps if small else PreparedXpbd
        return made(system, stream, *there, first, real, device.told(), told)


class Springs(NamedTuple):
    """Springs on the device.

    Attributes:
        ends: (m, 2).
        stiffness: (m,) [N/m].
        rest: r (m,) [m].
        direction: (m, 3), used at zero length.
        arrows: (4, m), D and |D| - r [m] of a solve.
        tension: (m,) [N] of a solve.
    """

    ends: Any
    stiffness: Any
    rest: Any
    direction: Any
    arrows: Any = None
    tension: Any = None

    @classmethod
    def of(cls, stream: Stream, constraints: Constraints, real: Real) -> Springs:
        """Copy the constraints to the device, which does not support empty arrays."""
        m = max(1, len(constraints.stiffness))
        ends, direction = np.zeros((m, 2), np.int32), np.zeros((m, 3))
        stiffness, rest = np.zeros(m), np.zeros(m)
        for there, given in zip((ends, stiffness, rest, direction), constraints, strict=True):
            there[: len(given)] = given
        return cls(
            stream.upload(ends),
            stream.upload(stiffness, real),
            stream.upload(rest),
            stream.upload(direction),
        )

    def begun(self, real: Real) -> Springs:
        """Allocate the arrays of a solve."""
        m = len(self.stiffness)
        return self._replace(arrows=cuda.device_array((4, m), real), tension=cuda.device_array(m, real))


class Places(NamedTuple):
    """Data of each vertex (n,) on the device.

    Attributes:
        pin: index of its pin, -1 for none.
        weight: weight of the pin, 0 for none.
        held: c m/dt^2 + weight [N/m].
        mass: [kg].
    """

    pin: Any
    weight: Any
    held: Any
    mass: Any

    @classmethod
    def of(cls, stream: Stream, system: System) -> Places:
        """Build the vertex data of a system."""
        n, pins = system.vertices, system.pins
        weight = np.zeros(n)
        weight[pins.vertices] = pins.weight
        arrays = pin_numbers(system), weight, vertex_terms.held(system), system.mass
        return cls(*map(stream.upload, arrays))


@dataclass(frozen=True, eq=False)
class PreparedXpbd(DeviceIterative):
    """XPBD, prepared on a device; `first` (colours + 1,) are the first springs of the colours."""

    residual_of: ClassVar[ResidualOf] = "none"

    system: System
    stream: Stream
    springs: Springs
    places: Places
    first: NDArray[np.int64]
    real: Real
    columns: dict[str, Any]
    choice: str

    facts: dict[str, float] = field(default_factory=dict[str, float])
    own: ClassVar[bool] = False

    def stated(self, problem: StepProblem, guess: Positions) -> Step:
        """Upload a step problem; the initial guess is not used."""
        up, start = self.stream.upload, problem.start
        target, force, pins = up(problem.target), up(problem.force), pins_of(problem, self.stream)
        here = (up(start.positions), up(start.velocity)) if self.own else (target, target)
        return Step(target, force, target, pins, target, target, *here, (start.time, start.until))

    def iterating(self) -> DeviceIterating:
        """Allocate the memory of a solve."""
        return Passes(self)


class PreparedSmallSteps(PreparedXpbd):
    """XPBD with small steps, prepared on a device."""

    own: ClassVar[bool] = True

    def iterating(self) -> DeviceIterating:
        """Allocate the memory of a solve."""
        return SmallSteps(self)


class _Iterating(DeviceIterating):
    """State of an XPBD solve on the device.

    Reference x (n, 3) [m], displacement u (n, 4) [m], vertex compliance (n,) [m/N].
    """

    def __init__(self, made: PreparedXpbd) -> None:
        n, stream = made.system.vertices, made.stream
        super().__init__(stream, np.arange(n))
        self.made, self.kernels, self.springs = made, kernels(made.real), made.springs.begun(made.real)
        self.x, self.out = (stream.empty((n, 3), np.float64) for _ in range(2))
        self.u, self.compliance = stream.empty((n, 4), made.real), stream.empty(n, made.real)

    def settled(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""
        self.run(moved, len(self.x), self.x, self.u, self.out)
        return self.out

    def run(self, kernel: Any, threads: int, *arguments: Any) -> None:
        """Launch a kernel whose threads loop over `threads` items."""
        kernel[sums.blocks(threads), sums.THREADS, self.stream.queue](*arguments)

    def linearise(self) -> None:
        """Initialise the springs at the reference, with zero tensions."""
        count = int(self.made.first[-1])
        self.run(self.kernels.linearise, count, self.x, count, self.springs)

    def project(self) -> None:
        """Project all springs once."""
        for begin, end in zip(self.made.first[:-1].tolist(), self.made.first[1:].tolist(), strict=True):
            self.run(self.kernels.project, end - begin, begin, end, self.springs, self.compliance, self.u)


class Passes(_Iterating):
    """State of an XPBD solve, which starts at the positions without springs."""

    def take(self, step: Step) -> None:
        """Load a step that is on the device, and start to solve it."""
        n, places = len(self.x), self.made.places
        self.run(self.kernels.anchor, n, places, step.target, step.force, step.pins, self.x, self.u, self.compliance)
        self.linearise()

    def sweep(self, count: int) -> int:
        """Launch iterations; return how many of them moved something."""
        for _ in range(count):
            self.project()
        return count


class SmallSteps(_Iterating):
    """State of a small-steps solve on the device.

    Each solve restarts at the start of the step, with one substep per iteration so far.
    """

    def __init__(self, made: PreparedXpbd) -> None:
        super().__init__(made)
        shape, empty = self.x.shape, self.stream.empty
        self._before, self._v = (empty(shape, np.float64) for _ in range(2))
        self._gives, self._substeps = empty(shape[0], np.float64), 0
        self._step: Step

    def take(self, step: Step) -> None:
        """Load a step that is on the device, and start to solve it."""
        self._substeps, self._step = 0, step

    def settled(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""
        return super().settled() if self._substeps else self._step.positions

    def speeds(self) -> Any:
        """Return the final velocity in rows (n, 3) [m/s], on the device."""
        return self._v if self._substeps else self._step.velocity

    def sweep(self, count: int) -> int:
        """Launch iterations; return how many of them moved something."""
        step, n, places = self._step, len(self.x), self.made.places
        self._substeps += count
        if not self._substeps:
            return count
        h = self.made.system.time_step / self._substeps
        self.stream.copy(step.positions, self.x)
        self.stream.copy(step.velocity, self._v)
        self.run(self.kernels.soften, n, places, h, self.u, self.compliance, self._gives)
        for left in range(self._substeps - 1, -1, -1):
            part = left / self._substeps
            self.run(
                predict, n, h, part, places, step.positions, step.pins, self._gives, step.force, self._v, self._before,
                self.x, self.u,
            )  # fmt: skip
            self.linearise()
            self.project()
            self.run(settle, n, h, self._before, self.x, self.u, self._v)
        return count
