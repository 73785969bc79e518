"""Local-global iterations on a device: those of `solvers.methods.local_global_compiled`, in the form of corrections.

    p <- p - Q^-1 grad g(p)

The gradient is a kernel, Q^-1 is cuDSS's. The host looks at nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from solvers.core.descent import Stiffness
from solvers.core.driver import largest
from solvers.cuda import device, objective_kernels, residual, sums, traffic
from solvers.cuda.cudss import Cudss
from solvers.cuda.network import Network, require_known
from solvers.cuda.resident import AT_ONCE, Minimising, MinimisingIterating, ResidentIterating
from solvers.cuda.run import Stream
from solvers.cuda.steps import Begun, Step, Uploaded
from solvers.cuda.target import cuda
from solvers.problem import StepProblem, System

SOLVER = "numba"


def prepare(system: System) -> PreparedLocalGlobal:
    """The method on the device, which is `ready`. Raises NotPositiveDefinite, and Unsupported for what kernels do not
    know and for what the device has no room for, its factor apart."""
    require_known(SOLVER, system)
    stiffness = Stiffness(system)
    network = Network.of(SOLVER, system, np.arange(len(system.free)))
    device.require_memory(SOLVER, network.bytes + AT_ONCE * 8.0 * network.free * (15 + residual.NUMBERS))
    with device.guarded():
        stream = Stream()
        factor = Cudss(stiffness.inner, stream)
        return PreparedLocalGlobal(system, stiffness, Uploaded.of(network, stream), factor, device.told())


@dataclass(frozen=True, eq=False)
class PreparedLocalGlobal(Minimising):
    """stiffness: Q, on the host, without a factor; the rest is on the device."""

    system: System
    stiffness: Stiffness
    uploaded: Uploaded
    factor: Cudss
    columns: dict[str, Any]

    @property
    def choice(self) -> str:
        """What it chose."""
        return self.factor.choice

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built, and the bytes that an iteration must move: of a gradient, of a solve
        from it to a correction, 48 f and more, and of p read and written and that, 72 f."""
        sizes = self.uploaded.network.sizes(8)
        moves = traffic.gradient(sizes) + self.factor.moves + 120.0 * sizes.free
        return {**self.stiffness.facts, "nnz_factor": float(self.factor.nonzeros), "sweep_bytes": moves}

    def iterating(self) -> ResidentIterating:
        """See Resident."""
        return _Iterating(self)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return largest(problem) * self.stiffness.trace**0.5


class _Iterating(MinimisingIterating):
    """p (n, 3): where it is, in rows; g: the gradient there, c: the correction, (f, 3)."""

    def __init__(self, made: PreparedLocalGlobal) -> None:
        super().__init__(made.uploaded)
        self._factor, rows, stream = made.factor, made.uploaded.network.free, self.stream
        self._begun = Begun(made.uploaded)
        self._p = stream.empty((len(self.order), 3), np.float64)
        self._g, self._c = (stream.empty((rows, 3), np.float64) for _ in range(2))
        self._over = sums.blocks(rows), sums.THREADS, stream.queue

    def take(self, step: Step) -> None:
        """See ResidentIterating."""
        self._begun.take(step, self._p)

    def settled(self) -> Any:
        """See ResidentIterating."""
        return self._p

    def sweep(self, count: int) -> None:
        """See DeviceIterating."""
        for _ in range(count):
            self._look()
            if len(self._g):
                self._factor.apply(self._g, self._c)
            moved[self._over](self._c, self._p)

    def residual(self) -> float:
        """See Iterating; on the device."""
        with device.guarded():
            self._look()
            return self.of.residuals.of(self._g)

    def _look(self) -> None:
        objective_kernels.gradient[self._over](self._begun.edges, self._begun.given, self._p, self._g)


@cuda.jit
def moved(c, p):
    """Add c (f, 3) to the first rows of p."""
    i = cuda.grid(1)
    while i < c.shape[0]:
        p[i, 0], p[i, 1], p[i, 2] = p[i, 0] + c[i, 0], p[i, 1] + c[i, 1], p[i, 2] + c[i, 2]
        i += cuda.gridsize(1)
