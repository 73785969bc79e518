"""What descents on a device share: where they are, the objective's changes, and a line search.

Positions and gradients are float64, directions `real`: p + t d keeps the positions' digits, and the next gradient tells
what a direction missed. The host reads a few numbers: those of a trial, once each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solvers.core.descent import Stiffness
from solvers.core.driver import largest
from solvers.core.preconditioning import LEAST, Preconditioning
from solvers.cuda import device, objective_kernels, residual, schwarz, sums
from solvers.cuda.network import Network, require_known
from solvers.cuda.preconditioning import Jacobi
from solvers.cuda.resident import AT_ONCE, Minimising, ResidentIterating
from solvers.cuda.run import Stream
from solvers.cuda.stalling import StallingIterating
from solvers.cuda.steps import Begun, Step, Uploaded
from solvers.cuda.target import cuda
from solvers.cuda.traffic import Preconditioned, Sizes, jacobi, patches
from solvers.kernels.line_search import falls
from solvers.linear.schwarz import ordered
from solvers.problem import StepProblem, System, Unsupported

_HALVINGS = 60
"""A step so often halved has no digit left."""

_SUMS = 8
"""At a time."""

Real = type[np.float32] | type[np.float64]


@dataclass(frozen=True, eq=False)
class Base:
    """A system on the device. stiffness: Q, on the host, without a factor; least: what blocks get beside h (f,);
    preconditioning: makes the preconditioner of a solve, of so many rows; by: the bytes that it moves."""

    stiffness: Stiffness
    uploaded: Uploaded
    least: Any
    real: Real
    preconditioning: Callable[[Stream, int, Real], Jacobi]
    by: Preconditioned

    @property
    def sizes(self) -> Sizes:
        """By which bytes are counted."""
        return self.uploaded.network.sizes(np.dtype(self.real).itemsize)

    @classmethod
    def of(cls, solver: str, system: System, preconditioner: Preconditioning, real: Real) -> Base:
        """Raises Unsupported for what kernels do not know and for what the device has no room for, and
        NotPositiveDefinite."""
        if preconditioner == "factor":
            raise Unsupported(
                f"{solver}, device: cuda: knows preconditioner: block-jacobi and schwarz, not {preconditioner}; take "
                "one of these, or device: cpu"
            )
        require_known(solver, system)
        stiffness = Stiffness(system)
        order = ordered(stiffness.inner)
        network = Network.of(solver, system, order)
        size = np.dtype(real).itemsize
        vectors = network.free * (3.0 * (12 * 8 + 8 * size) + 6.0 * size + 8.0 * (8 + residual.NUMBERS))
        held = network.hold[: network.free] + LEAST * stiffness.diagonal[order]
        levels = schwarz.levels(network, held) if preconditioner == "schwarz" else []
        solves = vectors + schwarz.needed(levels, size) + 4.0 * size * len(network.entries.other)
        device.require_memory(solver, network.bytes + AT_ONCE * solves)
        with device.guarded():
            stream = Stream()
            least = stream.upload(LEAST * stiffness.diagonal[order])
            uploaded = [schwarz.UploadedLevel.of(stream, level) for level in levels]
            making = partial(schwarz.Schwarz, levels, uploaded) if levels else Jacobi
            sizes = network.sizes(size)
            each = [(level.nodes, level.edges, level.patches) for level in levels]
            by = patches(sizes, each) if levels else jacobi(sizes)
            return cls(stiffness, Uploaded.of(network, stream), least, real, making, by)


@dataclass(frozen=True, eq=False)
class PreparedDescent(Minimising):
    """A method that is ready. columns: of the device; solving: memory for solves; moves: bytes that an iteration must
    move at least."""

    system: System
    base: Base
    columns: dict[str, Any]
    choice: str
    solving: Callable[[Base], Descending]
    moves: float

    @property
    def uploaded(self) -> Uploaded:  # pyright: ignore[reportIncompatibleVariableOverride] the base's
        """See Minimising."""
        return self.base.uploaded

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built."""
        return {**self.base.stiffness.facts, "sweep_bytes": self.moves}

    def iterating(self) -> ResidentIterating:
        """See Resident."""
        return self.solving(self.base)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return largest(problem) * self.base.stiffness.trace**0.5


class Descending(StallingIterating):
    """From point to point. p, q (n, 3): where it is and a trial, in rows; g: the gradient at p (f, 3); z: what the
    preconditioner makes of -g; floor: g H^-1 g [J] of round-off."""

    def __init__(self, base: Base) -> None:
        uploaded, network = base.uploaded, base.uploaded.network
        super().__init__(uploaded)
        self.base, stream, rows = base, uploaded.stream, network.free
        self._begun = Begun(uploaded)
        self.edges, self.given = self._begun.edges, self._begun.given
        self.p, self.q = (stream.zeros((len(network.order), 3), np.float64) for _ in range(2))
        self.kernels = objective_kernels.kernels(base.real)
        self.preconditioner = base.preconditioning(stream, rows, base.real)
        self.linear = stream.zeros((4, len(network.entries.other)), base.real)
        self.g, self.z, self.d, self.h = (stream.zeros((rows, 3), t) for t in (np.float64, *(base.real,) * 3))
        self.partials, self.sums = sums.partials(_SUMS), stream.zeros(_SUMS, np.float64)
        self.idle, self._largest = stream.zeros(1, np.float64), stream.zeros(1, np.float64)
        self.launch_over = sums.blocks(rows), sums.THREADS, stream.queue
        self.over_all = sums.blocks(max(rows, len(network.ends))), sums.THREADS, stream.queue
        self.floor = 0.0

    def take(self, step: Step) -> None:
        """See ResidentIterating; waits for the largest coordinate, by which round-off is told."""
        self._begun.take(step, self.p, self.q)
        self.stream.put(np.zeros(1), self._largest)
        farthest[self.over_all](self.p, self._largest)
        self.floor = self.base.stiffness.round_off(self.stream.download(self._largest)[:, None])
        self.stalled, self.moves = False, 0

    def settled(self) -> Any:
        """See ResidentIterating."""
        return self.p

    def residual(self) -> float:
        """See Iterating; on the device, of its gradient."""
        with device.guarded():
            return self.of.residuals.of(self.g)

    def look(self) -> None:
        """The gradient at p."""
        objective_kernels.gradient[self.launch_over](self.edges, self.given, self.p, self.g)

    def linearise(self) -> None:
        """The Hessian at p, and z of the gradient there."""
        base, preconditioner = self.base, self.preconditioner
        self.kernels.linearise[self.launch_over](
            self.edges, self.of.hold, base.least, self.p, self.linear, preconditioner.blocks
        )
        preconditioner.linearised(self.edges, self.p)
        negated[self.launch_over](self.g, preconditioner.r)
        preconditioner.apply(self.z, 0, self.partials, self.idle)

    def collected(self, count: int, terms: int) -> NDArray[np.float64]:
        """The first sums, of so many terms; waits for them."""
        sums.collect[1, sums.THREADS, self.stream.queue](count, self.partials, sums.blocks(terms), self.sums)
        return self.stream.download(self.sums)[:count]

    def search(self, direction: Any, first: float = 1.0) -> bool:
        """Go to the first point at `first`, first/2, ... of a direction (f, 3) that descends enough; whether any
        does."""
        t, slope = first, float("nan")
        for _ in range(_HALVINGS):
            slope, rise = self._tried(direction, t)
            if not slope < 0.0:
                return False
            if falls(rise, t, slope, 0.0):
                self.p, self.q = self.q, self.p
                return True
            t *= 0.5
        return False

    def _tried(self, direction: Any, t: float) -> tuple[float, float]:
        trial[self.over_all](self.p, direction, t, self.q, self.g, 0, self.partials)
        objective_kernels.rise[self.over_all](self.edges, self.given, self.p, self.q, 1, self.partials)
        slope, rise = self.collected(2, max(self.of.network.free, len(self.of.network.ends)))
        return float(slope), float(rise)


@cuda.jit
def farthest(p, out):
    """The largest coordinate of p (n, 3), if it is larger than out[0]; which it is depends on no order."""
    most, i = 0.0, cuda.grid(1)
    while i < p.shape[0]:
        for c in range(3):
            most = max(most, abs(p[i, c]))
        i += cuda.gridsize(1)
    cuda.atomic.max(out, 0, most)


@cuda.jit
def negated(x, out):
    """Write -x (f, 3) to `out`, rounded."""
    i = cuda.grid(1)
    while i < out.shape[0]:
        out[i, 0], out[i, 1], out[i, 2] = -x[i, 0], -x[i, 1], -x[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def trial(p, d, t, q, g, which, partials):
    """Write p + t d to the first rows of q, and keep the first stage of g'd."""
    total, i = 0.0, cuda.grid(1)
    while i < d.shape[0]:
        for c in range(3):
            step = np.float64(d[i, c])
            q[i, c] = p[i, c] + t * step
            total += g[i, c] * step
        i += cuda.gridsize(1)
    sums.keep(total, which, partials)
