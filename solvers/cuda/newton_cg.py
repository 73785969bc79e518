"""Newton's method by conjugate gradients on a device: the iterates of `solvers.methods.newton_cg`, by additive Schwarz.

Positions and gradients are float64, directions `real`: p + t d keeps the positions' digits, and the next gradient tells
what a direction missed. The host reads a few numbers: those of a trial, once each, and of conjugate gradients, which
run on the device, after each TOGETHER iterations whether they have ended. H d = -g to r'z <= limit
(`solvers.linear.krylov`):

    turn     p = z + r'z / (r'z before) p         multiply   y = H p, and p'y         curve    whether p'y > 0
    go       d += t p,   r -= t y                 apply      z = M^-1 r, and r'z      judge    whether r'z <= limit

The numbers are in `now` on the device; kernels of one block write them. Once it has ended all kernels do nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.core.descent import HALVINGS, Metric
from solvers.core.driver import largest
from solvers.core.fixed_objective import Objective
from solvers.core.preconditioning import LEAST, Preconditioning
from solvers.cuda import device, objective_kernels, sums
from solvers.cuda.network import Network, require_known
from solvers.cuda.run import DeviceIterating, Minimising
from solvers.cuda.schwarz import Level, Schwarz, UploadedLevel, levels, needed
from solvers.cuda.steps import Begun, Step, Uploaded
from solvers.cuda.target import Stream, cuda
from solvers.kernels.line_search import falls
from solvers.linear.schwarz import ordered
from solvers.problem import StepProblem, System, Unsupported

TOGETHER = 16
"""Iterations of conjugate gradients that are launched at a time."""

_SUMS = 2
"""At a time."""

ENDED, COUNT, PRODUCT, BEFORE, CURVATURE, LIMIT = range(6)
"""Where in `now`: what ended it; iterations done; r'z, the one before, p'Hp and what r'z should be at most [J]."""

GOING, NEAR, CURVED = 0.0, 1.0, 2.0
"""What ended it."""

Real = type[np.float32] | type[np.float64]


def prepare(
    system: System, preconditioner: Preconditioning, real: Real, forcing: tuple[float, float], most: int
) -> PreparedNewtonCG:
    """The method on the device, which is `ready`. forcing: the bounds of eta, from above and from below; most:
    iterations of conjugate gradients. Raises NotPositiveDefinite, and Unsupported for what kernels do not know and for
    what the device has no room for."""
    if preconditioner != "schwarz":
        raise Unsupported(
            f"newton-cg, device: cuda: knows preconditioner: schwarz, not {preconditioner}; take that, or device: cpu"
        )
    require_known("newton-cg", system)
    metric = Metric(system)
    order = ordered(metric.inner)
    network = Network.of("newton-cg", system, order)
    size = np.dtype(real).itemsize
    held = network.hold[: network.free] + LEAST * metric.diagonal[order]
    of = levels(network, held)
    vectors = network.free * (3.0 * (12 * 8 + 8 * size) + 8.0 * 8)
    solve = vectors + needed(of, size) + 4.0 * size * len(network.entries.other)
    device.require_memory("newton-cg", network.bytes + solve)
    with device.guarded():
        stream = Stream()
        there = [UploadedLevel.of(stream, level) for level in of]
        return PreparedNewtonCG(
            Uploaded.of(network, stream),
            metric,
            Objective(system),
            of,
            there,
            real,
            forcing,
            most,
            device.told(),
            f"kernels in {np.dtype(real)}, the gradient in float64; for the residual alone {metric.choice}",
        )


@dataclass(frozen=True, eq=False)
class PreparedNewtonCG(Minimising):
    """The method, ready for a system. levels, on_device: of the preconditioner; forcing, most: see `prepare`; columns:
    of the device."""

    uploaded: Uploaded
    metric: Metric
    objective: Objective
    levels: list[Level]
    on_device: list[UploadedLevel]
    real: Real
    forcing: tuple[float, float]
    most: int
    columns: dict[str, Any]
    choice: str

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built."""
        return self.metric.facts

    def iterating(self) -> DeviceIterating:
        """See DeviceIterative."""
        return _Iterating(self)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return largest(problem) * self.metric.trace**0.5


class _Iterating(DeviceIterating):
    """From point to point. p, q (n, 3): where it is and a trial, in rows; g: the gradient at p (f, 3); z: what the
    preconditioner makes of -g; d, s, y, w (f, 3): the sum, a direction, its product and what the preconditioner makes
    of a residual, of conjugate gradients; floor: g H^-1 g [J] of round-off; product: g'z [J] at p."""

    def __init__(self, made: PreparedNewtonCG) -> None:
        of, network = made.uploaded, made.uploaded.network
        super().__init__(of.stream, network.order)
        self._made, stream, real, rows = made, self.stream, made.real, network.free
        self._begun = Begun(of)
        self._edges, self._given = self._begun.edges, self._begun.given
        self._p, self._q = (stream.zeros((len(network.order), 3), np.float64) for _ in range(2))
        self._kernels, self._conjugate = objective_kernels.kernels(real), kernels(real)
        self._preconditioner = Schwarz(made.levels, made.on_device, stream, rows, real)
        self._linear = stream.zeros((4, len(network.entries.other)), real)
        self._g = stream.zeros((rows, 3), np.float64)
        self._z, self._d, self._s, self._y, self._w = (stream.zeros((rows, 3), real) for _ in range(5))
        self._partials, self._sums = sums.partials(_SUMS), stream.zeros(_SUMS, np.float64)
        self._now, self._idle, self._largest = (stream.zeros(k, np.float64) for k in (6, 1, 1))
        self._over = sums.blocks(rows), sums.THREADS, stream.queue
        self._over_all = sums.blocks(max(rows, len(network.ends))), sums.THREADS, stream.queue
        self._loose, self._tight = made.forcing
        self._floor = self._eta = self._product = 0.0

    def take(self, step: Step) -> None:
        """See DeviceIterating; waits for the largest coordinate, by which round-off is told."""
        self._begun.take(step, self._p, self._q)
        self.stream.put(np.zeros(1), self._largest)
        farthest[self._over_all](self._p, self._largest)
        self._floor = self._made.metric.round_off(self.stream.download(self._largest)[:, None])
        self._eta, self._product = self._loose, self._arrived()

    def settled(self) -> Any:
        """See DeviceIterating."""
        return self._p

    def sweep(self, count: int) -> int:
        """See DeviceIterating; each iteration waits for the numbers of its trial."""
        for number in range(count):
            if self.stalled or not self._advanced():
                return number
        return count

    def _advanced(self) -> bool:
        """An iteration; False where nothing descends."""
        if not self._product > self._floor or not (self._search(self._direction()) or self._search(self._z)):
            return False
        before, self._product = self._product, self._arrived()
        following, held = 0.9 * self._product / before, 0.9 * self._eta**2
        self._eta = min(self._loose, max(self._tight, following, held if held > 0.1 else 0.0))
        return True

    def _arrived(self) -> float:
        """Compute the gradient at p, the Hessian there, and z; g'z [J]."""
        objective_kernels.gradient[self._over](self._edges, self._given, self._p, self._g)
        self._kernels.linearise[self._over](self._edges, len(self._g), self._p, self._linear)
        self._preconditioner.linearised(self._edges, self._p)
        negated[self._over](self._g, self._preconditioner.r)
        self._preconditioner.apply(self._z, 0, self._partials, self._idle)
        return float(self._collected(1, len(self._d))[0])

    def _collected(self, count: int, terms: int) -> NDArray[np.float64]:
        """The first sums, of so many terms; waits for them."""
        sums.collect[1, sums.THREADS, self.stream.queue](count, self._partials, sums.blocks(terms), self._sums)
        return self.stream.download(self._sums)[:count]

    def _search(self, direction: Any) -> bool:
        """Go to the first point at 1, 1/2, ... of a direction (f, 3) that descends enough; whether any does."""
        t, network = 1.0, self._made.uploaded.network
        for _ in range(HALVINGS):
            trial[self._over_all](self._p, direction, t, self._q, self._g, 0, self._partials)
            objective_kernels.rise[self._over_all](self._edges, self._given, self._p, self._q, 1, self._partials)
            slope, rise = map(float, self._collected(2, max(network.free, len(network.ends))))
            if not slope < 0.0:
                return False
            if falls(rise, t, slope, 0.0):
                self._p, self._q = self._q, self._p
                return True
            t *= 0.5
        return False

    def _direction(self) -> Any:
        """What conjugate gradients make of -H^-1 g."""
        limit, most = self._eta**2 * self._product, self._made.most
        if self._product <= limit:
            return self._d
        now = np.zeros(6)
        now[PRODUCT], now[BEFORE], now[LIMIT] = self._product, np.inf, limit
        self.stream.put(now, self._now)
        z, done = self._z, 0
        while done < most and now[ENDED] == GOING:
            some = min(TOGETHER, most - done)
            for _ in range(some):
                self._turn(z)
                z = self._w
            done += some
            now = self.stream.download(self._now)
        return self._s if now[ENDED] == CURVED and now[COUNT] == 0.0 else self._d

    def _turn(self, z: Any) -> None:
        launch, one, count = self._over, (1, sums.THREADS, self.stream.queue), self._over[0]
        self._conjugate.turn[launch](z, self._s, self._now)
        self._kernels.multiply[launch](
            self._edges, self._given.hold, self._linear, self._s, self._y, 0, self._partials, self._now
        )
        curve[one](self._partials, 0, count, self._now)
        self._conjugate.go[launch](self._s, self._y, self._d, self._preconditioner.r, self._now)
        self._preconditioner.apply(self._w, 1, self._partials, self._now)
        judge[one](self._partials, 1, count, self._now)


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


class Kernels(NamedTuple):
    """Of a precision: see each."""

    turn: Any
    go: Any


@cache
def kernels(real: type[np.float32] | type[np.float64]) -> Kernels:
    """Those that compute in `real`."""

    @cuda.jit
    def turn(z, p, now):
        """p = z + r'z / (r'z before) p."""
        if now[ENDED] != GOING:
            return
        first, scale = now[COUNT] == 0.0, real(now[PRODUCT] / now[BEFORE])
        i = cuda.grid(1)
        while i < p.shape[0]:
            for c in range(3):
                p[i, c] = z[i, c] if first else z[i, c] + scale * p[i, c]
            i += cuda.gridsize(1)

    @cuda.jit
    def go(p, y, d, r, now):
        """d += t p, r -= t y."""
        if now[ENDED] != GOING:
            return
        first, length = now[COUNT] == 0.0, real(now[PRODUCT] / now[CURVATURE])
        i = cuda.grid(1)
        while i < d.shape[0]:
            for c in range(3):
                step = length * p[i, c]
                d[i, c] = step if first else d[i, c] + step
                r[i, c] -= length * y[i, c]
            i += cuda.gridsize(1)

    return Kernels(turn, go)


@cuda.jit
def curve(partials, which, count, now):
    """The second stage of p'Hp, and whether it is positive; one block."""
    if now[ENDED] != GOING:
        return
    total = sums.of_all(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[CURVATURE] = total
        if not total > 0.0:
            now[ENDED] = CURVED


@cuda.jit
def judge(partials, which, count, now):
    """The second stage of r'z, and whether it is small; one block."""
    if now[ENDED] != GOING:
        return
    total = sums.of_all(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[BEFORE], now[PRODUCT] = now[PRODUCT], total
        now[COUNT] += 1.0
        if total <= now[LIMIT]:
            now[ENDED] = NEAR
