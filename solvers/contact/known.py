"""Which pairs may be near, and how far a way may be gone: what was looked up, kept while it holds.

What is near is looked up for a point, and kept for as long as the vertices stay close to it (their common motion
apart). It changes no bit of what is computed: pairs out of range add nothing, and all others come in one order. Steps
are bounded by what they may meet on the way (`solvers.contact.ways`). Where that is nothing, patches tell
(`solvers.contact.patches`), and what is kept is that nothing is near where the way ends.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from solvers.contact import ways
from solvers.contact.contacts import Pairs, padded
from solvers.contact.ways import LEFT, unevenness
from solvers.problem import Positions

ROUND = 8.0 * np.finfo(np.float64).eps
"""Of the largest coordinate: by so much boxes are made wider."""


WIDE = 1.5
"""Of the range: so far pairs are looked up. More would be looked at each time for longer than it takes to look them up
anew now and then."""
_MANY = 3
"""Positions around which is kept what is near them: of a step these are its start, free fall and where it goes."""


class Surfaces(Protocol):
    """What may touch: finds pairs among all vertices."""

    @property
    def thickness(self) -> float:
        """So far apart pairs stay at least [m]."""
        ...

    @property
    def reach(self) -> float:
        """So far beyond that they feel each other [m]."""
        ...

    def clear(self, p: Positions, q: Positions, reach: float, share: float) -> bool:
        """Whether no pair comes nearer than `reach` [m], and `share` of its distance at p, on the straight way from p
        to q, (n, 3) [m] both; False where that would take long to say."""
        ...

    def within(self, p: Positions, reach: float) -> Pairs:
        """Pairs that are nearer than `reach` [m] at p (n, 3) [m]."""
        ...

    def on_way(self, p: Positions, q: Positions, reach: float, share: float) -> Pairs:
        """Pairs that may come nearer than `reach` [m], and `share` of their distance at p, on the straight way from p
        to q, (n, 3) [m] both; with what they press with or without."""
        ...


class Kept(NamedTuple):
    """Pairs that are nearer than `reach` [m] at p (n, 3)."""

    p: Positions
    reach: float
    pairs: Pairs

    @classmethod
    def nothing(cls, surface: Surfaces, p: Positions, reach: float) -> Kept:
        """No pairs."""
        none = np.empty(0)
        return cls(p, reach, Pairs(np.empty((0, 4), np.int64), 0, none, none, none, surface.thickness, surface.reach))

    @property
    def far(self) -> bool:
        """Whether nothing is so near."""
        return not len(self.pairs.vertices)

    def covers(self, p: Positions, limit: float) -> bool:
        """Whether all pairs nearer than a limit [m] at p (n, 3) are among these."""
        if self.p.shape != p.shape:
            return False
        moved = unevenness(self.p, p) if self.far else 2.0 * _apart(self.p, p)
        return moved <= self.reach - limit

    def passed(self, p: Positions, q: Positions, closed: float) -> bool:
        """Whether all other pairs keep more of their gap beyond `closed` [m] from p to q, (n, 3) both, than they have
        to."""
        if self.p.shape != p.shape:
            return False
        most, before = (1.0 - LEFT) * (self.reach - closed), unevenness(self.p, p)
        return (1.0 + LEFT) * before <= most and unevenness(self.p, q) + LEFT * before <= most


def idle(surface: Surfaces, kept: list[Kept], p: Positions) -> bool:
    """Whether it is known that nothing is in range at p (n, 3)."""
    limit = surface.thickness + surface.reach
    return any(one.far and one.covers(p, limit) for one in kept)


def pairs(surface: Surfaces, kept: list[Kept], p: Positions) -> Pairs:
    """Pairs that may be in range at p (n, 3): all that are, and maybe more."""
    limit = surface.thickness + surface.reach
    for one in kept:
        if one.covers(p, limit):
            return one.pairs
    reach = WIDE * limit + _round(p)
    if all(one.far for one in kept) and surface.clear(p, p, reach, 0.0):
        found = Kept.nothing(surface, p.copy(), reach)
    else:
        found = Kept(p.copy(), reach, surface.within(p, reach))
    _keep([one for one in kept if one.far], found, kept)
    return found.pairs


def largest_step(surface: Surfaces, kept: list[Kept], p: Positions, way: Positions) -> float:
    """The largest t up to 1 by which p may go along a way, (n, 3) both, with all gaps open; 0 where one is closed."""
    q = p + way
    if any(one.far and one.passed(p, q, surface.thickness) for one in kept):
        return 1.0
    if not np.isfinite(way).all():
        return 0.0
    rounded = _round(p)
    reach = WIDE * (surface.thickness + surface.reach) + rounded
    if all(one.far for one in kept) and surface.clear(p, q, reach, LEFT):
        _keep(kept, Kept.nothing(surface, q, reach), kept)
        return 1.0
    way = way - way.mean(axis=0)
    fast, found = float(np.sqrt(np.einsum("ij,ij->i", way, way)).max(initial=0.0)), None
    for one in kept:
        if one.p.shape == p.shape and 2.0 * (_apart(one.p, p) + fast) <= one.reach - surface.thickness:
            found = one.pairs
    if found is None:
        found = surface.on_way(p, q, surface.thickness + rounded, LEFT)
    scratch = np.empty(4, np.int64), np.empty((4, 3)), np.empty((4, 3))
    return ways.largest(found, padded(p), padded(way), 1.0, *scratch)


def _keep(before: list[Kept], found: Kept, kept: list[Kept]) -> None:
    """Keep what was found, before what was before."""
    kept[:] = [found, *before[: _MANY - 1]]


def _round(p: Positions) -> float:
    """By how much boxes are made wider [m]."""
    return ROUND * float(np.abs(p).max(initial=0.0))


def _apart(p: Positions, q: Positions) -> float:
    """How far vertices have moved from p to q, (n, 3) each, at most, but for their mean [m]."""
    way = q - p
    way -= way.mean(axis=0)
    return float(np.sqrt(np.einsum("ij,ij->i", way, way)).max(initial=0.0))
