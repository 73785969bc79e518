"""Nonlinear conjugate gradients on a device: the iterates of `solvers.methods.pncg`, with its blocks."""

from __future__ import annotations

import numpy as np

from solvers.core.preconditioning import Preconditioning
from solvers.cuda import device, sums, traffic
from solvers.cuda.descent import Base, Descending, PreparedDescent, Real
from solvers.cuda.steps import Step
from solvers.cuda.target import cuda
from solvers.problem import System


def prepare(system: System, preconditioner: Preconditioning, real: Real) -> PreparedDescent:
    """The method on the device, which is `ready`. Raises Unsupported, NotPositiveDefinite."""
    base = Base.of("pncg", system, preconditioner, real)
    words = f"kernels in {np.dtype(real)}, the gradient in float64"
    return PreparedDescent(system, base, device.told(), words, _Iterating, traffic.nonlinear(base.sizes, base.by))


class _Iterating(Descending):
    """came (f, 3): the direction that led to the last point."""

    def __init__(self, base: Base) -> None:
        super().__init__(base)
        self._beta, (n, _) = 0.0, self.d.shape
        self._came, self._before = self.stream.zeros((n, 3), base.real), self.stream.zeros((n, 3), base.real)
        self._gradient = self.stream.zeros((n, 3), np.float64)

    def take(self, step: Step) -> None:
        """See ResidentIterating."""
        super().take(step)
        self._beta = 0.0
        self.look()
        self.linearise()

    def one(self) -> bool:
        """See Descending."""
        slope, _ = self._measured(self.z, 0.0)
        if not -slope > self.floor:
            return False
        if not (self._beta and self._along(self._beta)) and not self._along(0.0) and not self.search(self.d):
            return False
        self._gradient, self.g = self.g, self._gradient
        self._before, self.z = self.z, self._before
        self.look()
        self.linearise()
        conjugacy[self.launch_over](self._gradient, self.g, self._before, self.z, self.d, self.partials)
        change, across, turned, along = self.collected(4, len(self.d))
        beta = -across + turned * along / change if change > 0.0 else 0.0
        self._came, self.d = self.d, self._came
        self._beta = float(beta / change) if np.isfinite(beta) and change > 0.0 else 0.0
        return True

    def _measured(self, z: object, beta: float) -> tuple[float, float]:
        """d = z + beta (the last one); its slope and, where d is one, its curvature."""
        combined[self.launch_over](z, beta, self._came, self.d)
        dotted[self.launch_over](self.g, self.d, 0, self.partials)
        self.kernels.multiply[self.launch_over](
            self.edges, self.of.hold, self.linear, self.d, self.h, 1, self.partials, self.idle
        )
        slope, curvature = self.collected(2, len(self.d))
        return float(slope), float(curvature)

    def _along(self, beta: float) -> bool:
        slope, curvature = self._measured(self.z, beta)
        return slope < 0.0 < curvature and self.search(self.d, -slope / curvature)


@cuda.jit
def combined(z, beta, came, d):
    """Write z + beta came to d, (f, 3)."""
    i = cuda.grid(1)
    while i < d.shape[0]:
        for c in range(3):
            d[i, c] = np.float64(z[i, c]) + beta * np.float64(came[i, c]) if beta != 0.0 else z[i, c]
        i += cuda.gridsize(1)


@cuda.jit
def dotted(a, b, which, partials):
    """The first stage of a'b, (f, 3)."""
    total, i = 0.0, cuda.grid(1)
    while i < b.shape[0]:
        for c in range(3):
            total += a[i, c] * np.float64(b[i, c])
        i += cuda.gridsize(1)
    sums.keep(total, which, partials)


@cuda.jit
def conjugacy(before, g, zb, z, d, partials):
    """The first stages of d'y, y'z, (z - z before)'y and g'd, with y = g - g before."""
    change, across, turned, along, i = 0.0, 0.0, 0.0, 0.0, cuda.grid(1)
    while i < d.shape[0]:
        for c in range(3):
            y, now = g[i, c] - before[i, c], np.float64(z[i, c])
            change += y * np.float64(d[i, c])
            across += y * now
            turned += y * (now - np.float64(zb[i, c]))
            along += g[i, c] * np.float64(d[i, c])
        i += cuda.gridsize(1)
    sums.keep(change, 0, partials)
    sums.keep(across, 1, partials)
    sums.keep(turned, 2, partials)
    sums.keep(along, 3, partials)
