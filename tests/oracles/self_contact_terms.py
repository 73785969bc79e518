"""Reference terms of self-contact: a barrier for point-triangle and edge-edge pairs.

Li et al. 2020; with a minimum distance Li, Kaufman and Jiang 2021.

    m k r^2 b((d - t)/r),   b(x) = -(1 - x)^2 ln x for x < 1
    m = (2 - c/e) c/e for c < e,   c = |u x v|^2,   e = 1e-3 |u|^2 |v|^2

with u, v at rest in e, and k the mean over the four vertices, a tenth of the diagonal of Q unless the scene states it.
Where d at rest is below t + r, both t and r are scaled down in proportion, less 1e-12. In this implementation the
nearest points are selected by comparing all candidates: the interior, every side and every corner.

Friction acts on pairs within range at x itself (Li et al. 2020, section 5), with F the barrier's force there:

    mu F h(|u|),   h(u) = u^2/(2 s) for u <= s,  u - s/2 beyond,   s = creep dt
    u = (I - nn')(z - z^t),   z = sum_i c_i x_i,   z^t = sum_i c_i x_i^t   with dd/dx_i = c_i n
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tests.oracles.complex_step import ExtendedArray, ValueFunction, row_norms, to_extended
from tests.oracles.scene_declaration import (
    Array,
    BeginFunction,
    EffectTerms,
    SceneDeclaration,
    StepMoment,
)

IndexArray = NDArray[np.int64]
FrictionPairs = tuple[IndexArray, ExtendedArray, ExtendedArray, ExtendedArray, ExtendedArray]
_TRIANGLE_SIDES = ((1, 2), (1, 3), (2, 3))


def build_self_contact_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build the barrier of all pairs without a common vertex."""
    return build_barriers(effect, [ContactPairs(declared)])


def build_barriers(effect: Any, parts: Sequence[ContactPairs]) -> EffectTerms:
    """Build the barriers of an effect for all pairs of its parts, and their friction."""
    t, r = effect.min_distance, effect.min_distance if effect.dhat is None else effect.dhat

    def needs(resists: Array) -> BeginFunction:
        k = (
            np.full(len(resists), effect.barrier_stiffness)
            if effect.barrier_stiffness
            else 0.1 * np.asarray(resists, float)
        )

        def begin(moment: StepMoment) -> ValueFunction:
            found, slip = list[ValueFunction](), effect.eps_v * (moment.stage_time - moment.time)
            for part in parts:
                found.append(part.build_barrier_energy(t, r, k, moment.stage_time))
                if effect.friction:
                    start_positions = at = part.all_positions(moment.p, moment.time)
                    if moment.normal_force_positions is not None:
                        at = part.all_positions(moment.normal_force_positions, moment.stage_time)
                    friction_pairs = [
                        part.find_friction_pairs(at, start_positions, t, r, k, edges) for edges in (False, True)
                    ]
                    found += [
                        part.build_friction_energy(effect.friction, grip, slip, moment.stage_time)
                        for grip in friction_pairs
                    ]
            return lambda x: np.concatenate([values(x) for values in found])

        return begin

    return EffectTerms(build_from_diagonal=needs, min_length=r)


class ContactPairs:
    """Points, edges and triangles of a mesh.

    `rest_positions` (n, 3) [m] are those from which rest lengths are computed.
    """

    def __init__(self, declared: SceneDeclaration) -> None:
        mesh = declared.mesh
        self.rest_positions: Array = np.asarray(mesh.rest_positions, float)
        covered = set(mesh.triangles.ravel().tolist())
        found = {tuple(sorted(pair)) for t in mesh.triangles.tolist() for pair in combinations(t, 2)}
        ropes = {
            (min(i, j), max(i, j))
            for i, j in mesh.springs[mesh.spring_families["stretch"]].tolist()
            if i != j and not (i in covered and j in covered)
        }
        found |= ropes
        flat = np.array([(i, j, j) for i, j in sorted(ropes)], int).reshape(-1, 3)  # which points may touch as well
        self.triangles = np.concatenate([mesh.triangles, flat])
        self.edges = np.array(sorted(found), int).reshape(-1, 2)
        self.points = np.unique(np.append(self.edges, self.triangles))[:, None]

    def all_positions(self, x: ExtendedArray, time: float) -> ExtendedArray:
        """Return the positions of all vertices of pairs, those of the mesh first.

        Args:
          x: positions of the mesh (n, 3) [m].
          time: time [s].
        """
        return x

    def find_near_pairs(self, x: Array, max_distance: float) -> tuple[IndexArray, IndexArray]:
        """Find point-triangle and edge-edge pairs, (k, 4) each, closer than `max_distance` [m]."""
        return find_near_primitives(x, self.points, self.triangles, max_distance), find_near_primitives(
            x, self.edges, self.edges, max_distance
        )

    def rest_distance(self, rows: IndexArray, edges: bool) -> ExtendedArray:
        """Return the distances of pairs at rest (k,) [m]."""
        return row_norms(_distance_vectors(rows, to_extended(self.rest_positions), edges))

    def min_distance(self, x: Array, max_distance: float) -> float:
        """Return the minimum distance of pairs at x (N, 3) [m], at most `max_distance`."""
        least = [
            row_norms(_distance_vectors(rows, x, k == 1))
            for k, rows in enumerate(self.find_near_pairs(x, max_distance))
        ]
        return float(np.concatenate(least).min(initial=max_distance))

    def build_barrier_energy(self, t: float, r: float, k: Array, time: float) -> ValueFunction:
        """Build the barrier energies [J] at a time [s].

        Args:
          t: minimum distance [m].
          r: barrier activation distance [m].
          k: stiffnesses (n,) [N/m].
          time: time [s].
        """

        def of(x: ExtendedArray) -> ExtendedArray:
            x = self.all_positions(x, time)
            real = np.asarray(np.real(x), float)
            if not np.isfinite(real).all():
                return to_extended([np.inf])
            parts = [
                self._pair_energies(rows, x, t, r, k, edges)
                for rows, edges in zip(self.find_near_pairs(real, t + r), (False, True), strict=True)
            ]
            return np.concatenate(parts)

        return of

    def _pair_energies(
        self, rows: IndexArray, x: ExtendedArray, t: float, r: float, k: Array, edges: bool
    ) -> ExtendedArray:
        d = row_norms(_distance_vectors(rows, x, edges))
        scale, m, stiff = self._pair_parameters(rows, x, t, r, k, edges)
        at = (d / scale - t) / r
        feels, closed = at.real < 1, at.real <= 0
        b = -((1 - at) ** 2) * np.log(np.where(closed, 1, at))
        return np.where(closed, np.inf, m * np.where(feels, stiff * (scale * r) ** 2 * b, 0))

    def _pair_parameters(
        self, rows: IndexArray, x: ExtendedArray, t: float, r: float, k: Array, edges: bool
    ) -> tuple[ExtendedArray, ExtendedArray, ExtendedArray]:
        """Return the scale of t and r, the mollifier and the stiffness [N/m]."""
        share = self.rest_distance(rows, edges) / (to_extended(t) + to_extended(r))
        scale, m = np.where(share < 1, (1 - to_extended(1e-12)) * share, 1), to_extended(np.ones(len(rows)))
        if edges:
            c, e = _cross_squarednorm(rows, x), _side_product(rows, to_extended(self.rest_positions)) / 1000
            m = np.where(np.real(c) < e, (2 - c / e) * (c / e), 1)
        own = rows < len(k)
        return scale, m, to_extended(np.where(own, k[np.where(own, rows, 0)], 0).sum(axis=1)) / own.sum(axis=1)

    def build_friction_energy(self, friction: float, grip: FrictionPairs, slip: float, time: float) -> ValueFunction:
        """Build the friction potential [J] of pairs.

        Args:
          friction: coefficient of friction mu.
          tangential_collisions: friction data of the pairs.
          slip: s [m].
          time: time [s].
        """
        return lambda x: friction * friction_potential(self.all_positions(x, time), *grip, slip)

    def find_friction_pairs(
        self, p: ExtendedArray, start_positions: ExtendedArray, t: float, r: float, k: Array, edges: bool
    ) -> FrictionPairs:
        """Find the friction data of pairs within range at p (N, 3) [m].

        Args:
          p: positions (N, 3) [m] at which normal forces are evaluated.
          start_positions: positions (N, 3) [m] at the start of the step.
          t: minimum distance [m].
          r: barrier activation distance [m].
          k: stiffnesses (n,) [N/m].
          edges: edge-edge instead of point-triangle pairs.

        Returns: rows (g, 4), c (g, 4), n (g, 3), z^t (g, 3) [m], and the force (g,) [N].
        """
        rows = self.find_near_pairs(np.asarray(p, float), t + r)[int(edges)]
        z, four = _distance_vectors(rows, p, edges), np.arange(4 * len(rows)).reshape(-1, 4)
        d = row_norms(z)
        n: ExtendedArray = z / d[:, None]
        weights: list[ExtendedArray] = []
        for i in range(4):
            same = rows == rows[:, i : i + 1]  # a rope's edge names a vertex twice, bumped once in both
            bumped = p[rows] + 1e-100j * same[:, :, None] * n[:, None, :]
            slope = np.imag(row_norms(_distance_vectors(four, bumped.reshape(-1, 3), edges))) / np.longdouble(1e-100)
            weights.append(np.where(same[:, :i].any(axis=1), 0, slope))
        scale, m, stiff = self._pair_parameters(rows, p, t, r, k, edges)
        at = (d / scale - t) / r
        inside = (at > 0) & (at < 1)
        at = np.where(inside, at, 1)
        force = m * stiff * scale * r * ((1 - at) ** 2 / at - 2 * (1 - at) * np.log(at))
        c = np.stack(weights, axis=1)
        return rows, c, n, (c[:, :, None] * start_positions[rows]).sum(axis=1), np.where(inside, force, 0)


def find_near_primitives(x: Array, one: IndexArray, two: IndexArray, radius: float) -> IndexArray:
    """Find pairs of primitives that share no vertex and are closer than a distance.

    Args:
      x: positions (N, 3) [m].
      one: vertices (a, i) of points or edges.
      two: vertices (b, j) of triangles or edges.
      radius: distance [m].

    Returns: vertices of the pairs (k, 4).
    """
    if not (len(one) and len(two)):
        return np.empty((0, 4), int)
    middles = [x[part].mean(axis=1) for part in (one, two)]
    radii = [np.linalg.norm(x[part] - at[:, None], axis=2).max() for part, at in zip((one, two), middles, strict=True)]
    tree: Any = cKDTree(middles[1])
    lists: list[list[int]] = tree.query_ball_point(middles[0], (radius + sum(radii)) * (1 + 1e-9)).tolist()
    i = np.repeat(np.arange(len(one)), [len(found) for found in lists])
    j = np.array([j for found in lists for j in sorted(found)], int)
    disjoint = (one[i][:, :, None] != two[j][:, None, :]).all(axis=(1, 2))
    disjoint &= (i < j) | (one is not two)
    rows = np.concatenate([one[i[disjoint]], two[j[disjoint]]], axis=1)
    far = row_norms(_distance_vectors(rows, x, one.shape[1] == 2))
    return rows[far < radius]


def friction_potential(
    x: ExtendedArray,
    rows: IndexArray,
    weights: ExtendedArray,
    n: ExtendedArray,
    anchor: ExtendedArray,
    force: ExtendedArray,
    slip: float,
) -> ExtendedArray:
    """Compute the friction potential (g,) [J] of pairs, without the factor mu.

    Args:
      x: positions (N, 3) [m].
      rows: vertices of the pairs (g, 4).
      weights: coefficients c (g, 4).
      n: contact normals (g, 3).
      anchor: z^t (g, 3) [m].
      force: normal forces F (g,) [N].
      slip: s [m].
    """
    u = (weights[:, :, None] * x[rows]).sum(axis=1) - anchor
    u = u - (u * n).sum(axis=1)[:, None] * n
    square = (u * u).sum(axis=1)
    sticks = square.real <= slip**2
    return force * np.where(sticks, square / (2 * slip), np.sqrt(np.where(sticks, 1, square)) - to_extended(slip) / 2)


def _distance_vectors(rows: IndexArray, x: ExtendedArray, edges: bool) -> ExtendedArray:
    """Compute the vectors (k, 3) between nearest points, selected by real parts."""
    a, b, c, d = (x[rows[:, i]] for i in range(4))
    found = [_interior_distance(a, b, c, d, edges)]
    if edges:
        found += [
            _point_to_segment(a, c, d),
            _point_to_segment(b, c, d),
            -_point_to_segment(c, a, b),
            -_point_to_segment(d, a, b),
        ]
    else:
        corners = (a, b, c, d)
        found += [_point_to_segment(a, corners[i], corners[j]) for i, j in _TRIANGLE_SIDES]
    all_ = np.stack(found)
    best = np.argmin((np.real(all_) ** 2).sum(axis=2), axis=0)
    return all_[best, np.arange(len(rows))]


def _point_to_segment(p: ExtendedArray, a: ExtendedArray, b: ExtendedArray) -> ExtendedArray:
    """Compute the vector from the nearest point of the segment a b to p."""
    along, away = b - a, p - a
    square = (along * along).sum(axis=1)
    at = (along * away).sum(axis=1) / np.where(square == 0, 1, square)
    at = np.where(at.real < 0, 0, np.where(at.real > 1, 1, at))
    return away - at[:, None] * along


def _interior_distance(
    a: ExtendedArray, b: ExtendedArray, c: ExtendedArray, d: ExtendedArray, edges: bool
) -> ExtendedArray:
    """Compute the vector between lines, or from a plane to a point.

    It is a large vector where the nearest points are not interior.
    """
    u, v, w = (b - a, d - c, a - c) if edges else (c - b, d - b, a - b)
    uu, uv, vv, uw, vw = ((f * g).sum(axis=1) for f, g in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    det = uu * vv - uv * uv
    flat = det.real <= 1e-16 * (uu * vv).real
    det = np.where(flat, 1, det)
    if edges:
        s, t = (uv * vw - vv * uw) / det, (uu * vw - uv * uw) / det
        inside = ~flat & (s.real > 0) & (s.real < 1) & (t.real > 0) & (t.real < 1)
        z = w + s[:, None] * u - t[:, None] * v
    else:
        s, t = (vv * uw - uv * vw) / det, (uu * vw - uv * uw) / det
        inside = ~flat & (s.real > 0) & (t.real > 0) & ((s + t).real < 1)
        z = w - s[:, None] * u - t[:, None] * v
    return np.where(inside[:, None], z, 1e30)


def _cross_squarednorm(rows: IndexArray, x: ExtendedArray) -> ExtendedArray:
    a, b, c, d = (x[rows[:, i]] for i in range(4))
    u, v = b - a, d - c
    return (u * u).sum(axis=1) * (v * v).sum(axis=1) - (u * v).sum(axis=1) ** 2


def _side_product(rows: IndexArray, rest: ExtendedArray) -> ExtendedArray:
    a, b, c, d = (rest[rows[:, i]] for i in range(4))
    return ((b - a) ** 2).sum(axis=1) * ((d - c) ** 2).sum(axis=1)


def contract_to_contact(effect: Any, declared: SceneDeclaration, p: Array) -> Array:
    """Contract positions until the nearest pairs are in mid-range.

    Args:
      effect: contact effect.
      declared: declaration of the scene.
      p: positions (n, 3) [m].
    """
    mesh, r = ContactPairs(declared), effect.min_distance if effect.dhat is None else effect.dhat
    contact_distance = effect.min_distance + r
    max_distance = max(contact_distance, 2.0 * declared.mesh.spacing)
    nearest = mesh.min_distance(p, max_distance)
    share = (effect.min_distance + 0.5 * r) / max(contact_distance, nearest)
    return p.mean(axis=0) + share * (p - p.mean(axis=0))
