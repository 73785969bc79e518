"""Explicit methods on a device: the frames of `solvers.methods.explicit` and `solvers.methods.symplectic_euler`.

A frame of compositions is launched as a whole. One of Runge-Kutta methods that choose their steps is launched TOGETHER
steps at a time, after which the host looks whether it has ended; what they choose they choose on the device.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers import matrices
from solvers.core.explicit_tables import Composition, Tableau, in_time, most_steps
from solvers.core.forces import ForceParts
from solvers.core.substeps import Substepping, Substeps
from solvers.cuda import device, sums, traffic
from solvers.cuda.explicit_kernels import (
    ACCEPTED,
    BEFORE,
    ENDED,
    LAST,
    NOTHING,
    REJECTED,
    STEP,
    H,
    Motion,
    T,
    begin,
    choose,
    drifted,
    errors,
    kernels,
    speeds,
    stage,
    take,
)
from solvers.cuda.network import Edges, Network
from solvers.cuda.resident import AT_ONCE, Resident, ResidentIterating
from solvers.cuda.residual import copied
from solvers.cuda.run import Stream
from solvers.cuda.steps import Step, pins_of
from solvers.energies.quadratic import drag_of_vertices
from solvers.kernels.loop import ITERATIONS, Limits
from solvers.linear.schwarz import ordered
from solvers.problem import Pins, Positions, ProjectiveEnergy, StepProblem, System

TOGETHER = 16
"""Steps that choose their successors that are launched at a time."""

Real = type[np.float32] | type[np.float64]


class Held(NamedTuple):
    """On the device, what else than edges acts on free rows (f,): hold [N/m], inverse: 1/m [1/kg], drag [1/s]."""

    hold: Any
    inverse: Any
    drag: Any


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
    device.require_memory(solver, network.bytes + 8.0 * system.vertices * (20 + AT_ONCE * (15 + 6 * stages)))
    with device.guarded():
        stream = Stream()
        inside = network.order[: network.free]
        held = parts.held if len(parts.held) else np.zeros(system.vertices)
        there = Held(*map(stream.upload, (held[inside], 1.0 / system.mass[inside], parts.drag[inside])))
        vertex = stream.upload(network.order, np.int32)
        edges = network.upload(stream)
        return PreparedExplicit(
            method, substeps, system, network, stream, vertex, edges, there, parts, real, device.told()
        )


@dataclass(frozen=True, eq=False)
class PreparedExplicit(Substepping, Resident):
    """network: with all pins held exactly; parts: what the forces are; on the device: vertex (n,) of each row, edges,
    held: what else acts on free rows."""

    own: ClassVar[bool] = True

    system: System
    network: Network
    stream: Stream
    vertex: Any
    edges: Edges
    held: Held
    parts: ForceParts
    real: Real
    columns: dict[str, Any]

    @property
    def facts(self) -> dict[str, float]:
        """The bytes that a frame must move (`traffic`), of a method that chooses its steps in as many as are stable."""
        network, method = self.network, self.method
        of = network.sizes(8)
        if isinstance(method, Composition):
            return {"sweep_bytes": traffic.kicks(of, method, self.substeps.count, drags=bool(self.parts.drag.any()))}
        return {"sweep_bytes": self.substeps.count * traffic.stages(of, method, chosen=self.substeps.tolerance > 0.0)}

    @property
    def choice(self) -> str:
        """What it chose."""
        return f"{self.substeps.choice}; tensions in {np.dtype(self.real)}, the rest in float64"

    def stated(self, problem: StepProblem, guess: Positions) -> Step:
        """See Resident; the guess is not used."""
        up, start = self.stream.upload, problem.start
        force, p, v = up(problem.force + self.parts.load), up(start.positions), up(start.velocity)
        return Step(p, force, p, pins_of(problem, self.stream), p, p, p, v, (start.time, start.until))

    def iterating(self) -> Frame:
        """See Resident."""
        return Composed(self, self.method) if isinstance(self.method, Composition) else Chosen(self, self.method)

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, NDArray[np.float64]]:
        """Positions and velocities (n, 3) at the step's end, and steps accepted, rejected and the last one's length
        [s]; h: the first one's of a method that chooses them, from the fastest motion if left out."""
        with device.guarded():
            run = self.iterating()
            if isinstance(run, Chosen) and h:
                run.begin_with(h)
            run.take(self.stated(problem, problem.first_guess))
            run.launch(1)
        p, v = run.positions, run.velocity
        assert v is not None
        return p, v, run.told


class Frame(ResidentIterating):
    """The whole step as the only iterate. p, q (n, 3): positions before and after a launch; v (f, 3); told: steps
    accepted, rejected and the last one's length [s]."""

    told: NDArray[np.float64]

    def __init__(self, made: PreparedExplicit) -> None:
        super().__init__(made.stream, made.network.order, made.vertex)
        self.made, self.kernels, self.frame = made, kernels(made.real), made.system.time_step
        free, pinned = made.network.free, max(1, len(made.system.pins.vertices))
        self.p, self.q, self._speeds = (self.stream.empty((len(self.order), 3), np.float64) for _ in range(3))
        force, begin, end = (self.stream.empty((k, 3), np.float64) for k in (free, pinned, pinned))
        self.v = self.stream.empty((free, 3), np.float64)
        self.motion = Motion(made.held.hold, force, made.held.inverse, made.held.drag, begin, end)
        self.launch_over = sums.blocks(len(self.order)), sums.THREADS, self.stream.queue
        self._ended = False

    def take(self, step: Step) -> None:
        """See ResidentIterating."""
        self._ended = False
        begin[self.launch_over](self.vertex, step, self.motion, self.p, self.q, self.v)

    def settled(self) -> Any:
        """See ResidentIterating."""
        return self.p

    def speeds(self) -> Any:
        """See ResidentIterating; pins move evenly."""
        speeds[self.launch_over](self.motion, self.frame, self.v, self._speeds)
        return self._speeds

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


class Composed(Frame):
    """Drifts and kicks in turns, as `solvers.kernels.explicit_steps.compose` has them."""

    def __init__(self, made: PreparedExplicit, method: Composition) -> None:
        super().__init__(made)
        count, drag = made.substeps.count, made.parts.drag[self.order[: made.network.free]]
        self._drifts, self._count, self._h = method.drifts.tolist(), count, self.frame / count
        kept, gained = in_time(method.kicks, self._h, drag if drag.any() else np.zeros(1))
        self._kept, self._gained, self._last = self.stream.upload(kept), self.stream.upload(gained), len(kept) - 1
        self.told = np.array([count, 0.0, self._h])

    def run(self) -> None:
        """See Frame."""
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


class Chosen(Frame):
    """Runge-Kutta steps, of one length or as their error asks for; see `explicit_kernels` for `now`."""

    def __init__(self, made: PreparedExplicit, method: Tableau) -> None:
        super().__init__(made)
        steps, frame, stream, s = made.substeps, self.frame, self.stream, len(method.a)
        self._fixed, self._method, self._tolerance = not steps.tolerance, method, steps.tolerance or 1.0
        self._most = float(most_steps(steps.count, steps.tolerance))
        self._begun, self._now = stream.empty(len(NOTHING), np.float64), stream.empty(len(NOTHING), np.float64)
        first = frame / steps.count if self._fixed else min(frame, 1.0 / steps.rate if steps.rate else frame)
        self.begin_with(first)
        self._a, self._times = stream.upload(method.a), stream.upload(method.times)
        self._weights = stream.upload(method.errors if len(method.errors) else np.zeros((1, s)))
        self._stages, self._pulls = (stream.empty((s, *self.v.shape), np.float64) for _ in range(2))
        self._partials, self._over = sums.partials(2), (sums.blocks(len(self.v)), sums.THREADS, stream.queue)

    def begin_with(self, h: float) -> None:
        """Let the first step be one of h [s]."""
        h, now = min(self.frame, h), NOTHING.copy()
        last = 1.0000001 * h >= self.frame
        now[STEP], now[H], now[LAST], now[BEFORE] = self.frame if last else h, h, last, 1.0
        self.told = np.array([self.made.substeps.count, 0.0, h])
        self.stream.put(now, self._begun)

    def take(self, step: Step) -> None:
        """See ResidentIterating."""
        super().take(step)
        self.stream.copy(self._begun, self._now)
        copied[self._over](self.v, self._stages[0])

    def run(self) -> None:
        """See Frame; of steps of one length it is known how many there are, and nothing is looked at. Raises
        RuntimeError where the error is kept by no step."""
        frame, count = self.frame, self.made.substeps.count
        self._evaluate(0, self.p)
        if self._fixed:
            for _ in range(count):
                self._step()
            return
        now = NOTHING
        while not now[ENDED]:
            for _ in range(TOGETHER):
                self._step()
            now = self.stream.download(self._now)
        self.told = now[[ACCEPTED, REJECTED, H]]
        if now[T] < frame:
            raise RuntimeError(self._method.unfinished(sum(self.told[:2]), now[H], now[T], frame, self._tolerance))

    def _step(self) -> None:
        end, (count, threads, queue) = len(self._method.a) - 1, self._over
        for s in range(1, end + 1):
            stage[self.launch_over](
                self.motion, self.frame, self._a, self._times, s, self.p, self.v, self._stages, self._pulls, self.q,
                self._now,
            )  # fmt: skip
            self._evaluate(s, self.q)
        estimates = 0 if self._fixed else len(self._method.errors)
        if estimates:
            errors[self._over](self._weights, self.frame, self._stages, self._pulls, self._partials, self._now)
        choose[1, threads, queue](
            self.frame, self._tolerance, 0.0 if self._fixed else self._method.power, self._most,
            3.0 * self.made.network.free, estimates, self._partials, count, self._now,
        )  # fmt: skip
        take[self.launch_over](end, self.q, self.p, self.v, self._stages, self._pulls, self._now)

    def _evaluate(self, s: int, q: Any) -> None:
        self.kernels.evaluate[self._over](self.made.edges, self.motion, q, s, self._stages, self._pulls, self._now)
