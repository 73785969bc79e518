"""Contact by pairs on a device: the energy, gradient and model of `solvers.contact.self_contact`, and its largest step.

Positions are rows: the mesh's vertices, then those of the obstacles of each energy. What a host reads are numbers: how
many candidates there are, how far vertices have moved since they were looked for, and sums.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.contact.known import ROUND, WIDE
from solvers.contact.self_contact import ObstacleContact, PairContact, SelfContact
from solvers.contact.ways import LEFT
from solvers.cuda import pair_kernels as kernels
from solvers.cuda import sums
from solvers.cuda.candidates import Found, Search
from solvers.cuda.pair_kernels import Acts, Grips
from solvers.cuda.run import Stream
from solvers.cuda.steps import Step
from solvers.problem import System, Unsupported

Known = SelfContact, ObstacleContact


class At(NamedTuple):
    """At a point: the energy [J], infinite where a gap is closed, how many pairs are in range or grip, and the gradient
    on the device, in rows (n, 3) [N]."""

    value: float
    near: int
    gradient: Any


class Sums:
    """Sums of a solve, some at a time. partials: of first stages; over: a launch of these."""

    def __init__(self, stream: Stream, rows: int, threads: int) -> None:
        self._stream, self.partials, self._out = stream, sums.partials(rows), stream.zeros(rows, np.float64)
        self.over = sums.blocks(threads), sums.THREADS, stream.queue

    def second(self, many: int, out: Any) -> None:
        """The second stage of the first ones, to `out`."""
        sums.collect[1, sums.THREADS, self._stream.queue](many, self.partials, self.over[0], out)

    def read(self, many: int) -> NDArray[np.float64]:
        """The first ones; waits for them."""
        self.second(many, self._out)
        return self._stream.download(self._out)[:many]


class _Kept(NamedTuple):
    """Candidates that are nearer than `reach` at p, rows of all vertices."""

    p: Any
    reach: float
    found: Found


class Touching:
    """One energy of pairs."""

    def __init__(self, stream: Stream, totals: Sums, energy: PairContact, order: Any, first: int, rows: int) -> None:
        """order (n,): the vertex of each row; first: the row of its obstacles' first vertex; rows: of all."""
        self._stream, self._sums, self._energy, self._first = stream, totals, energy, first
        self._search = Search("vbd", stream, energy.surface, order, first)
        self._kept: list[_Kept] = []
        self._space, self._n = stream.zeros((2, rows, 3), np.float64), len(order)
        self._now, self._most = stream.zeros(5, np.float64), stream.zeros(1, np.float64)
        self._acts: tuple[int, Acts] = (-1, self._room(1))
        self._gripping: tuple[Found, Grips, Acts, float] | None = None
        self._grips = 0

    def _room(self, many: int) -> Acts:
        empty, many = self._stream.empty, max(1, many)
        return Acts(empty(many, np.int64), empty((many, 4, 3), np.float64), empty((many, 4, 6), np.float64))

    @property
    def obstacles(self) -> int:
        """How many vertices they have."""
        energy = self._energy
        return len(energy.end) if isinstance(energy, ObstacleContact) else 0

    @property
    def at_rest(self) -> bool:
        """Whether no obstacle moves."""
        energy = self._energy
        return not isinstance(energy, ObstacleContact) or energy.place(0.0) is energy.place(1.0)

    def begin(self, step: Step, start: Any, pressed: Any, *everywhere: Any) -> None:
        """A step: obstacles are where they are at its end in all these rows but `start`, where it starts. What is in
        range at the rows `pressed` grips, at its start where they are None."""
        (time, until), energy = step.times, self._energy
        if isinstance(energy, ObstacleContact):
            for rows in everywhere if pressed is None else (pressed, *everywhere):
                self._stream.put(energy.place(until), rows[self._first : self._first + self.obstacles])
            self._stream.put(energy.place(time), start[self._first : self._first + self.obstacles])
        self._gripping, self._grips = None, 0
        if not energy.friction:
            return
        p = start if pressed is None else pressed
        found, empty = self._candidates(p), self._stream.empty
        room = max(1, found.many)
        weights, force, own = empty((room, 4), np.float64), empty(room, np.float64), empty(room, np.int64)
        grips = Grips(
            found.pairs.vertices, weights, empty((room, 3), np.float64), empty((room, 3), np.float64), force, own
        )
        kernels.hold[self._sums.over](found.pairs, found.many, p, start, energy.friction, grips, 0, self._sums.partials)
        self._grips = int(self._sums.read(1)[0])
        if self._grips:
            self._gripping = found, grips, self._room(found.many), energy.slip * (until - time)

    def at(self, p: Any, gradient: Any) -> At:
        """At rows p; its gradient is written."""
        over = self._sums.over
        found, acts = self._pressed(p)
        kernels.gather[over](found.first, found.slots, acts, True, gradient)
        if self._gripping:
            held, _, acts, _ = self._gripping
            self._slipped(p)
            kernels.gather[over](held.first, held.slots, acts, False, gradient)
        value, near, more = self._sums.read(3) if self._gripping else (*self._sums.read(2), 0.0)
        return At(float(value + more), int(near) + self._grips, gradient)

    def _pressed(self, p: Any) -> tuple[Found, Acts]:
        found = self._candidates(p)
        if self._acts[0] < found.many:
            self._acts = found.many, self._room(found.many)
        acts = self._acts[1]
        kernels.press[self._sums.over](found.pairs, found.many, p, acts, 0, self._sums.partials)
        return found, acts

    def _slipped(self, p: Any) -> None:
        assert self._gripping
        held, grips, acts, s = self._gripping
        kernels.slip[self._sums.over](held.many, grips, s, p, acts, 2, self._sums.partials)

    def add_model(self, p: Any, near: Any, block: Any) -> None:
        """Add four times the diagonal blocks at rows p to `block` (n, 6), and tell which rows have any to `near`."""
        over, (found, acts) = self._sums.over, self._pressed(p)
        kernels.curve[over](found.pairs, found.many, p, acts)
        kernels.gather_blocks[over](found.first, found.slots, acts, near, block)
        if self._gripping:
            held, _, acts, _ = self._gripping
            self._slipped(p)
            kernels.gather_blocks[over](held.first, held.slots, acts, near, block)

    def reach(self, p: Any, q: Any, way: Any) -> float:
        """The largest part up to 1 of the way from p to q that is free; 0 where a gap is closed at p."""
        apart, size = self._apart(p, q)
        if not np.isfinite(apart):
            return 0.0
        thickness, found = self._search.surface.thickness, None
        for kept in self._kept:
            if 2.0 * (self._apart(kept.p, p)[0] + apart) <= kept.reach - thickness:
                found = kept.found
        if found is None:
            self._apart(p, q)
            kernels.without_mean[self._sums.over](q, self._now, self._space[1])
            found = self._search.on_way(p, self._space[1], thickness + ROUND * size, LEFT)
        if not found.many:
            return 1.0
        self._stream.put(np.ones(1), self._most)
        kernels.reach[self._sums.over](found.pairs, found.many, p, way, self._most)
        return float(self._stream.download(self._most)[0])

    def _candidates(self, p: Any) -> Found:
        """What may be in range at p: all that are, and maybe more."""
        for kept in self._kept:
            if 2.0 * self._apart(kept.p, p)[0] <= kept.reach - self._energy.range:
                return kept.found
        reach = WIDE * self._energy.range + ROUND * self._apart(p, p)[1]
        self._stream.copy(p, self._space[0])
        self._kept = [_Kept(self._space[0], reach, self._search.within(p, reach))]
        return self._kept[0].found

    def _apart(self, p: Any, q: Any) -> tuple[float, float]:
        """How far vertices move from p to q at most, but for their mean, and the largest coordinate of p [m]."""
        over = self._sums.over
        kernels.total_way[over](p, q, 0, self._sums.partials)
        self._stream.put(np.zeros(5), self._now)
        self._sums.second(3, self._now)
        kernels.farthest[over](p, q, self._now)
        *total, square, size = self._stream.download(self._now)
        return (float(square**0.5) if np.isfinite(total).all() else np.inf), float(size)


def touching(stream: Stream, totals: Sums, system: System, order: Any, rows: int) -> list[Touching]:
    """The energies of pairs of a system. Raises Unsupported for those of one's own."""
    found, first = list[Touching](), len(order)
    for energy in system.energies:
        if isinstance(energy, PairContact):
            found.append(Touching(stream, totals, energy, order, first, rows))
            first += found[-1].obstacles
    return found


def obstacles(system: System) -> int:
    """How many vertices all obstacles have. Raises Unsupported for what is known to the processor alone."""
    unknown = [type(e).__name__ for e in system.energies if hasattr(e, "largest_step") and not isinstance(e, Known)]
    if unknown:
        raise Unsupported(f"vbd: on a device knows no {', '.join(unknown)}; take device: cpu")
    return sum(len(energy.end) for energy in system.energies if isinstance(energy, ObstacleContact))
