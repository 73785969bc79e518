"""Cache of candidate pairs and of clearances, as in a neighbour list with a skin.

Candidates are found at one position and reused while the vertices stay close to it, apart from a common translation.
The cache changes no bit of the results: pairs beyond the activation distance contribute nothing, and all others come in
one order. Step sizes are limited by the pairs that may collide along the displacement (`solvers.contact.ways`). Where
the previous query found none, clusters of primitives are tested first (`contact.broad_phase.cluster_culling`). The
cache then stores the clearance at the end of the displacement, separately for pairs close to each other at rest and for
all others. A later displacement is collision-free if no two vertices move relative to each other by more than that.
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
"""Inflation of bounding boxes, relative to the largest coordinate."""


WIDE = 1.5
"""Query radius relative to the activation distance. A larger one makes each evaluation slower by more than the rarer
broad phases save."""
_MANY = 3
"""Maximum number of cached positions: of a step these are its start, the inertial prediction and the solution."""


class Surfaces(Protocol):
    """Interface of a set of primitives among which candidate pairs are found."""

    @property
    def thickness(self) -> float:
        """Minimum distance of all pairs [m]."""
        ...

    @property
    def reach(self) -> float:
        """Barrier activation distance beyond the minimum distance [m]."""
        ...

    def clear(self, p: Positions, q: Positions, limits: Limits) -> Gaps | None:
        """Return lower bounds of the distances at q, if no pair violates a limit.

        The limits apply to the linear displacement from p to q.

        Args:
            p: start positions (n, 3) [m].
            q: end positions (n, 3) [m].
            limits: limits that no pair may violate.

        Returns:
            Clearance bounds at q; None if a pair violates a limit, or if the test would take long.
        """
        ...

    def unevenness(self, p: Positions, q: Positions) -> float:
        """Return the largest relative displacement of two vertices that are close to each other at rest.

        Args:
            p: start positions, contiguous (n, 3) [m].
            q: end positions, contiguous (n, 3) [m].

        Returns:
            Upper bound [m].
        """
        ...

    def within(self, p: Positions, reach: float) -> Pairs:
        """Return the pairs closer than `reach` [m] at p (n, 3) [m]."""
        ...

    def on_way(self, x: Array, y: Array, limits: Limits, edges: bool) -> Pairs:
        """Return the pairs that may violate a limit on the linear displacement from x to y.

        Args:
            x: start positions (n, 4) [m]; column 3 is padding.
            y: end positions (n, 4) [m]; column 3 is padding.
            limits: limits of the distances.
            edges: True for edge-edge pairs, False for point-triangle pairs.

        Returns:
            Candidates; their barrier parameters may be missing.
        """
        ...


class Kept(NamedTuple):
    """Pairs closer than `reach` [m] at `p` (n, 3).

    far [m]: lower bound of the distances of pairs not close at rest, where known to exceed `reach`.
    """

    p: Positions
    reach: float
    pairs: Pairs
    far: float = 0.0

    @classmethod
    def nothing(cls, surface: Surfaces, p: Positions, gaps: Gaps) -> Kept:
        """Return a cache entry without pairs, with clearance bounds at p (n, 3)."""
        none = np.empty(0)
        pairs = Pairs(np.empty((0, 4), np.int64), 0, none, none, none, surface.thickness, surface.reach)
        return cls(p, min(gaps), pairs, gaps.far)

    @property
    def idle(self) -> bool:
        """Whether there are no pairs within the radius."""
        return not len(self.pairs.vertices)

    def covers(self, p: Positions, limit: float) -> bool:
        """Return whether these include all pairs closer than a limit [m] at p (n, 3)."""
        if self.p.shape != p.shape:
            return False
        moved = unevenness(self.p, p) if self.idle else 2.0 * _apart(self.p, p)
        return moved <= self.reach - limit

    def followed(self, surface: Surfaces, p: Positions, q: Positions, moved: tuple[float, float]) -> Kept | None:
        """Return the entry valid at q, if the displacement from p is collision-free.

        Args:
            surface: the primitives.
            p: start positions (n, 3) [m].
            q: end positions (n, 3) [m].
            moved: maximum relative displacements of p and of q with respect to `positions` [m].

        Returns:
            The entry, or None if gaps may close on the way or a pair may be active at q.
        """
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
    """Return whether gaps of at least `gap` [m] stay open and remain inactive at the end of a displacement.

    moved: maximum relative displacements [m] of its start and of its end with respect to the cached position.
    """
    return moved[1] <= gap - surface.thickness - surface.reach and _open(gap - surface.thickness, moved)


def _open(gap: float, moved: tuple[float, float]) -> bool:
    """Return whether these displacements leave the required fraction of a gap [m]."""
    most = (1.0 - LEFT) * gap
    return (1.0 + LEFT) * moved[0] <= most and moved[1] + LEFT * moved[0] <= most


def idle(surface: Surfaces, kept: list[Kept], p: Positions) -> bool:
    """Return whether no pair is known to be active at p (n, 3), by the caches alone."""
    limit = surface.thickness + surface.reach
    return any(one.idle and one.covers(p, limit) for one in kept)


def pairs(surface: Surfaces, kept: list[Kept], p: Positions) -> Pairs:
    """Return all pairs that are active at p (n, 3), and possibly more.

    Args:
        surface: the primitives.
        kept: cached candidates, updated.
        p: positions (n, 3) [m].
    """
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
    """Return the largest step size up to 1 that keeps all gaps open.

    Args:
        surface: the primitives.
        kept: cached candidates, updated.
        p: positions (n, 3) [m].
        way: displacements (n, 3) [m].

    Returns:
        Step size in [0, 1]; 0 if a gap is closed at p, or if the displacement is not finite.
    """
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
    """Store a new entry in front of the previous ones."""
    kept[:] = [found, *before[: _MANY - 1]]


def _round(p: Positions) -> float:
    """Return the inflation of bounding boxes [m]."""
    return ROUND * float(np.abs(p).max(initial=0.0))


def _apart(p: Positions, q: Positions) -> float:
    """Return the largest displacement [m] of a vertex from p to q, (n, 3) each, relative to the mean displacement."""
    way = q - p
    way -= way.mean(axis=0)
    return float(np.sqrt(np.einsum("ij,ij->i", way, way)).max(initial=0.0))
