"""Barrier contact of primitive pairs: an energy of positions (`solvers.contact.barrier`) with a step limit.

`solvers.contact.known` finds the candidates and the collision-free step size.

`SelfContact` is contact of a mesh with itself, `ObstacleContact` that of a mesh with the surfaces of obstacles. Their
vertices follow those of the mesh in all arrays. In a step they are at their end positions; they move there linearly
from their start positions.
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
"""Query radius relative to the activation distance: pairs this close may become active during a solve."""


Place = Callable[[float], Positions]
Carry = Callable[[float, float, Positions], list[Positions]]


class _Met(NamedTuple):
    """Active collisions at p (n, 3), with energy [J] and gradient (n, 3) [N]; buffer: memory of the collisions."""

    p: Positions
    contacts: Contacts
    value: float
    gradient: Positions
    space: Contacts


@dataclass(frozen=True, eq=False)
class PairContact:
    """Barrier energy of primitive pairs, with lagged friction.

    Attributes:
        surface: source of the candidates.
        friction: friction coefficient mu.
        slip: speed [m/s] below which a pair counts as sticking.
        friction_rounds: maximum number of solves of a step, each with the normal forces of the previous one.
        kept: cached candidates, the most recent one first.
        met: collisions at the last two positions; energies, gradients and Hessians are queried alternately.
        room: memory of the Hessian blocks.
        grip: friction of the current step.
    """

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
        """Distance [m] beyond which the barrier vanishes."""
        return self.surface.thickness + self.surface.reach

    def begin_step(self, start: Start) -> Self:
        """Return the energy of a step; pairs active at `start.pressed` have friction."""
        if not self.friction:
            return self
        begun = self.whole(start.positions)
        grip = self._gripping(begun if start.pressed is None else self.whole(start.pressed), begun, start)
        return self if grip is self.grip else replace(self, grip=grip)

    def _gripping(self, p: Positions, begun: Positions, start: Start) -> Grip:
        """Build friction. p: all vertices where normal forces are evaluated; begun: at the step's start."""
        if known.idle(self.surface, self.kept, p):
            return NO_GRIP
        return Grip.of(self._at(p).contacts, begun, self.friction, self.slip * (start.until - start.time))

    def whole(self, p: Positions) -> Positions:
        """Return the positions of all vertices, those of the mesh (n, 3) first."""
        return p if p.flags.carray else np.array(p, order="C")

    def toward(self, direction: Positions) -> Positions:
        """Return the displacements of all vertices, those of the mesh (n, 3) first."""
        return direction if direction.flags.carray else np.array(direction, order="C")

    def pairs(self, p: Positions) -> Pairs:
        """Return all pairs active at p, positions (N, 3) of all vertices, and possibly more."""
        return known.pairs(self.surface, self.kept, p)

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p (n, 3); infinite if a pair is closer than the minimum distance."""
        p = self.whole(p)
        if not known.idle(self.surface, self.kept, p):
            if not np.isfinite(p).all():
                return np.inf
            pressed = self._at(p).value
        else:
            pressed = 0.0
        return pressed + self.grip.value(p) if len(self.grip.vertices) else pressed

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N] at p (n, 3) to `out` (n, 3)."""
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
        """Return the gradient of friction alone [N], (n, 3); None without contact."""
        if not len(self.grip.vertices):
            return None
        n, p = len(p), self.whole(p)
        out = np.zeros_like(p)
        self.grip.add_gradient(p, out)
        return out[:n]

    def blocks(self, p: Positions, keep: float = 1.0) -> Blocks:
        """Return the Hessian blocks [N/m] of all active collisions.

        Args:
            p: positions (n, 3) [m].
            keep: fraction of the negative curvature to include; 0 gives positive semidefinite blocks.
        """
        n, p = len(p), self.whole(p)
        return curvature(self._at(p).contacts, self.grip, p, n, keep, self.room)

    def coupled(self, p: Positions) -> NDArray[np.int64]:
        """Return the vertices (a, 4) of all Hessian blocks at p (n, 3); -1 for none."""
        return coupled(self._at(self.whole(p)).contacts, self.grip, len(p))

    def neighbours(self, p: Positions) -> NDArray[np.int64]:
        """Return the vertices (k, 4) of pairs near p (n, 3); -1 for none.

        The result is independent of the caches.
        """
        return moving(self.surface.within(self.whole(p), _NEAR * self.range).vertices, self.grip, len(p))

    def add_curvature(self, p: Positions, keep: float, places: NDArray[np.int64], values: Array) -> None:
        """Add the Hessian blocks [N/m] at p to existing 3x3 blocks.

        Args:
            p: positions (n, 3) [m].
            keep: fraction of the negative curvature to include.
            places: target block of each vertex pair, (a, 16); -1 for none.
            values: blocks (b, 3, 3) [N/m], updated.
        """
        p = self.whole(p)
        add_curvature(self._at(p).contacts, self.grip, p, keep, places, values)

    def _at(self, p: Positions) -> _Met:
        """Return the collisions at p, positions (N, 3) of all vertices."""
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
        """Return the Hessian [N/m], (3n, 3n)."""
        return self.blocks(p).matrix(len(p))

    def largest_step(self, p: Positions, direction: Positions) -> float:
        """Return the largest step size up to 1 that keeps all gaps open.

        Args:
            p: positions (n, 3) [m].
            direction: displacements (n, 3) [m].

        Returns:
            Step size in [0, 1]; 0 if a gap is closed at p. All smaller step sizes are collision-free too.
        """
        return known.largest_step(self.surface, self.kept, self.whole(p), self.toward(direction))

    def carried(self, p: Positions, direction: Positions, begin: float) -> float:
        """Return the largest collision-free step size while the obstacles move as well.

        Args:
            p: positions (n, 3) [m].
            direction: displacements (n, 3) [m] over the remainder of the step.
            begin: fraction of their motion at which the obstacles start.

        Returns:
            Fraction of the remaining displacements, in [0, 1].
        """
        return self.largest_step(p, direction)

    def at_part(self, part: float) -> Self:
        """Return the energy with obstacles at a fraction of their motion, 1 at its end."""
        return self

    def with_obstacles(self, p: Positions) -> list[Positions]:
        """Return the end positions that p (n, 3) would have if it moved with each of the moving obstacles."""
        return []

    def closed(self, p: Positions) -> list[tuple[NDArray[np.int64], bool, float]]:
        """Return the pairs that violate their minimum distance at p (n, 3), the closest first.

        Returns:
            For each pair its vertices (4,), whether it is one of edges, and its distance [m].
        """
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

    Attributes:
        place: time [s] -> obstacle vertices (o, 3) [m]; the same array at all times if none moves.
        carry: two times and positions (n, 3) -> these positions moved with each moving obstacle.
        begun: obstacle vertices (o, 3) [m] at the step's start.
        placed: obstacle vertices (o, 3) [m] of the evaluation.
        end: obstacle vertices (o, 3) [m] at the step's end.
        times: start and end of the step [s].
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
        """Build the contact at time 0, before any step.

        Args:
            surface: source of the candidates.
            place: time [s] -> obstacle vertices (o, 3) [m].
            carry: two times and positions (n, 3) -> these positions moved with each moving obstacle.
            friction: friction coefficient mu.
            slip: speed [m/s] below which a pair counts as sticking.
            friction_rounds: maximum number of solves of a step.
        """
        now = place(0.0)
        return cls(surface, friction, slip, friction_rounds, place=place, carry=carry, begun=now, placed=now, end=now)

    def begin_step(self, start: Start) -> Self:
        """Return the energy of a step, with obstacles at their end positions."""
        begun, end = self.place(start.time), self.place(start.until)
        step = replace(self, begun=begun, placed=end, end=end, times=(start.time, start.until))
        if self.friction:
            first = np.concatenate([start.positions, begun])
            pressed = first if start.pressed is None else np.concatenate([start.pressed, end])
            step = replace(step, grip=step._gripping(pressed, first, start))
        return step

    def whole(self, p: Positions) -> Positions:
        """Return the positions of all vertices, those of the mesh (n, 3) first."""
        return np.concatenate([p, self.placed])

    def toward(self, direction: Positions) -> Positions:
        """Return the displacements of all vertices, with zeros for the obstacles."""
        return np.concatenate([direction, np.zeros_like(self.placed)])

    def carried(self, p: Positions, direction: Positions, begin: float) -> float:
        """Return the largest collision-free step size while the obstacles move to their end positions."""
        there = self.at_part(begin).placed
        way = np.concatenate([direction, self.end - there])
        return known.largest_step(self.surface, self.kept, np.concatenate([p, there]), way)

    def at_part(self, part: float) -> Self:
        """Return this energy with obstacles at a fraction of their motion in the step."""
        return self if self.begun is self.end else replace(self, placed=self.begun + part * (self.end - self.begun))

    def with_obstacles(self, p: Positions) -> list[Positions]:
        """Return the end positions that p (n, 3) would have if it moved with each of the moving obstacles."""
        return self.carry(*self.times, p)
