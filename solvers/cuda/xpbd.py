"""XPBD on a device: the iterates of `solvers.methods.xpbd`, a colour of springs a launch, a spring a thread.

    D = x_i - x_j,   w = u_i - u_j,   v = D + w,   |v| - r = (|D| - r) + (D + v).w / (|D| + |v|)

No two springs of a colour share a vertex, so that nobody writes what another reads. x, where the vertices would go
without springs, and |D| - r are float64, what the springs move from there, u, is of the kernels' type: float32 errs by
a part of that, and of how far a spring is from its rest length. `ease` is computed where it is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.core import vertex_terms
from solvers.cuda import device, sums
from solvers.cuda.run import DeviceIterating, DeviceIterative, Stream
from solvers.cuda.springs import SHORT
from solvers.cuda.target import cuda
from solvers.kernels.xpbd import Constraints
from solvers.problem import Positions, ResidualOf, StepProblem, System

Real = type[np.float32] | type[np.float64]


def prepare(
    system: System, constraints: Constraints, first: NDArray[np.int64], real: Real, choice: str, *, small: bool
) -> PreparedXpbd:
    """The method on the device, which is `ready`. constraints: the springs by colour; first (colours + 1,): the first
    of each; small: whether in small steps. Raises Unsupported where the device has no room."""
    m, n, size = len(constraints.stiffness), system.vertices, np.dtype(real).itemsize
    device.require_memory("xpbd", m * (8 + 8 + 24 + 6.0 * size) + n * (5 * 24 + 8 + 5.0 * size))
    with device.guarded():
        stream = Stream()
        springs = Springs.of(stream, constraints, real)
        told = f"{choice}; kernels in {np.dtype(real)}, from a reference in float64"
        return PreparedXpbd(system, stream, springs, first, real, small, device.told(), told)


class Springs(NamedTuple):
    """On the device: ends (m, 2), stiffness (m,) [N/m], rest: r (m,) [m], and direction (m, 3), taken at zero length;
    of a solve arrows (4, m): D and |D| - r [m], and tension (m,) [N]."""

    ends: Any
    stiffness: Any
    rest: Any
    direction: Any
    arrows: Any = None
    tension: Any = None

    @classmethod
    def of(cls, stream: Stream, constraints: Constraints, real: Real) -> Springs:
        """The constraints, on the device, which has no empty arrays."""
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
        """For a solve."""
        m = len(self.stiffness)
        return self._replace(arrows=cuda.device_array((4, m), real), tension=cuda.device_array(m, real))


@dataclass(frozen=True, eq=False)
class PreparedXpbd(DeviceIterative):
    """first (colours + 1,): of each colour's springs; small: whether in small steps."""

    residual_of: ClassVar[ResidualOf] = "none"

    system: System
    stream: Stream
    springs: Springs
    first: NDArray[np.int64]
    real: Real
    small: bool
    columns: dict[str, Any]
    choice: str
    facts: dict[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        """An iteration reads and writes the rows of both ends of a spring, for each colour has others."""
        size = np.dtype(self.real).itemsize
        self.facts["sweep_bytes"] = float(self.first[-1] * (8 + 7 * size + 2 * (2 * 4 + 1) * size))

    def begin(self, problem: StepProblem, guess: Positions) -> DeviceIterating:
        """See Iterative; from where the vertices would go without springs, or where the step starts."""
        with device.guarded():
            return (_SmallSteps if self.small else _Passes)(self, problem)


class _Iterating(DeviceIterating):
    """x (n, 3): the reference [m]; u (n, 4): the displacement from it; compliance (n,): 1/held [m/N]."""

    def __init__(self, made: PreparedXpbd, p: Positions, compliance: NDArray[np.float64]) -> None:
        super().__init__(made.stream)
        self.made, self.kernels, stream = made, kernels(made.real), made.stream
        self.springs, self.compliance = made.springs.begun(made.real), stream.upload(compliance, made.real)
        self.x, self.u, self.out = stream.upload(p), stream.zeros((len(p), 4), made.real), cuda.device_array(p.shape)

    def fetch(self) -> Positions:
        """See DeviceIterating."""
        self.run(moved, len(self.x), self.x, self.u, self.out)
        return self.stream.download(self.out)

    def run(self, kernel: Any, threads: int, *arguments: Any) -> None:
        """Launch a kernel whose threads go through so many items."""
        kernel[sums.blocks(threads), sums.THREADS, self.stream.queue](*arguments)

    def linearise(self) -> None:
        """The springs at the reference, without tension."""
        count = int(self.made.first[-1])
        self.run(self.kernels.linearise, count, self.x, count, self.springs)

    def project(self) -> None:
        """One pass over all springs."""
        for begin, end in zip(self.made.first[:-1].tolist(), self.made.first[1:].tolist(), strict=True):
            self.run(self.kernels.project, end - begin, begin, end, self.springs, self.compliance, self.u)


class _Passes(_Iterating):
    def __init__(self, made: PreparedXpbd, problem: StepProblem) -> None:
        super().__init__(made, vertex_terms.anchors(problem), 1.0 / vertex_terms.held(problem.system))
        self.uploaded()
        self.linearise()

    def sweep(self, count: int) -> None:
        """See DeviceIterating."""
        for _ in range(count):
            self.project()


class _SmallSteps(_Iterating):
    """The whole step in as many substeps as iterations were asked for so far, each time from its start."""

    def __init__(self, made: PreparedXpbd, problem: StepProblem) -> None:
        start, pins, stream = problem.start, problem.system.pins, made.stream
        super().__init__(made, start.positions, np.zeros(problem.system.vertices))
        self._problem, self._substeps = problem, 0
        pin, q = np.full(problem.system.vertices, -1, np.int32), max(1, len(pins.vertices))
        pin[pins.vertices] = np.arange(len(pins.vertices))
        moves = np.zeros((q, 7))
        moves[: len(pins.vertices)] = np.column_stack(
            [pins.weight, start.positions[pins.vertices], problem.pin_targets]
        )
        self._pin, self._moves, self._force = stream.upload(pin), stream.upload(moves), stream.upload(problem.force)
        self._before, self._v = stream.upload(start.positions), stream.upload(start.velocity)
        self._gives = stream.zeros(problem.system.vertices, np.float64)
        self.uploaded()

    def fetch(self) -> Positions:
        """See DeviceIterating; the velocity comes with it."""
        self.velocity = self.stream.download(self._v)
        return super().fetch()

    def sweep(self, count: int) -> None:
        """See DeviceIterating."""
        self._substeps += count
        system, start, n = self._problem.system, self._problem.start, len(self.x)
        h = system.time_step / self._substeps
        compliance = 1.0 / vertex_terms.held(replace(system, time_step=h))
        for given, there in (
            (compliance, self.compliance),
            (compliance, self._gives),
            (start.positions, self.x),
            (start.velocity, self._v),
            (np.zeros((n, 4)), self.u),
        ):
            self.stream.put(given, there)
        for left in range(self._substeps - 1, -1, -1):
            part = left / self._substeps
            self.run(
                predict, n, h, part, self._pin, self._moves, self._gives, self._force, self._v, self._before, self.x,
                self.u,
            )  # fmt: skip
            self.linearise()
            self.project()
            self.run(settle, n, h, self._before, self.x, self.u, self._v)


class Kernels(NamedTuple):
    """Of a precision: see each."""

    linearise: Any
    project: Any


@cache
def kernels(real: Real) -> Kernels:
    """Those that compute in `real`."""
    zero, one, short = real(0.0), real(1.0), real(SHORT[real])

    @cuda.jit
    def linearise(x, count, springs):
        """Write D and |D| - r of `count` springs, and no tension."""
        e = cuda.grid(1)
        while e < count:
            i, j = springs.ends[e, 0], springs.ends[e, 1]
            v0, v1, v2 = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
            length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            springs.arrows[0, e], springs.arrows[1, e], springs.arrows[2, e] = real(v0), real(v1), real(v2)
            springs.arrows[3, e] = real(length - springs.rest[e])
            springs.tension[e] = zero
            e += cuda.gridsize(1)

    @cuda.jit
    def project(begin, end, springs, compliance, u):
        """Move both ends of the springs from `begin` to `end`, all of one colour."""
        e = begin + cuda.grid(1)
        while e < end:
            i, j = springs.ends[e, 0], springs.ends[e, 1]
            d0, d1, d2 = springs.arrows[0, e], springs.arrows[1, e], springs.arrows[2, e]
            w0, w1, w2 = u[i, 0] - u[j, 0], u[i, 1] - u[j, 1], u[i, 2] - u[j, 2]
            v0, v1, v2 = d0 + w0, d1 + w1, d2 + w2
            squared = v0 * v0 + v1 * v1 + v2 * v2
            if squared <= short:
                stretch = -real(springs.rest[e])
                v0, v1 = real(springs.direction[e, 0]), real(springs.direction[e, 1])
                v2 = real(springs.direction[e, 2])
            else:
                length = real(math.sqrt(squared))
                both = length + real(math.sqrt(d0 * d0 + d1 * d1 + d2 * d2))
                stretch = springs.arrows[3, e] + ((d0 + v0) * w0 + (d1 + v1) * w1 + (d2 + v2) * w2) / both
                scale = one / length
                v0, v1, v2 = scale * v0, scale * v1, scale * v2
            k, gives, takes = springs.stiffness[e], compliance[i], compliance[j]
            change = (k * stretch - springs.tension[e]) / (one + k * (gives + takes))
            springs.tension[e] += change
            a, b = gives * change, takes * change
            u[i, 0], u[i, 1], u[i, 2] = u[i, 0] - a * v0, u[i, 1] - a * v1, u[i, 2] - a * v2
            u[j, 0], u[j, 1], u[j, 2] = u[j, 0] + b * v0, u[j, 1] + b * v1, u[j, 2] + b * v2
            e += cuda.gridsize(1)

    return Kernels(linearise, project)


@cuda.jit
def moved(x, u, out):
    """Write x + u to `out`, (n, 3) [m]."""
    i = cuda.grid(1)
    while i < x.shape[0]:
        for c in range(3):
            out[i, c] = x[i, c] + np.float64(u[i, c])
        i += cuda.gridsize(1)


@cuda.jit
def predict(h, left, pin, moves, compliance, force, v, before, x, u):
    """Write to x where the vertices would go without springs in a substep of h [s]; u is 0 there.

    left: the part of the step that comes after it; pin (n,): of each vertex, -1 for none; moves (q, 7): of each its
    weight [N/m], and where it moves from and to [m].
    """
    i = cuda.grid(1)
    while i < x.shape[0]:
        q = pin[i]
        for c in range(3):
            here = x[i, c]
            before[i, c], u[i, c] = here, 0.0
            there = here + h * v[i, c] + compliance[i] * force[i, c]
            if q >= 0:
                target = moves[q, 4 + c] + left * (moves[q, 1 + c] - moves[q, 4 + c])
                if math.isinf(moves[q, 0]):
                    there = target
                else:
                    # What inertia alone would lead to, without the force that was added above.
                    there += compliance[i] * moves[q, 0] * (target - here - h * v[i, c])
            x[i, c] = there
        i += cuda.gridsize(1)


@cuda.jit
def settle(h, before, x, u, v):
    """The end of a substep: x + u is where it ends, and by that the velocity."""
    i = cuda.grid(1)
    while i < x.shape[0]:
        for c in range(3):
            there = x[i, c] + np.float64(u[i, c])
            v[i, c] = (there - before[i, c]) / h
            x[i, c], u[i, c] = there, 0.0
        i += cuda.gridsize(1)
