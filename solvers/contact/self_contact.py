"""Contact by pairs: an energy of positions alone (`solvers.contact.barrier`), and the largest safe step.

Which pairs may be near, and how far a step may go, `solvers.contact.known` tells.

`SelfContact` is a mesh against itself, `ObstacleContact` a mesh against the surfaces of obstacles. The vertices of
these follow those of the mesh in all that is computed; in a step they are where they are at its end, and go there from
where they are at its start, evenly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers.contact import barrier, contacts, known
from solvers.contact.blocks import Blocks, Room
from solvers.contact.contacts import Contacts, Pairs, padded
from solvers.contact.curvature import add_curvature, coupled, curvature, moving
from solvers.contact.friction_rounds import ROUNDS
from solvers.contact.grip import NO_GRIP, Grip
from solvers.contact.known import Kept, Surfaces
from solvers.problem import Positions, Start

Array = NDArray[np.float64]

_NEAR = 1.25
"""Of the range: pairs so far apart may come into it during a solve."""


Place = Callable[[float], Positions]
Carry = Callable[[float, float, Positions], list[Positions]]


class _Met(NamedTuple):
    """What is in range at p (n, 3), its energy [J] and gradient (n, 3) [N]; space: where the contacts are written."""

    p: Positions
    contacts: Contacts
    value: float
    gradient: Positions
    space: Contacts


@dataclass(frozen=True, eq=False)
class PairContact:
    """A barrier of pairs, and their friction. kept: what was found, the last first; met: at the last two positions that
    were asked about, for value, slopes and second derivatives are asked for in turn; room: for the latter; grip: of a
    step that has begun; friction: mu; slip [m/s]: below it a pair counts as sticking; friction_rounds: solves of a step
    at most, each with the normal forces of the one before."""

    surface: Surfaces
    friction: float = 0.0
    slip: float = 1e-3
    friction_rounds: int = ROUNDS
    kept: list[Kept] = field(default_factory=list[Kept])
    met: list[_Met] = field(default_factory=list[_Met])
    room: Room = field(default_factory=Room)
    grip: Grip = NO_GRIP

    @property
    def range(self) -> float:
        """From this distance on [m] nothing is felt."""
        return self.surface.thickness + self.surface.reach

    def begin_step(self, start: Start) -> Self:
        """The energy of a step: what is in range where it is pressed grips."""
        if not self.friction:
            return self
        begun = self.whole(start.positions)
        grip = self._gripping(begun if start.pressed is None else self.whole(start.pressed), begun, start)
        return self if grip is self.grip else replace(self, grip=grip)

    def _gripping(self, p: Positions, begun: Positions, start: Start) -> Grip:
        """p: all vertices where contacts and their normal forces are taken; begun: at the step's start."""
        if known.idle(self.surface, self.kept, p):
            return NO_GRIP
        return Grip.of(self._at(p).contacts, begun, self.friction, self.slip * (start.until - start.time))

    def whole(self, p: Positions) -> Positions:
        """Positions of all vertices that pairs name, those of the mesh (n, 3) first."""
        return p if p.flags.carray else np.array(p, order="C")

    def toward(self, direction: Positions) -> Positions:
        """The ways of all vertices, those of the mesh (n, 3) first."""
        return direction if direction.flags.carray else np.array(direction, order="C")

    def pairs(self, p: Positions) -> Pairs:
        """Pairs that may be in range at p, all vertices' (N, 3): all that are, and maybe more."""
        return known.pairs(self.surface, self.kept, p)

    def value(self, p: Positions) -> float:
        """The energy [J] at p, shape (n, 3); infinite where a pair is nearer than the thickness."""
        p = self.whole(p)
        if not known.idle(self.surface, self.kept, p):
            if not np.isfinite(p).all():
                return np.inf
            pressed = self._at(p).value
        else:
            pressed = 0.0
        return pressed + self.grip.value(p) if len(self.grip.vertices) else pressed

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N], shape (n, 3), to `out`."""
        n, p = len(p), self.whole(p)
        if not known.idle(self.surface, self.kept, p):
            if not np.isfinite(p).all():
                return
            met = self._at(p)
            if len(met.contacts.vertices):
                out += met.gradient[:n]
        friction = self.friction_gradient(p[:n])
        if friction is not None:
            out += friction

    def friction_gradient(self, p: Positions) -> Positions | None:
        """The gradient of friction alone [N], shape (n, 3); None where nothing is in contact."""
        if not len(self.grip.vertices):
            return None
        n, p = len(p), self.whole(p)
        out = np.zeros_like(p)
        self.grip.add_gradient(p, out)
        return out[:n]

    def blocks(self, p: Positions, keep: float = 1.0) -> Blocks:
        """The second derivatives of each contact in range at p (n, 3); keep: of what bends downwards."""
        n, p = len(p), self.whole(p)
        return curvature(self._at(p).contacts, self.grip, p, n, keep, self.room)

    def coupled(self, p: Positions) -> NDArray[np.int64]:
        """See `solvers.core.bounds.Bounded`."""
        return coupled(self._at(self.whole(p)).contacts, self.grip, len(p))

    def neighbours(self, p: Positions) -> NDArray[np.int64]:
        """See `solvers.core.bounds.Bounded`. What was found before has no say in it."""
        return moving(self.surface.within(self.whole(p), _NEAR * self.range).vertices, self.grip, len(p))

    def add_curvature(self, p: Positions, keep: float, places: NDArray[np.int64], values: Array) -> None:
        """See `solvers.core.bounds.Bounded`."""
        p = self.whole(p)
        add_curvature(self._at(p).contacts, self.grip, p, keep, places, values)

    def _at(self, p: Positions) -> _Met:
        """What is in range at p, all vertices' (N, 3)."""
        for met in self.met:
            if np.array_equal(met.p, p):
                return met
        pairs = self.pairs(p)
        many = len(pairs.vertices)
        if not many:
            nothing = contacts.room(0, pairs.thickness, pairs.reach)
            return _Met(p, nothing, 0.0, p, nothing)
        gradient = np.zeros_like(p)
        space = self.met.pop(0).space if len(self.met) > 1 else None
        if space is None or len(space.vertices) < many:
            space = contacts.room(many, pairs.thickness, pairs.reach)
        near = contacts.in_range(pairs, padded(p), space)
        self.met.append(_Met(p.copy(), near, barrier.press(near, p, gradient), gradient, space))
        return self.met[-1]

    def hessian(self, p: Positions) -> csr_array:
        """The Hessian [N/m], shape (3n, 3n)."""
        return self.blocks(p).matrix(len(p))

    def largest_step(self, p: Positions, direction: Positions) -> float:
        """The largest t up to 1 by which p may go along a direction, both (n, 3), with all gaps open; 0 where one is
        closed at p. Nothing touches at any smaller t either."""
        return known.largest_step(self.surface, self.kept, self.whole(p), self.toward(direction))

    def carried(self, p: Positions, direction: Positions, begin: float) -> float:
        """The largest part t of what is left of the step by which p may go along a direction, both (n, 3), while
        obstacles go on from the part `begin` of theirs."""
        return self.largest_step(p, direction)

    def at_part(self, part: float) -> Self:
        """The same with obstacles at a part of their way in the step, 1 at its end."""
        return self

    def with_obstacles(self, p: Positions) -> list[Positions]:
        """Where p (n, 3) would be at the step's end, were it to move with each of the obstacles that move."""
        return []

    def closed(self, p: Positions) -> list[tuple[NDArray[np.int64], bool, float]]:
        """Pairs that are not farther apart than their thickness at p (n, 3): their vertices (4,), whether they are
        edges, and their distance [m], the nearest first."""
        p = self.whole(p)
        pairs = self.pairs(p)
        apart = barrier.distances(pairs, p)
        bad = np.flatnonzero(~(apart > pairs.scale * pairs.thickness))
        bad = bad[np.argsort(apart[bad], kind="stable")]
        return [(pairs.vertices[e], bool(e >= pairs.points), float(apart[e])) for e in bad.tolist()]


@dataclass(frozen=True, eq=False)
class SelfContact(PairContact):
    """Contact of a surface with itself."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObstacleContact(PairContact):
    """Contact of a surface with obstacles.

    place: a time [s] -> where their vertices are, (o, 3) [m], the same array at all times where none moves; carry: two
    times and positions (n, 3) -> where these would be, were they to move with each of the moving ones in turn; begun,
    placed: (o, 3) [m] at the step's start, and where they are now; left: vertices' ways to the step's end.
    """

    place: Place
    carry: Carry
    begun: Positions
    placed: Positions
    end: Positions
    times: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(
        cls, surface: Surfaces, place: Place, carry: Carry, friction: float, slip: float, friction_rounds: int = ROUNDS
    ) -> Self:
        """The contact at the time 0, before any step."""
        now = place(0.0)
        return cls(surface, friction, slip, friction_rounds, place=place, carry=carry, begun=now, placed=now, end=now)

    def begin_step(self, start: Start) -> Self:
        """The energy of a step, with obstacles where they are at its end."""
        begun, end = self.place(start.time), self.place(start.until)
        step = replace(self, begun=begun, placed=end, end=end, times=(start.time, start.until))
        if self.friction:
            first = np.concatenate([start.positions, begun])
            pressed = first if start.pressed is None else np.concatenate([start.pressed, end])
            step = replace(step, grip=step._gripping(pressed, first, start))
        return step

    def whole(self, p: Positions) -> Positions:
        """See PairContact."""
        return np.concatenate([p, self.placed])

    def toward(self, direction: Positions) -> Positions:
        """See PairContact."""
        return np.concatenate([direction, np.zeros_like(self.placed)])

    def carried(self, p: Positions, direction: Positions, begin: float) -> float:
        """See PairContact."""
        there = self.at_part(begin).placed
        way = np.concatenate([direction, self.end - there])
        return known.largest_step(self.surface, self.kept, np.concatenate([p, there]), way)

    def at_part(self, part: float) -> Self:
        """See PairContact."""
        return self if self.begun is self.end else replace(self, placed=self.begun + part * (self.end - self.begun))

    def with_obstacles(self, p: Positions) -> list[Positions]:
        """See PairContact."""
        return self.carry(*self.times, p)
