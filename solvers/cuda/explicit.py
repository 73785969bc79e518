"""Explicit methods on a device: the frames of `solvers.methods.explicit` and `solvers.methods.symplectic_euler`.

A frame of compositions is launched as a whole. One of Runge-Kutta methods that choose their steps is launched TOGETHER
steps at a time, after which the host looks whether it has ended; what they choose they choose on the device.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers import matrices
from solvers.core.explicit_tables import Composition, Tableau, in_time, most_steps
from solvers.core.forces import ForceParts
from solvers.cuda import device, sums
from solvers.cuda.explicit_kernels import (
    ACCEPTED,
    BEFORE,
    ENDED,
    LAST,
    REJECTED,
    STEP,
    H,
    Motion,
    T,
    choose,
    drifted,
    errors,
    kernels,
    stage,
    take,
)
from solvers.cuda.network import Edges, Network
from solvers.cuda.run import DeviceIterating, DeviceIterative, Stream
from solvers.energies.quadratic import drag_of_vertices
from solvers.kernels.loop import ITERATIONS, Limits
from solvers.linear.schwarz import ordered
from solvers.problem import Pins, Positions, ProjectiveEnergy, ResidualOf, StepProblem, System, Unsupported

TOGETHER = 16
"""Steps that choose their successors that are launched at a time."""

Real = type[np.float32] | type[np.float64]


@dataclass(frozen=True)
class Substeps:
    """What the method chose. count: substeps of a step, where they have one length, else the fewest that are stable;
    tolerance [m]: of each where they have not, else 0; rate: of the fastest motion [1/s]; choice: in words."""

    count: int
    tolerance: float
    rate: float
    choice: str


def prepare(
    solver: str, system: System, method: Composition | Tableau, parts: ForceParts, substeps: Substeps, real: Real
) -> PreparedExplicit:
    """The method on the device, which is `ready`. parts: what the system's forces are, all of which it knows. Raises
    Unsupported where the device has no room."""
    still = Pins(system.pins.vertices, np.full(len(system.pins.vertices), np.inf))
    energies = tuple(e for e in system.energies if drag_of_vertices(e) is None)
    bare = replace(system, pins=still, energies=energies)
    Q = matrices.assemble(bare, [e for e in energies if isinstance(e, ProjectiveEnergy)])
    network = Network.of(solver, bare, ordered(csr_array(csr_array(Q[bare.free])[:, bare.free])))
    stages = len(method.a) if isinstance(method, Tableau) else 0
    device.require_memory(solver, network.bytes + 8.0 * system.vertices * (20 + 6 * stages))
    with device.guarded():
        stream = Stream()
        edges = network.upload(stream)
        return PreparedExplicit(system, network, stream, edges, method, parts, substeps, real, device.told())


@dataclass(frozen=True, eq=False)
class PreparedExplicit(DeviceIterative):
    """network: with all pins held exactly; the rest is what `prepare` got."""

    residual_of: ClassVar[ResidualOf] = "none"
    factorisations: ClassVar[int] = 0

    system: System
    network: Network
    stream: Stream
    edges: Edges
    method: Composition | Tableau
    parts: ForceParts
    substeps: Substeps
    real: Real
    columns: dict[str, Any]
    facts: dict[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        """What compositions must move: of each kick the entries, and rows of positions, velocities and forces."""
        if isinstance(self.method, Composition):
            free = self.network.free
            kick = 20.0 * len(self.network.entries.other) + 8.0 * free * (3 + 3 + 3 + 3 + 3 + 2)
            self.facts["sweep_bytes"] = self.substeps.count * self.method.evaluations * kick

    @property
    def choice(self) -> str:
        """What it chose."""
        return f"{self.substeps.choice}; tensions in {np.dtype(self.real)}, the rest in float64"

    @property
    def order(self) -> int:
        """Of the error."""
        return self.method.order

    @property
    def evaluations(self) -> int:
        """Of the forces, in a substep."""
        return self.method.evaluations

    def within(self, tolerance: float) -> PreparedExplicit:
        """The same with an error of each substep [m]. Raises Unsupported for substeps of one length."""
        if not self.substeps.tolerance:
            raise Unsupported("the method chooses no steps by an error")
        return replace(self, substeps=replace(self.substeps, tolerance=tolerance))

    def refined(self, times: float) -> PreparedExplicit:
        """The same with so many times the substeps, rounded up."""
        count = ceil(times * self.substeps.count)
        return replace(self, substeps=replace(self.substeps, count=count), facts={})

    def begin(self, problem: StepProblem, guess: Positions) -> DeviceIterating:
        """The whole step."""
        return self._frame(problem, None)

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, NDArray[np.float64]]:
        """Positions and velocities (n, 3) at the step's end, and steps accepted, rejected and the last one's length
        [s]; h: the first one's of a method that chooses them, from the fastest motion if left out."""
        run = self._frame(problem, h)
        run.launch(1)
        p, v = run.positions, run.velocity
        assert v is not None
        return p, v, run.told

    def _frame(self, problem: StepProblem, h: float | None) -> _Frame:
        with device.guarded():
            if isinstance(self.method, Composition):
                return _Composed(self, self.method, problem)
            return _Chosen(self, self.method, problem, h)


class _Frame(DeviceIterating):
    """The whole step as the only iterate. p, q (n, 3): positions before and after a launch; v (f, 3); told: steps
    accepted, rejected and the last one's length [s]."""

    told: NDArray[np.float64]

    def __init__(self, made: PreparedExplicit, problem: StepProblem) -> None:
        super().__init__(made.stream)
        self.made, self.problem, self.kernels = made, problem, kernels(made.real)
        stream, network, s, start = made.stream, made.network, made.system, problem.start
        inside, pinned = network.order[: network.free], network.order[network.free :]
        self.frame, self.drag = s.time_step, made.parts.drag[inside]
        held = made.parts.held if len(made.parts.held) else np.zeros(s.vertices)
        self.pins = start.positions[pinned], problem.pin_targets
        begin, end = (x if len(x) else np.zeros((1, 3)) for x in self.pins)
        force = (problem.force + made.parts.load)[inside]
        given = held[inside], force, 1.0 / s.mass[inside], self.drag, begin, end
        self.motion = Motion(*map(stream.upload, given))
        rows = start.positions[network.order]
        self.p, self.q, self.v = stream.upload(rows), stream.upload(rows), stream.upload(start.velocity[inside])
        self.launch_over = sums.blocks(len(rows)), sums.THREADS, stream.queue
        self._ended = False

    def sweep(self, count: int) -> None:
        """See DeviceIterating; the frame, once."""
        if count and not self._ended:
            self.run()
            self._ended = True

    @abstractmethod
    def run(self) -> None:
        """Launch the frame."""

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating."""
        self.launch(1)
        return 1, float("nan"), ITERATIONS

    def fetch(self) -> Positions:
        """See DeviceIterating; the velocity comes with it."""
        network, (begin, end) = self.made.network, self.pins
        self.velocity = network.fetched(self.stream.download(self.v))
        self.velocity[network.order[network.free :]] = (end - begin) / self.frame
        return network.fetched(self.stream.download(self.p))


class _Composed(_Frame):
    """Drifts and kicks in turns, as `solvers.kernels.explicit_steps.compose` has them."""

    def __init__(self, made: PreparedExplicit, method: Composition, problem: StepProblem) -> None:
        super().__init__(made, problem)
        self._drifts, drag, count = method.drifts.tolist(), self.drag, made.substeps.count
        self._count, self._h = count, self.frame / count
        kept, gained = in_time(method.kicks, self._h, drag if drag.any() else np.zeros(1))
        self._kept, self._gained, self._last = self.stream.upload(kept), self.stream.upload(gained), len(kept) - 1
        self.told = np.array([count, 0.0, self._h])
        self.uploaded()

    def run(self) -> None:
        """See _Frame."""
        drifts, count, last = self._drifts, self._count, self._last
        joined = drifts[0] == drifts[-1] == 0.0
        part = 0.0
        for step in range(count):
            gone = drifts[0]
            if gone:
                drifted[self.launch_over](self.motion, gone * self._h, (step + gone) / count, self.p, self.v)
            for k in range(1 if joined and step > 0 else 0, last + 1):
                both = joined and k == last and step < count - 1
                after = drifts[1] if both else drifts[k + 1]
                gone = 1.0 + after if both else gone + after
                part = (step + gone) / count if after else part  # without a drift pins stay where they are
                self.kernels.kick[self.launch_over](
                    self.made.edges, self.motion, self._kept, self._gained, k, 0 if both else -1, after * self._h,
                    part, self.p, self.v, self.q,
                )  # fmt: skip
                self.p, self.q = self.q, self.p


class _Chosen(_Frame):
    """Runge-Kutta steps, of one length or as their error asks for; see `explicit_kernels` for `now`."""

    def __init__(self, made: PreparedExplicit, method: Tableau, problem: StepProblem, h: float | None) -> None:
        super().__init__(made, problem)
        steps, frame, stream, s = made.substeps, self.frame, self.stream, len(method.a)
        self._fixed, self._method, self._tolerance = not steps.tolerance, method, steps.tolerance or 1.0
        first = frame / steps.count if self._fixed else min(frame, h or (1.0 / steps.rate if steps.rate else frame))
        self._most, last = float(most_steps(steps.count, steps.tolerance)), 1.0000001 * first >= frame
        now = np.zeros(9)
        now[STEP], now[H], now[LAST], now[BEFORE] = frame if last else first, first, last, 1.0
        self._now, self._a, self._times = stream.upload(now), stream.upload(method.a), stream.upload(method.times)
        self._weights = stream.upload(method.errors if len(method.errors) else np.zeros((1, s)))
        speeds = np.zeros((s, *self.v.shape))
        speeds[0] = problem.start.velocity[made.network.order[: made.network.free]]
        self._speeds, self._pulls = stream.upload(speeds), stream.zeros(speeds.shape, np.float64)
        self._partials, self._over = sums.partials(2), (sums.blocks(len(self.v)), sums.THREADS, stream.queue)
        self.uploaded()

    def run(self) -> None:
        """See _Frame. Raises RuntimeError where the error is kept by no step."""
        frame, steps = self.frame, self.made.substeps
        self._evaluate(0, self.p)
        now = np.zeros(9)
        while not now[ENDED]:
            for _ in range(steps.count if self._fixed else TOGETHER):
                self._step()
            now = self.stream.download(self._now)
        self.told = now[[ACCEPTED, REJECTED, H]]
        if now[T] < frame:
            raise RuntimeError(self._method.unfinished(sum(self.told[:2]), now[H], now[T], frame, self._tolerance))

    def _step(self) -> None:
        end, (count, threads, queue) = len(self._method.a) - 1, self._over
        for s in range(1, end + 1):
            stage[self.launch_over](
                self.motion, self.frame, self._a, self._times, s, self.p, self.v, self._speeds, self._pulls, self.q,
                self._now,
            )  # fmt: skip
            self._evaluate(s, self.q)
        estimates = 0 if self._fixed else len(self._method.errors)
        if estimates:
            errors[self._over](self._weights, self.frame, self._speeds, self._pulls, self._partials, self._now)
        choose[1, threads, queue](
            self.frame, self._tolerance, 0.0 if self._fixed else self._method.power, self._most,
            3.0 * self.made.network.free, estimates, self._partials, count, self._now,
        )  # fmt: skip
        take[self.launch_over](end, self.q, self.p, self.v, self._speeds, self._pulls, self._now)

    def _evaluate(self, s: int, q: Any) -> None:
        self.kernels.evaluate[self._over](self.made.edges, self.motion, q, s, self._speeds, self._pulls, self._now)
