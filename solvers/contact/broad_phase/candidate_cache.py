"""Cache of candidate pairs and of clearances, as in a neighbour list with a skin.

Candidates are found at one position and reused while the vertices stay close to it, apart from a common translation.
The cache changes no bit of the results: pairs beyond the activation distance contribute nothing, and all others always
have the same order. Step sizes are limited by the pairs that may collide along the displacement
(`springbench.solvers.contact.ccd`). Where the previous query found none, clusters of primitives are tested first
(`springbench.solvers.contact.broad_phase.cluster_culling`). The cache then stores the clearance at the end of the
displacement, separately for pairs close to each other at rest and for all others. A later displacement is
collision-free if no two vertices move relative to each other by more than that.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact import ccd
from springbench.solvers.contact.ccd import MIN_GAP_FRACTION, max_relative_displacement
from springbench.solvers.contact.collisions import Candidates, pad_positions
from springbench.solvers.contact.geometry.aabb import ClearanceBounds, CollisionQuery
from springbench.solvers.model.step_problem import Positions

FloatArray = NDArray[np.float64]

_ROUNDOFF_INFLATION = 8.0 * np.finfo(np.float64).eps
"""Inflation of bounding boxes, relative to the largest coordinate."""

CACHE_INFLATION = 1.5
"""Query radius relative to the activation distance. A larger one makes each evaluation slower by more than the rarer
broad phases save."""
_MAX_CACHES = 3
"""Maximum number of cached positions: of a step these are its start, the inertial prediction and the solution."""


class CandidateSource(Protocol):
    """Interface of a set of primitives among which candidate pairs are found."""

    @property
    def min_distance(self) -> float:
        """Minimum distance of all pairs [m]."""
        ...

    @property
    def dhat(self) -> float:
        """Barrier activation distance beyond the minimum distance [m]."""
        ...

    def compute_clearance_bounds(self, p: Positions, q: Positions, query: CollisionQuery) -> ClearanceBounds | None:
        """Return lower bounds of the distances at q, if no pair violates a limit.

        The limits apply to the linear displacement from p to q.

        Args:
            p: start positions (n, 3) [m].
            q: end positions (n, 3) [m].
            query: limits that no pair may violate.

        Returns:
            Clearance bounds at q; None if a pair violates a limit, or if the test would take long.
        """
        ...

    def max_relative_displacement(self, p: Positions, q: Positions) -> float:
        """Return the largest relative displacement of two vertices close to each other at rest.

        Args:
            p: start positions, contiguous (n, 3) [m].
            q: end positions, contiguous (n, 3) [m].

        Returns:
            Upper bound [m].
        """
        ...

    def find_proximity_candidates(self, p: Positions, inflation_radius: float) -> Candidates:
        """Return the pairs closer than a radius.

        Args:
            p: positions (n, 3) [m].
            inflation_radius: radius [m], compared with unscaled distances.

        Returns:
            Candidates with their barrier parameters.
        """
        ...

    def find_ccd_candidates(self, x: FloatArray, y: FloatArray, query: CollisionQuery, edges: bool) -> Candidates:
        """Return the pairs that may violate a limit between x and y.

        Args:
            x: start positions (n, 4) [m]; column 3 is padding.
            y: end positions (n, 4) [m]; column 3 is padding.
            query: limits of the distances.
            edges: True for edge-edge pairs, False for point-triangle pairs.

        Returns:
            Candidates; their barrier parameters may be missing.
        """
        ...


class CachedCandidates(NamedTuple):
    """Pairs closer than `radius` [m] at `positions` (n, 3).

    far_radius [m]: lower bound of the distances of pairs not close at rest, where known to exceed `radius`.
    """

    positions: Positions
    radius: float
    candidates: Candidates
    far_radius: float = 0.0

    @classmethod
    def without_candidates(cls, source: CandidateSource, p: Positions, gaps: ClearanceBounds) -> CachedCandidates:
        """Return a cache entry without pairs.

        Args:
            source: primitives, whose distance limits the entry repeats.
            p: positions (n, 3) [m], stored without a copy.
            gaps: clearance bounds at p.
        """
        none = np.empty(0)
        pairs = Candidates(np.empty((0, 4), np.int64), 0, none, none, none, source.min_distance, source.dhat)
        return cls(p, min(gaps), pairs, gaps.far_clearance)

    @property
    def is_empty(self) -> bool:
        """Whether there are no pairs within the radius."""
        return not len(self.candidates.vertices)

    def covers_positions(self, p: Positions, limit: float) -> bool:
        """Return whether these include all pairs closer than a limit.

        Args:
            p: positions (n, 3) [m].
            limit: distance [m].
        """
        if self.positions.shape != p.shape:
            return False
        moved = (
            max_relative_displacement(self.positions, p)
            if self.is_empty
            else 2.0 * _max_displacement_from_mean(self.positions, p)
        )
        return moved <= self.radius - limit

    def revalidate_at(
        self, source: CandidateSource, p: Positions, q: Positions, displacements: tuple[float, float]
    ) -> CachedCandidates | None:
        """Return the entry valid at q, if the displacement from p is collision-free.

        Args:
            source: the primitives.
            p: start positions (n, 3) [m].
            q: end positions (n, 3) [m].
            displacements: maximum relative displacements of p and of q with respect to `positions` [m].

        Returns:
            The entry, or None if gaps may close on the path or a pair may be active at q.
        """
        if _stays_inactive(source, self.radius, displacements):
            return self
        if self.far_radius <= self.radius or not _stays_inactive(source, self.far_radius, displacements):
            return None
        before, after = displacements[0], source.max_relative_displacement(self.positions, q)
        if before > after:
            before = source.max_relative_displacement(self.positions, p)
        if not _stays_inactive(source, self.radius, (before, after)):
            return None
        return self._replace(
            positions=q, radius=min(self.radius - after, self.far_radius - displacements[1]), far_radius=0.0
        )


def _stays_inactive(source: CandidateSource, gap: float, displacements: tuple[float, float]) -> bool:
    """Return whether gaps stay open on a displacement and are inactive at its end.

    gap: lower bound of the distances at the cached position [m]; displacements: maximum relative displacements [m] of
    the start and of the end with respect to the cached position.
    """
    return displacements[1] <= gap - source.min_distance - source.dhat and _keeps_gaps_open(
        gap - source.min_distance, displacements
    )


def _keeps_gaps_open(gap: float, displacements: tuple[float, float]) -> bool:
    """Return whether these displacements leave the required fraction of a gap [m]."""
    most = (1.0 - MIN_GAP_FRACTION) * gap
    return (1.0 + MIN_GAP_FRACTION) * displacements[0] <= most and displacements[1] + MIN_GAP_FRACTION * displacements[
        0
    ] <= most


def has_no_active_collisions(source: CandidateSource, caches: list[CachedCandidates], p: Positions) -> bool:
    """Return whether no pair can be active, by the caches alone.

    Args:
        source: primitives, whose activation distance is the limit.
        caches: cached candidates, of which only those without pairs are used.
        p: positions (n, 3) [m].

    Returns:
        True if it is certain; False also where the caches do not cover p.
    """
    limit = source.min_distance + source.dhat
    return any(one.is_empty and one.covers_positions(p, limit) for one in caches)


def find_candidates(source: CandidateSource, caches: list[CachedCandidates], p: Positions) -> Candidates:
    """Return all pairs that are active at p (n, 3), and possibly more.

    Args:
        source: the primitives.
        caches: cached candidates, updated.
        p: positions (n, 3) [m].
    """
    limit = source.min_distance + source.dhat
    for one in caches:
        if one.covers_positions(p, limit):
            return one.candidates
    reach = CACHE_INFLATION * limit + compute_roundoff_margin(p)
    if (
        caches
        and all(one.is_empty for one in caches)
        and (gaps := source.compute_clearance_bounds(p, p, CollisionQuery(reach, source.min_distance, 0.0)))
    ):
        found = CachedCandidates.without_candidates(source, p.copy(), gaps)
    else:
        found = CachedCandidates(p.copy(), reach, source.find_proximity_candidates(p, reach))
    _store_cache([one for one in caches if one.is_empty], found, caches)
    return found.candidates


def find_collision_free_step_size(
    source: CandidateSource, caches: list[CachedCandidates], p: Positions, displacement: Positions
) -> float:
    """Return the largest step size up to 1 at which all gaps stay open.

    Args:
        source: the primitives.
        caches: cached candidates, updated.
        p: positions (n, 3) [m].
        displacement: displacements (n, 3) [m].

    Returns:
        Step size in [0, 1]; 0 if a gap is closed at p, or if the displacement is not finite.
    """
    q, closed, free = p + displacement, source.min_distance, False
    alone = bool(caches) and all(one.is_empty for one in caches)
    for one in caches:
        if (
            one.is_empty
            and one.positions.shape == p.shape
            and (after := max_relative_displacement(one.positions, q)) <= max(one.radius, one.far_radius)
        ):
            moved = max_relative_displacement(one.positions, p), after
            free = free or _keeps_gaps_open(one.radius - closed, moved)
            if alone and (found := one.revalidate_at(source, p, q, moved)):
                caches[:] = caches if found is one else [found, one]
                return 1.0
    if free and not alone:
        return 1.0
    if not np.isfinite(displacement).all():
        return 0.0
    rounded = compute_roundoff_margin(p)
    reach = CACHE_INFLATION * (closed + source.dhat) + rounded
    if alone and (gaps := source.compute_clearance_bounds(p, q, CollisionQuery(reach, closed, MIN_GAP_FRACTION))):
        caches[:] = [CachedCandidates.without_candidates(source, q, gaps), *caches[:1]]
        return 1.0
    if free:
        return 1.0
    displacement = displacement - displacement.mean(axis=0)
    fast = float(np.sqrt(np.einsum("ij,ij->i", displacement, displacement)).max(initial=0.0))
    x, along, scratch, most = pad_positions(p), pad_positions(displacement), ccd.allocate_ccd_scratch(), 1.0
    for one in caches:
        if (
            one.positions.shape == p.shape
            and 2.0 * (_max_displacement_from_mean(one.positions, p) + fast) <= one.radius - closed
        ):
            return ccd.collision_free_step_size(one.candidates, x, along, most, *scratch)
    for edges in (False, True):  # edge pairs are queried only up to the step size that points allow
        limits = CollisionQuery(closed + rounded, closed, MIN_GAP_FRACTION, 2.0 * most * fast)
        near = source.find_ccd_candidates(x, x + most * along, limits, edges)
        most = ccd.collision_free_step_size(near, x, along, most, *scratch)
    return most


def _store_cache(before: list[CachedCandidates], found: CachedCandidates, caches: list[CachedCandidates]) -> None:
    """Store a new entry in front of the previous ones."""
    caches[:] = [found, *before[: _MAX_CACHES - 1]]


def compute_roundoff_margin(p: Positions) -> float:
    """Return the distance [m] that rounding errors of positions may amount to.

    Bounding boxes are inflated by it.
    """
    return _ROUNDOFF_INFLATION * float(np.abs(p).max(initial=0.0))


def _max_displacement_from_mean(p: Positions, q: Positions) -> float:
    """Return the largest displacement [m] of a vertex from p to q, relative to the mean."""
    shift = q - p
    shift -= shift.mean(axis=0)
    return float(np.sqrt(np.einsum("ij,ij->i", shift, shift)).max(initial=0.0))
