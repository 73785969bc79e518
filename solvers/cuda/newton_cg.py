"""Newton's method by conjugate gradients on a device: the iterates of `solvers.methods.newton_cg`, with its blocks.

Conjugate gradients run on the device; the host looks after each TOGETHER iterations whether they have ended.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from solvers.core.preconditioning import Preconditioning
from solvers.cuda import device, sums, traffic
from solvers.cuda.conjugate import BEFORE, COUNT, CURVED, ENDED, GOING, LIMIT, PRODUCT, curve, judge, kernels
from solvers.cuda.descent import Base, Descending, PreparedDescent, Real
from solvers.cuda.steps import Step
from solvers.problem import System

TOGETHER = 16
"""Iterations of conjugate gradients that are launched at a time."""


def prepare(
    system: System, preconditioner: Preconditioning, real: Real, forcing: tuple[float, float], most: int
) -> PreparedDescent:
    """The method on the device, which is `ready`. forcing: the bounds of eta, from above and from below; most:
    iterations of conjugate gradients. Raises Unsupported, NotPositiveDefinite."""
    base = Base.of("newton-cg", system, preconditioner, real)

    def solving(base: Base) -> Descending:
        return _Iterating(base, forcing, most)

    words = f"kernels in {np.dtype(real)}, the gradient in float64"
    return PreparedDescent(system, base, device.told(), words, solving, traffic.newton(base.sizes, base.by))


class _Iterating(Descending):
    """product: g'z [J] at the point where it is; s, y, w (f, 3): a direction, its product and what the preconditioner
    makes of a residual, of conjugate gradients."""

    def __init__(self, base: Base, forcing: tuple[float, float], most: int) -> None:
        super().__init__(base)
        self._loose, self._tight = forcing
        self._most, self._conjugate = most, kernels(base.real)
        self._s, self._y, self._w = (self.stream.zeros(self.d.shape, base.real) for _ in range(3))
        self._now = self.stream.zeros(6, np.float64)
        self._eta = self._product = 0.0

    def take(self, step: Step) -> None:
        """See ResidentIterating."""
        super().take(step)
        self._eta, self._product = self._loose, self._arrived()

    def _arrived(self) -> float:
        self.look()
        self.linearise()
        return float(self.collected(1, len(self.d))[0])

    def one(self) -> bool:
        """See Descending."""
        if not self._product > self.floor or not (self.search(self._direction()) or self.search(self.z)):
            return False
        before, self._product = self._product, self._arrived()
        following, held = 0.9 * self._product / before, 0.9 * self._eta**2
        self._eta = min(self._loose, max(self._tight, following, held if held > 0.1 else 0.0))
        return True

    def _direction(self) -> Any:
        """What conjugate gradients make of -H^-1 g."""
        limit = self._eta**2 * self._product
        if self._product <= limit:
            return self.d
        now = np.zeros(6)
        now[PRODUCT], now[BEFORE], now[LIMIT] = self._product, np.inf, limit
        self.stream.put(now, self._now)
        z, done = self.z, 0
        while done < self._most and now[ENDED] == GOING:
            some = min(TOGETHER, self._most - done)
            for _ in range(some):
                self._turn(z)
                z = self._w
            done += some
            now = self.stream.download(self._now)
        return self._s if now[ENDED] == CURVED and now[COUNT] == 0.0 else self.d

    def _turn(self, z: Any) -> None:
        launch, one, count = self.launch_over, (1, sums.THREADS, self.stream.queue), self.launch_over[0]
        self._conjugate.turn[launch](z, self._s, self._now)
        self.kernels.multiply[launch](
            self.edges, self.of.hold, self.linear, self._s, self._y, 0, self.partials, self._now
        )
        curve[one](self.partials, 0, count, self._now)
        self._conjugate.go[launch](self._s, self._y, self.d, self.preconditioner.r, self._now)
        self.preconditioner.apply(self._w, 1, self.partials, self._now)
        judge[one](self.partials, 1, count, self._now)
