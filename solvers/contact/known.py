"""Which pairs may be near, and how far a way may be gone: what was looked up, kept while it holds.

What is near is looked up for a point, and kept for as long as the vertices stay close to it (their common motion
apart). It changes no bit of what is computed: pairs out of range add nothing, and all others come in one order. Steps
are bounded by what they may meet on the way (`solvers.contact.ways`). Where that was nothing the last time, patches
tell first (`solvers.contact.patches`), and what is kept is how far all is apart where the way ends: other ways are free
while no vertices move beside each other by more than that, neighbours at rest among themselves, and all others.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from solvers.contact import ways
from solvers.contact.boxes import Gaps, Limits
from solvers.contact.contacts import Pairs, padded
from solvers.contact.ways import LEFT, unevenness
from solvers.problem import Positions

Array = NDArray[np.float64]

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

    def clear(self, p: Positions, q: Positions, limits: Limits) -> Gaps | None:
        """How far pairs are apart at q, where none comes to its limits on the straight way from p to q, (n, 3) [m]
        both; None where some does, or that would take long to say."""
        ...

    def unevenness(self, p: Positions, q: Positions) -> float:
        """How far any two vertices of what is near each other at rest have moved from p to q, contiguous (n, 3) both,
        beside each other, at most [m]."""
        ...

    def within(self, p: Positions, reach: float) -> Pairs:
        """Pairs that are nearer than `reach` [m] at p (n, 3) [m]."""
        ...

    def on_way(self, x: Array, y: Array, limits: Limits, edges: bool) -> Pairs:
        """Pairs of edges, or of points and triangles, that may come to their limits on the straight way from x to y,
        (n, 4) [m] both, positions with a column more; with what they press with or without."""
        ...


class Kept(NamedTuple):
    """Pairs that are nearer than `reach` [m] at p (n, 3); far [m]: what is not near each other at rest is farther apart
    than this, where that is known to be more."""

    p: Positions
    reach: float
    pairs: Pairs
    far: float = 0.0

    @classmethod
    def nothing(cls, surface: Surfaces, p: Positions, gaps: Gaps) -> Kept:
        """No pairs."""
        none = np.empty(0)
        pairs = Pairs(np.empty((0, 4), np.int64), 0, none, none, none, surface.thickness, surface.reach)
        return cls(p, min(gaps), pairs, gaps.far)

    @property
    def idle(self) -> bool:
        """Whether nothing is so near."""
        return not len(self.pairs.vertices)

    def covers(self, p: Positions, limit: float) -> bool:
        """Whether all pairs nearer than a limit [m] at p (n, 3) are among these."""
        if self.p.shape != p.shape:
            return False
        moved = unevenness(self.p, p) if self.idle else 2.0 * _apart(self.p, p)
        return moved <= self.reach - limit

    def followed(self, surface: Surfaces, p: Positions, q: Positions, moved: tuple[float, float]) -> Kept | None:
        """What is then known at q (n, 3), where all that is not kept stays open on the way from p and nothing is in
        range at q; None where that is not known. moved: how uneven p and q are to where it is kept [m]."""
        if _idle(surface, self.reach, moved):
            return self
        if self.far <= self.reach or not _idle(surface, self.far, moved):
            return None
        before, after = moved[0], surface.unevenness(self.p, q)
        if before > after:
            before = surface.unevenness(self.p, p)
        if not _idle(surface, self.reach, (before, after)):
            return None
        return self._replace(p=q, reach=min(self.reach - after, self.far - moved[1]), far=0.0)


def _idle(surface: Surfaces, gap: float, moved: tuple[float, float]) -> bool:
    """Whether gaps of at least so much [m] stay open, and nothing is in range at the end, where vertices have moved so
    far beside each other at the begin of a way and at its end."""
    return moved[1] <= gap - surface.thickness - surface.reach and _open(gap - surface.thickness, moved)


def _open(gap: float, moved: tuple[float, float]) -> bool:
    """Whether that leaves of a gap [m] more than it has to."""
    most = (1.0 - LEFT) * gap
    return (1.0 + LEFT) * moved[0] <= most and moved[1] + LEFT * moved[0] <= most


def idle(surface: Surfaces, kept: list[Kept], p: Positions) -> bool:
    """Whether it is known that nothing is in range at p (n, 3)."""
    limit = surface.thickness + surface.reach
    return any(one.idle and one.covers(p, limit) for one in kept)


def pairs(surface: Surfaces, kept: list[Kept], p: Positions) -> Pairs:
    """Pairs that may be in range at p (n, 3): all that are, and maybe more."""
    limit = surface.thickness + surface.reach
    for one in kept:
        if one.covers(p, limit):
            return one.pairs
    reach = WIDE * limit + _round(p)
    if kept and all(one.idle for one in kept) and (gaps := surface.clear(p, p, Limits(reach, surface.thickness, 0.0))):
        found = Kept.nothing(surface, p.copy(), gaps)
    else:
        found = Kept(p.copy(), reach, surface.within(p, reach))
    _keep([one for one in kept if one.idle], found, kept)
    return found.pairs


def largest_step(surface: Surfaces, kept: list[Kept], p: Positions, way: Positions) -> float:
    """The largest t up to 1 by which p may go along a way, (n, 3) both, with all gaps open; 0 where one is closed."""
    q, closed, free = p + way, surface.thickness, False
    alone = bool(kept) and all(one.idle for one in kept)
    for one in kept:
        if one.idle and one.p.shape == p.shape and (after := unevenness(one.p, q)) <= max(one.reach, one.far):
            moved = unevenness(one.p, p), after
            free = free or _open(one.reach - closed, moved)
            if alone and (found := one.followed(surface, p, q, moved)):
                kept[:] = kept if found is one else [found, one]
                return 1.0
    if free and not alone:
        return 1.0
    if not np.isfinite(way).all():
        return 0.0
    rounded = _round(p)
    reach = WIDE * (closed + surface.reach) + rounded
    if alone and (gaps := surface.clear(p, q, Limits(reach, closed, LEFT))):
        kept[:] = [Kept.nothing(surface, q, gaps), *kept[:1]]
        return 1.0
    if free:
        return 1.0
    way = way - way.mean(axis=0)
    fast = float(np.sqrt(np.einsum("ij,ij->i", way, way)).max(initial=0.0))
    x, along, scratch, most = padded(p), padded(way), ways.scratch(), 1.0
    for one in kept:
        if one.p.shape == p.shape and 2.0 * (_apart(one.p, p) + fast) <= one.reach - closed:
            return ways.largest(one.pairs, x, along, most, *scratch)
    for edges in (False, True):  # edges are looked up along what points leave of the way
        limits = Limits(closed + rounded, closed, LEFT, 2.0 * most * fast)
        near = surface.on_way(x, x + most * along, limits, edges)
        most = ways.largest(near, x, along, most, *scratch)
    return most


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
