"""L-BFGS on a device: the iterates of `solvers.methods.lbfgs`, by a sparse matrix S for Q^-1, or by cuDSS's factor.

    c = -S grad g(p),    d = scale c - sum over j of (a_j s_j + b_j w_j),    w_j = c_j - c_(j+1)

Vectors stay on the device. The host has their scalar products, of which it makes coefficients and judges trials by the
kernels of the processor's method, `solvers.kernels.accelerate`, on a `Window` of one entry: the line p + t d. It waits
twice an iteration: for the numbers of a trial, and for the products of a step that is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.core.acceleration import Scheme, window_for
from solvers.core.descent import Stiffness
from solvers.core.driver import largest
from solvers.cuda import device, objective_kernels, residual, sums, traffic
from solvers.cuda.cudss import Cudss
from solvers.cuda.descent import trial
from solvers.cuda.lbfgs_kernels import Rows, kernels
from solvers.cuda.network import Network, require_known
from solvers.cuda.pncg import dotted
from solvers.cuda.resident import AT_ONCE, Minimising, MinimisingIterating, ResidentIterating
from solvers.cuda.run import EVERY, Stream
from solvers.cuda.steps import Begun, Step, Uploaded
from solvers.kernels import accelerate
from solvers.kernels.loop import EACH, ITERATIONS, LAST, STALLED, Limits, verdict
from solvers.linear.schwarz import ordered
from solvers.problem import StepProblem, System

Real = type[np.float32] | type[np.float64]
_TRIED = 3
"""Sums of a trial: g'd, the rise, and g'd there."""


def prepare(
    system: System, stiffness: Stiffness, S: csr_array | None, scheme: Scheme, real: Real, words: str
) -> PreparedLbfgs:
    """The method on the device, which is `ready`. S (f, f): in the place of Q^-1 of the free vertices, symmetric and
    positive definite; None: Q^-1, by cuDSS. Raises Unsupported for what kernels do not know, and for what the device
    has no room for, a factor apart."""
    require_known(scheme.name, system)
    order = ordered(stiffness.inner)
    network, size = Network.of(scheme.name, system, order), np.dtype(real).itemsize
    rows = None if S is None else Rows.of(csr_array(csr_array(S[order])[:, order]))
    vectors = network.free * (3.0 * (12 * 8 + (2 * scheme.pairs + 3) * size) + 8.0 * (8 + residual.NUMBERS))
    entries = len(rows.other) if rows else 0
    device.require_memory(scheme.name, network.bytes + AT_ONCE * vectors + (4.0 + size) * entries)
    with device.guarded():
        stream = Stream()
        if rows is None:
            inverse = Cudss(csr_array(csr_array(stiffness.inner[order])[:, order]), stream)
            words = f"{inverse.choice}; "
        else:
            inverse = Product(stream, rows, real)
        words += f"kernels in {np.dtype(real)}, the gradient in float64"
        return PreparedLbfgs(
            system, stiffness, Uploaded.of(network, stream), inverse, scheme, real, device.told(), words
        )


class Product:
    """A sparse matrix S on the device, in the place of Q^-1."""

    def __init__(self, stream: Stream, rows: Rows, real: Real) -> None:
        there = stream.upload(rows.first), stream.upload(rows.other), stream.upload(rows.value, real)
        self._stream, self._S, self._multiply = stream, Rows(*there), kernels(real).multiply

    @property
    def moves(self) -> float:
        """The bytes that a product must move, beside vectors: 4 and those of a number, of each entry."""
        return (4.0 + self._S.value.dtype.itemsize) * len(self._S.other)

    def apply(self, g: Any, out: Any) -> None:
        """Write -S g (f, 3) to `out`."""
        self._multiply[sums.blocks(len(out)), sums.THREADS, self._stream.queue](self._S, g, out)


@dataclass(frozen=True, eq=False)
class PreparedLbfgs(Minimising):
    """stiffness: Q, on the host, without a factor; the rest is on the device: inverse, of Q or near to it."""

    system: System
    stiffness: Stiffness
    uploaded: Uploaded
    inverse: Product | Cudss
    scheme: Scheme
    real: Real
    columns: dict[str, Any]
    choice: str

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built, and the bytes that an iteration must move (`traffic`)."""
        sizes = self.uploaded.network.sizes(np.dtype(self.real).itemsize)
        moves = traffic.limited(sizes, self.inverse.moves, self.scheme.pairs)
        return {**self.stiffness.facts, "sweep_bytes": moves}

    def iterating(self) -> ResidentIterating:
        """See Resident."""
        return _Iterating(self)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return largest(problem) * self.stiffness.trace**0.5


class _Iterating(MinimisingIterating):
    """p, q (n, 3): where it is and a trial, in rows; g, there: the gradients at them, c, after: -S of these, d: the
    direction, all (f, 3); steps, images (m, f, 3): s and w; window: of the line."""

    def __init__(self, made: PreparedLbfgs) -> None:
        super().__init__(made.uploaded)
        self._made, stream, network, m = made, self.stream, made.uploaded.network, made.scheme.pairs
        self._begun, rows = Begun(made.uploaded), network.free
        self._edges, self._given = self._begun.edges, self._begun.given
        self._p, self._q = (stream.zeros((len(network.order), 3), np.float64) for _ in range(2))
        self._g, self._there = (stream.zeros((rows, 3), np.float64) for _ in range(2))
        self._c, self._after, self._d = (stream.zeros((rows, 3), made.real) for _ in range(3))
        self._steps, self._images = (stream.zeros((m, rows, 3), made.real) for _ in range(2))
        self._a, self._b = stream.zeros(m, np.float64), stream.zeros(m, np.float64)
        self._kernels, most = kernels(made.real), max(_TRIED, 3 + 2 * m)
        self._partials, self._sums = sums.partials(most), stream.zeros(most, np.float64)
        self._over = sums.blocks(max(rows, len(network.ends))), sums.THREADS, stream.queue
        self._window, self._moves, self._stalled = window_for(made.scheme, 1, 1), 0, False

    def take(self, step: Step) -> None:
        """See ResidentIterating."""
        self._begun.take(step, self._p, self._q)
        self._window, self._moves, self._stalled = window_for(self._made.scheme, 1, 1), 0, False
        self._window.correction[:] = self._window.direction[:] = 1.0
        now = self._window.now[0]
        now["newest"] = -1
        self._look(self._p, self._g, self._c)
        dotted[self._over](self._g, self._c, 0, self._partials)
        now["squared"] = -self._collected(1)[0]

    def sweep(self, count: int) -> None:
        """See DeviceIterating; each iteration waits for its numbers."""
        for _ in range(count):
            if self._stalled or not self._one():
                self._stalled = True
                return
            self._moves += 1

    def advance(self) -> bool:
        """See Iterating."""
        self.launch(1)
        return not self._stalled

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating; a residual after each EVERY iterations where it may end them."""
        first, found, ended = self._moves, float("nan"), ITERATIONS
        while self._moves - first < limits.iterations and ended == ITERATIONS:
            left = limits.iterations - (self._moves - first)
            self.launch(min(EVERY - self._moves % EVERY, left) if limits.wanted == EACH else left)
            if limits.wanted == EACH:
                found = self.residual()
                ended = verdict(found, limits)
            if ended == ITERATIONS and self._stalled:
                ended = STALLED
        if limits.wanted == LAST or (limits.wanted == EACH and self._moves == first):
            found = self.residual()
        return self._moves - first, found, ended

    def settled(self) -> Any:
        """See ResidentIterating."""
        return self._p

    def residual(self) -> float:
        """See Iterating; on the device, of its gradient."""
        with device.guarded():
            return self.of.residuals.of(self._g)

    def _look(self, p: Any, g: Any, c: Any) -> None:
        """The gradient at p, and -S of it."""
        objective_kernels.gradient[self._over](self._edges, self._given, p, g)
        self._invert(g, c)

    def _invert(self, g: Any, c: Any) -> None:
        """-S g, or -Q^-1 g."""
        if len(c):
            self._made.inverse.apply(g, c)

    def _collected(self, count: int) -> NDArray[np.float64]:
        """The first sums; waits for them."""
        sums.collect[1, sums.THREADS, self.stream.queue](count, self._partials, self._over[0], self._sums)
        return self.stream.download(self._sums)[:count]

    def _one(self) -> bool:
        """An iteration; False where nothing descends."""
        window, now = self._window, self._window.now[0]
        accelerate.propose(window)
        self.stream.put(window.a, self._a)
        self.stream.put(window.b, self._b)
        self._kernels.combine[self._over](
            float(now["scale"]), self._c, self._a, self._b, self._steps, self._images, self._d
        )
        window.direction[0], first, along = 1.0, True, self._d
        judged = accelerate.AGAIN
        while judged == accelerate.AGAIN:
            trial[self._over](self._p, along, float(now["length"]), self._q, self._g, 0, self._partials)
            objective_kernels.rise[self._over](self._edges, self._given, self._p, self._q, 1, self._partials)
            objective_kernels.gradient[self._over](self._edges, self._given, self._q, self._there)
            dotted[self._over](self._there, along, 2, self._partials)
            slope, now["rise"], there = self._collected(_TRIED)
            if first:
                now["slope"], first = slope, False
            window.descent_there[0] = -there
            judged = accelerate.judge(window)
            along = self._c if now["plain"] else self._d
        if judged == accelerate.STALLED:
            return False
        self._accept(window, now)
        return True

    def _accept(self, window: accelerate.Window, now: Any) -> None:
        """Go to the trial, and keep the pair of this step and all its products, as `accelerate.accept` does."""
        m = len(window.a)
        new = (int(now["newest"]) + 1) % m
        now["count"] = min(int(now["count"]) + 1, m)
        self._invert(self._there, self._after)
        self._kernels.keep[self._over](
            new, self._p, self._q, self._g, self._there, self._c, self._after, self._steps, self._images, self._partials
        )
        self._kernels.against[self._over](self._steps, self._images, self._there, self._partials)
        self._p, self._q, self._g, self._there = self._q, self._p, self._there, self._g
        self._c, self._after = self._after, self._c
        found = self._collected(3 + 2 * m)
        window.sy[:, new], window.wy[:, new] = -window.sg, -window.wg
        now["squared"], window.sy[new, new], window.wy[new, new] = found[:3]
        kept = [(new - back) % m for back in range(int(now["count"]))]
        window.sg[:] = window.wg[:] = 0.0
        window.sg[kept], window.wg[kept] = found[3 : 3 + m][kept], found[3 + m :][kept]
        others = np.arange(m) != new
        window.sy[others, new] += window.sg[others]
        window.wy[others, new] += window.wg[others]
        window.wy[new] = window.wy[:, new]
        now["newest"] = new
