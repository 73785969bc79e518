"""|Q^-1 g|_Q of a gradient g on a device, without a factor of Q: conjugate gradients with Q's diagonal, from x_0 = 0.

    |Q^-1 g|_Q^2 = |x_k|_Q^2 + r_k'Q^-1 r_k,     |x_k|_Q^2 = sum over j < k of t_j r_j'z_j
    r'Q^-1 r <= r'z / mu,     mu = min_i h_i / Q_ii,     h: of inertia and pins,     z = diag(Q)^-1 r

the first by Hestenes and Stiefel (1952), the second for Q less h has no negative eigenvalue. It ends once the bound is
at most 2 ACCURACY of the sum, and tells both together, so that

    |Q^-1 g|_Q <= told <= (1 + ACCURACY) |Q^-1 g|_Q

and nobody stops too early. Ended after MOST iterations it still is no less than the truth. Pins by penalty are left out
of the norm, with P x for x: of the error e = x - x_k that is |P e|_Q <= F |e|_Q, F = 1 + sqrt(2 max Q_ii / h_i) over
them, for x'Q x <= 2 x'diag(Q) x; so it goes on until F times the bound's root is ACCURACY/2 of |P x_k|_Q, and adds
that. A vertex without mass makes mu zero and the bound nothing: then it ends at round-off, and tells what it has.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from solvers.cuda import sums
from solvers.cuda.conjugate import COUNT, CURVATURE, CURVED, ENDED, GOING, LIMIT, NEAR, PRODUCT, judge, kernels
from solvers.cuda.device import simulated
from solvers.cuda.network import Edges, Network
from solvers.cuda.run import Stream
from solvers.cuda.target import cuda

ACCURACY = 1e-3
"""Of the residual, what is told may be more."""

MOST, TOGETHER = 20_000, 4 if simulated() else 16
"""Iterations at most, and how many are launched before the host looks whether they have ended. What is launched after
the end does nothing, for which the simulator takes as long."""

_SUM = 6
"""Where in `now` |x|_Q^2 [J] is, beside the places of `solvers.cuda.conjugate`."""

_LEFT = 1e-24
"""Of r'z, what ends it where there is no bound."""

NUMBERS = 20
"""Float64 that it takes on the device for each free row."""


class Residuals:
    """What tells residuals of gradients in the rows of a network; its vectors are its own."""

    def __init__(self, stream: Stream, network: Network, edges: Edges, hold: Any) -> None:
        """edges, hold: of the network, on the device."""
        self._stream, self._edges, self._hold = stream, edges, hold
        rows, system = network.free, network.system
        order, diagonal, held = network.order[:rows], network.diagonal[:rows], system.inertia.copy()
        soft, pinned, weight = system.penalty
        held[pinned] += weight
        part, loose = held[order] / diagonal, system.unpinned[order]
        self._rows, self._mu = rows, float(part.min(initial=np.inf))
        self._masked = 1.0 + (2.0 / float(part[~loose].min())) ** 0.5 if soft.any() else 0.0
        self._diagonal, self._loose = stream.upload(diagonal), stream.upload(loose.astype(np.float64))
        self._z, self._r, self._p, self._y, self._x, self._kept = (
            stream.zeros((rows, 3), np.float64) for _ in range(6)
        )
        self._partials, self._now = sums.partials(2), stream.zeros(_SUM + 1, np.float64)
        self._idle, self._one = stream.zeros(1, np.float64), stream.zeros(1, np.float64)
        self._kernels = kernels(np.float64)

    def of(self, g: Any) -> float:
        """The residual [J^(1/2)] of a gradient (f, 3) [N] on the device, which stays; waits for it."""
        if not self._rows:
            return 0.0
        now = np.zeros(_SUM + 1)
        now[COUNT], now[PRODUCT] = -1.0, np.inf  # the first r'z is told as if an iteration had ended
        self._stream.put(now, self._now)
        launch, one, count = self._over()
        copied[launch](g, self._r)
        self._divide()
        judge[one](self._partials, 1, count, self._now)
        done, factor = 0, 2.0 * ACCURACY * self._mu
        while done < MOST:
            for _ in range(TOGETHER):
                self._turn(factor)
            done += TOGETHER
            now = self._stream.download(self._now)
            if now[ENDED] == CURVED or (now[ENDED] == NEAR and not self._masked):
                break
            if now[ENDED] == NEAR:
                enough = self._mu * (0.5 * ACCURACY / self._masked) ** 2 * self._unpinned(now)
                if now[PRODUCT] <= enough or not self._mu > 0.0:
                    break
                factor, now[LIMIT], now[ENDED] = 0.0, enough, GOING
                self._stream.put(now, self._now)
        return self._told(now)

    def _turn(self, factor: float) -> None:
        launch, one, count = self._over()
        self._kernels.turn[launch](self._z, self._p, self._now)
        multiply[launch](self._edges, self._hold, self._p, self._y, 0, self._partials, self._now)
        grow[one](self._partials, 0, count, factor, self._now)
        self._kernels.go[launch](self._p, self._y, self._x, self._r, self._now)
        self._divide()
        judge[one](self._partials, 1, count, self._now)

    def _divide(self) -> None:
        divide[self._over()[0]](self._diagonal, self._r, self._z, 1, self._partials, self._now)

    def _over(self) -> tuple[tuple[int, int, Any], tuple[int, int, Any], int]:
        """Launches over all rows and of one block, and how many blocks the first has."""
        count, queue = sums.blocks(self._rows), self._stream.queue
        return (count, sums.THREADS, queue), (1, sums.THREADS, queue), count

    def _told(self, now: Any) -> float:
        if not np.isfinite(now[PRODUCT]):
            return float("nan")
        beyond = float(now[PRODUCT]) / self._mu if self._mu > 0.0 else 0.0
        if self._masked:
            return self._unpinned(now) ** 0.5 + self._masked * beyond**0.5
        return (float(now[_SUM]) + beyond) ** 0.5

    def _unpinned(self, now: Any) -> float:
        """|P x_k|_Q^2 [J]; waits for it."""
        if not now[_SUM] > 0.0:  # it ended before the first step, and x is an older gradient's
            return 0.0
        launch, one, count = self._over()
        kept[launch](self._x, self._loose, self._kept)
        multiply[launch](self._edges, self._hold, self._kept, self._y, 0, self._partials, self._idle)
        sums.collect[one](1, self._partials, count, self._one)
        return float(self._stream.download(self._one)[0])


@cuda.jit
def copied(x, out):
    """Write x (f, 3) to `out`."""
    i = cuda.grid(1)
    while i < out.shape[0]:
        out[i, 0], out[i, 1], out[i, 2] = x[i, 0], x[i, 1], x[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def kept(x, share, out):
    """Write of x (f, 3) the share (f,) of each row to `out`."""
    i = cuda.grid(1)
    while i < out.shape[0]:
        out[i, 0], out[i, 1], out[i, 2] = share[i] * x[i, 0], share[i] * x[i, 1], share[i] * x[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def divide(diagonal, r, z, which, partials, now):
    """Write r over Q's diagonal to z, (f, 3), and keep the first stage of r'z."""
    if now[ENDED] != GOING:
        return
    total, i = 0.0, cuda.grid(1)
    while i < z.shape[0]:
        for c in range(3):
            z[i, c] = r[i, c] / diagonal[i]
            total += r[i, c] * z[i, c]
        i += cuda.gridsize(1)
    sums.keep(total, which, partials)


@cuda.jit
def multiply(edges, hold, x, out, which, partials, now):
    """Write Q x (f, 3) to `out`, and keep the first stage of x'Q x."""
    if now[ENDED] != GOING:
        return
    total, rows, i = 0.0, x.shape[0], cuda.grid(1)
    while i < rows:
        x0, x1, x2, h = x[i, 0], x[i, 1], x[i, 2], hold[i]
        y0, y1, y2 = h * x0, h * x1, h * x2
        e, end = edges.first[i >> 5] + (i & 31), edges.first[(i >> 5) + 1]
        while e < end:
            j = edges.other[e]
            if j == i:
                break
            k, s0, s1, s2 = edges.stiffness[e], x0, x1, x2
            if j < rows:
                s0, s1, s2 = x0 - x[j, 0], x1 - x[j, 1], x2 - x[j, 2]
            y0 += k * s0
            y1 += k * s1
            y2 += k * s2
            e += 32
        out[i, 0], out[i, 1], out[i, 2] = y0, y1, y2
        total += x0 * y0 + x1 * y1 + x2 * y2
        i += cuda.gridsize(1)
    sums.keep(total, which, partials)


@cuda.jit
def grow(partials, which, count, factor, now):
    """The second stage of p'Qp, what the next step adds to |x|_Q^2, and what r'z should be at most: `factor` of that,
    and where it is 0 what was there, at the beginning a part of what there is; one block."""
    if now[ENDED] != GOING:
        return
    total = sums.of_all(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[CURVATURE] = total
        if total > 0.0:
            now[_SUM] += now[PRODUCT] * now[PRODUCT] / total
            if factor > 0.0:
                now[LIMIT] = factor * now[_SUM]
            elif now[COUNT] == 0.0:
                now[LIMIT] = _LEFT * now[PRODUCT]
        else:
            now[ENDED] = CURVED
