"""Newton-CG on a device: the iterates of `solvers.methods.newton_cg` with additive Schwarz.

Positions and gradients are float64, directions `real`: p + t d retains the digits of positions, and the next gradient
corrects the error of a direction. The host reads few numbers: those of each trial once, and after each TOGETHER
iterations of conjugate gradients, which run on the device, whether they have ended. H d = -g to r'z <= limit
(`solvers.linear.krylov`):

    turn     p = z + r'z / (r'z before) p         multiply   y = H p, and p'y         curve    whether p'y > 0
    go       d += t p,   r -= t y                 apply      z = M^-1 r, and r'z      judge    whether r'z <= limit

The scalars are in `now` on the device, written by kernels of one block. After the end all kernels return at once.
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
"""Iterations of conjugate gradients per check of their end."""

_SUMS = 2
"""Number of simultaneous sums."""

ENDED, COUNT, PRODUCT, BEFORE, CURVATURE, LIMIT = range(6)
"""Indices of `now`: reason of the end; iterations; r'z, its previous value, p'Hp and the tolerance of r'z [J]."""

GOING, NEAR, CURVED = 0.0, 1.0, 2.0
"""Reasons of the end of conjugate gradients."""

Real = type[np.float32] | type[np.float64]


def prepare(
    system: System, preconditioner: Preconditioning, real: Real, forcing: tuple[float, float], most: int
) -> PreparedNewtonCG:
    """Prepare the method on an available device.

    Args:
        system: the system.
        preconditioner: of conjugate gradients; only schwarz is supported.
        real: floating-point type of the directions.
        forcing: upper and lower bound of eta.
        most: maximum number of conjugate gradient iterations.

    Raises:
        NotPositiveDefinite: if the system leaves some positions undetermined.
        Unsupported: for energies that kernels do not support, and if the device memory is too small.
    """
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
    """Newton-CG, prepared on a device, with the levels of the preconditioner on host and device.

    `forcing` and `most` are the arguments of the preparation, `columns` the device columns of rows.
    """

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
        """Exact counts of the prepared data."""
        return self.metric.facts

    def iterating(self) -> DeviceIterating:
        """Allocate the memory of a solve."""
        return _Iterating(self)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] scale, below a small part of which round-off is checked."""
        return largest(problem) * self.metric.trace**0.5


class _Iterating(DeviceIterating):
    """State of a Newton-CG solve, in rows on the device.

    Attributes:
        p, q: (n, 3), current point and trial.
        g: gradient at p (f, 3).
        z: preconditioned negative gradient.
        d, s, y, w: (f, 3), solution, direction, its product and preconditioned residual of conjugate gradients.
        floor: g H^-1 g [J] of round-off.
        product: g'z [J] at p.
    """

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
        """Load a step; waits for the largest coordinate, which determines round-off."""
        self._begun.take(step, self._p, self._q)
        self.stream.put(np.zeros(1), self._largest)
        farthest[self._over_all](self._p, self._largest)
        self._floor = self._made.metric.round_off(self.stream.download(self._largest)[:, None])
        self._eta, self._product = self._loose, self._arrived()

    def settled(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""
        return self._p

    def sweep(self, count: int) -> int:
        """Run iterations; each waits for the numbers of its trial."""
        for number in range(count):
            if self.stalled or not self._advanced():
                return number
        return count

    def _advanced(self) -> bool:
        """Do one iteration; return False if no direction descends."""
        if not self._product > self._floor or not (self._search(self._direction()) or self._search(self._z)):
            return False
        before, self._product = self._product, self._arrived()
        following, held = 0.9 * self._product / before, 0.9 * self._eta**2
        self._eta = min(self._loose, max(self._tight, following, held if held > 0.1 else 0.0))
        return True

    def _arrived(self) -> float:
        """Compute the gradient, the Hessian and z at p; return g'z [J]."""
        objective_kernels.gradient[self._over](self._edges, self._given, self._p, self._g)
        self._kernels.linearise[self._over](self._edges, len(self._g), self._p, self._linear)
        self._preconditioner.linearised(self._edges, self._p)
        negated[self._over](self._g, self._preconditioner.r)
        self._preconditioner.apply(self._z, 0, self._partials, self._idle)
        return float(self._collected(1, len(self._d))[0])

    def _collected(self, count: int, terms: int) -> NDArray[np.float64]:
        """Wait for the first `count` sums of `terms` terms, and return them."""
        sums.collect[1, sums.THREADS, self.stream.queue](count, self._partials, sums.blocks(terms), self._sums)
        return self.stream.download(self._sums)[:count]

    def _search(self, direction: Any) -> bool:
        """Line search by step halving along a direction (f, 3); return success."""
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
        """Solve for -H^-1 g approximately by conjugate gradients."""
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
    """Update out[0] to the largest coordinate of p (n, 3).

    The maximum is independent of the order of threads.
    """
    most, i = 0.0, cuda.grid(1)
    while i < p.shape[0]:
        for c in range(3):
            most = max(most, abs(p[i, c]))
        i += cuda.gridsize(1)
    cuda.atomic.max(out, 0, most)


@cuda.jit
def negated(x, out):
    """Write -x (f, 3) to `out`, rounded to its type."""
    i = cuda.grid(1)
    while i < out.shape[0]:
        out[i, 0], out[i, 1], out[i, 2] = -x[i, 0], -x[i, 1], -x[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def trial(p, d, t, q, g, which, partials):
    """Write p + t d to the first rows of q, and store the first stage of the sum g'd."""
    total, i = 0.0, cuda.grid(1)
    while i < d.shape[0]:
        for c in range(3):
            step = np.float64(d[i, c])
            q[i, c] = p[i, c] + t * step
            total += g[i, c] * step
        i += cuda.gridsize(1)
    sums.keep(total, which, partials)


class Kernels(NamedTuple):
    """Conjugate gradient kernels for one precision."""

    turn: Any
    go: Any


@cache
def kernels(real: type[np.float32] | type[np.float64]) -> Kernels:
    """Build the kernels that compute in `real`."""

    @cuda.jit
    def turn(z, p, now):
        """Update the direction: p = z + r'z / (r'z before) p."""
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
        """Update the iterate: d += t p, r -= t y."""
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
    """Second stage of p'Hp, and its sign; one block."""
    if now[ENDED] != GOING:
        return
    total = sums.of_all(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[CURVATURE] = total
        if not total > 0.0:
            now[ENDED] = CURVED


@cuda.jit
def judge(partials, which, count, now):
    """Second stage of r'z, and the convergence test; one block."""
    if now[ENDED] != GOING:
        return
    total = sums.of_all(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[BEFORE], now[PRODUCT] = now[PRODUCT], total
        now[COUNT] += 1.0
        if total <= now[LIMIT]:
            now[ENDED] = NEAR
