"""Collision mesh: the points, edges and triangles of a mesh that may collide.

Pairs that are close at rest have scaled distances.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.broad_phase.bvh import BVH, find_candidate_pairs
from springbench.solvers.contact.broad_phase.cluster_culling import ClusterCulling
from springbench.solvers.contact.collisions import Candidates, pad_positions
from springbench.solvers.contact.geometry.aabb import ClearanceBounds, CollisionQuery, IndexArray
from springbench.solvers.contact.geometry.distance import (
    dot3,
    edge_edge_distance_vector,
    point_triangle_distance_vector,
)
from springbench.solvers.contact.potentials.barrier import compute_distances
from springbench.solvers.contact.potentials.edge_edge_mollifier import MOLLIFIER_THRESHOLD_SCALE
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.simd.float64x8 import gather_rows, lowest_set_bit, mask_to_bits

FloatArray = NDArray[np.float64]

_REST_SCALE_FACTOR = 1.0 - 1e-12
"""Factor on the scale of distances: without it, round-off would produce forces at rest."""

_REST_QUERY_FACTOR = 4.0
"""Distance, relative to the activation distance, up to which pairs are tested one by one at rest."""

_EMPTY_ARRAY = np.empty(0)


@dataclass(frozen=True, eq=False)
class CollisionMesh:
    """Points, edges and triangles of a mesh, in contact with each other.

    Pairs that share a vertex are excluded. For pairs that are closer at rest than the activation distance, the minimum
    and the activation distance are scaled in proportion. They exert no force at rest, and still cannot interpenetrate.

    Attributes:
        rest_positions: rest shape (n, 3) [m].
        points, edges, triangles: trees over the primitives.
        edge_lengths: at rest [m], (m,).
        stiffness: barrier stiffness of each vertex [N/m], (n,).
        min_distance: minimum distance [m].
        dhat: barrier activation distance beyond the minimum distance [m].
        rest_close_pairs: sorted keys of the pairs with scaled distances, and their scales.
    """

    rest_positions: Positions
    points: BVH
    edges: BVH
    triangles: BVH
    edge_lengths: FloatArray
    stiffness: FloatArray
    min_distance: float
    dhat: float
    rest_close_pairs: tuple[IndexArray, FloatArray]

    @classmethod
    def from_rest_shape(
        cls,
        rest: Positions,
        edges: IndexArray,
        triangles: IndexArray,
        stiffness: FloatArray,
        min_distance: float,
        dhat: float,
    ) -> CollisionMesh:
        """Build the collision mesh of a rest shape.

        Args:
            rest: rest shape (n, 3) [m].
            edges: vertex indices (m, 2).
            triangles: vertex indices (f, 3).
            stiffness: barrier stiffness of each vertex [N/m], (n,).
            min_distance: minimum distance [m].
            dhat: barrier activation distance beyond the minimum distance [m].
        """
        points = np.unique(np.append(edges.ravel(), triangles.ravel())).astype(np.int64)
        rest = np.array(rest, order="C")
        none = np.empty(0, np.int64), np.empty(0)
        trees = (
            BVH.from_primitives(rest, points[:, None]),
            BVH.from_primitives(rest, edges),
            BVH.from_primitives(rest, triangles),
        )
        lengths = _compute_edge_lengths(rest, trees[1].primitives)
        bare = cls(rest, *trees, lengths, np.array(stiffness), min_distance, dhat, none)
        near, first = bare._find_close_pairs(pad_positions(rest), min_distance + dhat)
        apart = compute_distances(bare._geometric_candidates(near, first), rest)
        close = apart < min_distance + dhat
        keys, share = bare._pair_keys(near, first)[close], _REST_SCALE_FACTOR * apart[close] / (min_distance + dhat)
        order = np.argsort(keys)
        near = keys[order], share[order]
        return cls(rest, *trees, lengths, np.array(stiffness), min_distance, dhat, near)

    def _find_close_pairs(self, x: FloatArray, inflation_radius: float) -> tuple[IndexArray, int]:
        """Return index pairs (k, 2) that may be closer than a radius at x (n, 4).

        The second result is the number of point-triangle pairs, which come first.
        """
        limits = CollisionQuery(inflation_radius, inflation_radius, 0.0, 0.0)
        one = find_candidate_pairs(self.points, self.triangles, x, x, limits)
        return np.concatenate([one, find_candidate_pairs(self.edges, self.edges, x, x, limits)]), len(one)

    @cached_property
    def _cluster_culling(self) -> ClusterCulling:
        return ClusterCulling.from_rest_shape(
            self.rest_positions,
            self.points,
            self.edges,
            self.triangles,
            _REST_QUERY_FACTOR * (self.min_distance + self.dhat),
        )

    def compute_clearance_bounds(self, p: Positions, q: Positions, query: CollisionQuery) -> ClearanceBounds | None:
        """Return lower bounds of the distances at q, if no pair violates a limit.

        Args:
            p: start positions (n, 3) [m] of the linear motion.
            q: end positions (n, 3) [m].
            query: limits of the distances.

        Returns:
            Clearance bounds; None if the test is inconclusive.
        """
        return self._cluster_culling.compute_clearance_bounds(p, q, query)

    def max_relative_displacement(self, p: Positions, q: Positions) -> float:
        """Return the largest relative displacement of two vertices close to each other at rest.

        Args:
            p: start positions, contiguous (n, 3) [m].
            q: end positions, contiguous (n, 3) [m].

        Returns:
            Upper bound [m].
        """
        return self._cluster_culling.max_relative_displacement(p, q)

    def find_proximity_candidates(self, p: Positions, inflation_radius: float) -> Candidates:
        """Return the pairs closer than a radius.

        Args:
            p: positions (n, 3) [m].
            inflation_radius: radius [m], compared with unscaled distances.

        Returns:
            Candidates with their barrier parameters.
        """
        x = pad_positions(p)
        met, first = self._find_close_pairs(x, inflation_radius)
        many = len(met)
        vertices, numbers = np.empty((many, 4), np.int64), (np.empty(many), np.empty(many))
        pairs = Candidates(vertices, first, _EMPTY_ARRAY, *numbers, self.min_distance, self.dhat)
        points, count = filter_candidates(
            pairs, met, self._primitives, self.edge_lengths, self.stiffness, x, inflation_radius
        )
        scale = self._distance_scales(met[:count], points)
        return pairs._replace(
            vertices=pairs.vertices[:count],
            num_point_triangle=points,
            distance_scale=scale,
            stiffness=pairs.stiffness[:count],
            mollifier_threshold=pairs.mollifier_threshold[:count],
        )

    @property
    def _primitives(self) -> tuple[IndexArray, IndexArray, IndexArray]:
        return self.points.primitives, self.triangles.primitives, self.edges.primitives

    def find_ccd_candidates(self, x: FloatArray, y: FloatArray, query: CollisionQuery, edges: bool) -> Candidates:
        """Return the pairs that may violate a limit between x and y.

        Args:
            x: start positions (n, 4) [m]; column 3 is padding.
            y: end positions (n, 4) [m]; column 3 is padding.
            query: limits of the distances.
            edges: True for edge-edge pairs, False for point-triangle pairs.

        Returns:
            Candidates with their distance scales, without stiffness and mollifier threshold.
        """
        one, other = (self.edges, self.edges) if edges else (self.points, self.triangles)
        met = find_candidate_pairs(one, other, x, y, query)
        first = 0 if edges else len(met)
        return self._geometric_candidates(met, first)._replace(distance_scale=self._distance_scales(met, first))

    def _geometric_candidates(self, met: IndexArray, first: int) -> Candidates:
        """Return candidates of index pairs (k, 2), the first ones point-triangle, without scales and stiffnesses."""
        vertices = np.empty((len(met), 4), np.int64)
        write_candidate_vertices(met, first, self._primitives, vertices)
        return Candidates(vertices, first, _EMPTY_ARRAY, _EMPTY_ARRAY, _EMPTY_ARRAY, self.min_distance, self.dhat)

    def _distance_scales(self, met: IndexArray, first: int) -> FloatArray:
        """Return the factors (k,) on the distances of pairs."""
        keys, share = self.rest_close_pairs
        if not (len(keys) and len(met)):
            return np.ones(len(met))
        expected = self._pair_keys(met, first)
        at = np.minimum(np.searchsorted(keys, expected), len(keys) - 1)
        return np.where(keys[at] == expected, share[at], 1.0)

    def _pair_keys(self, met: IndexArray, first: int) -> IndexArray:
        """Return a unique key of each pair."""
        many = max(len(self.triangles.primitives), len(self.edges.primitives), 1)
        key = met[:, 0] * many + met[:, 1]
        key[first:] += len(self.points.primitives) * many
        return key


def _compute_edge_lengths(x: Positions, edges: IndexArray) -> FloatArray:
    return np.asarray(np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1), np.float64)


@jit_inner
def _write_pair_vertices(pair_indices, e, edges, parts, vertices, k):
    """Write the vertices of pair e to row k."""
    points, triangles, sides = parts
    i, j = pair_indices[e, 0], pair_indices[e, 1]
    if edges:
        vertices[k, 0], vertices[k, 1], vertices[k, 2], vertices[k, 3] = (
            sides[i, 0],
            sides[i, 1],
            sides[j, 0],
            sides[j, 1],
        )
    else:
        vertices[k, 0] = points[i, 0]
        vertices[k, 1], vertices[k, 2], vertices[k, 3] = triangles[j, 0], triangles[j, 1], triangles[j, 2]


@jit_kernel
def write_candidate_vertices(pair_indices, first, parts, vertices):
    """Write the vertices (k, 4) of index pairs.

    Args:
        pair_indices: primitive indices (k, 2).
        first: number of point-triangle pairs, which come first.
        parts: points, triangles and edges.
        vertices: output (k, 4).
    """
    for e in range(len(pair_indices)):
        _write_pair_vertices(pair_indices, e, e >= first, parts, vertices, e)


@jit_kernel
def filter_candidates(candidates, pair_indices, parts, lengths, stiffness, x, inflation_radius):
    """Remove the pairs that are not closer than a radius; write the others to `candidates`.

    Args:
        candidates: vertices, stiffness and mollifier threshold are overwritten.
        pair_indices: primitive indices (k, 2), compacted in place.
        parts: points, triangles and edges.
        lengths: edge lengths at rest [m], (m,).
        stiffness: stiffness of each vertex [N/m], (n,).
        x: positions (n, 4) [m].
        inflation_radius: radius [m].

    Returns:
        Number of point-triangle pairs, and of all pairs.
    """
    count, points, begin, limit = 0, 0, 0, inflation_radius * inflation_radius
    for edges in (False, True):
        end = len(pair_indices) if edges else candidates.num_point_triangle
        for first in range(begin, end, 8):
            many = min(8, end - first)
            for k in range(many):
                _write_pair_vertices(pair_indices, first + k, edges, parts, candidates.vertices, count + k)
            left, last = _close_pair_mask(candidates.vertices, x, count, count + many - 1, edges, limit), count
            while left != 0:
                lane = lowest_set_bit(left)
                left &= left - 1
                if lane < many:
                    e = first + lane
                    i, j = pair_indices[e, 0], pair_indices[e, 1]
                    pair_indices[count, 0], pair_indices[count, 1] = i, j
                    v = candidates.vertices[count]
                    for a in range(4):
                        v[a] = candidates.vertices[last + lane, a]
                    candidates.stiffness[count] = 0.25 * (
                        stiffness[v[0]] + stiffness[v[1]] + stiffness[v[2]] + stiffness[v[3]]
                    )
                    candidates.mollifier_threshold[count] = (
                        MOLLIFIER_THRESHOLD_SCALE * (lengths[i] * lengths[j]) ** 2 if edges else 0.0
                    )
                    count += 1
        begin, points = end, points if edges else count
    return points, count


@jit_inner
def _close_pair_mask(vertices, x, first, last, edges, limit):
    """Return as bits which of eight pairs have a squared distance below a limit."""
    a, b = gather_rows(x, vertices, first, last, 0), gather_rows(x, vertices, first, last, 1)
    c, d = gather_rows(x, vertices, first, last, 2), gather_rows(x, vertices, first, last, 3)
    z = edge_edge_distance_vector(a, b, c, d)[4] if edges else point_triangle_distance_vector(a, b, c, d)[4]
    return mask_to_bits(dot3(z, z) < limit)
