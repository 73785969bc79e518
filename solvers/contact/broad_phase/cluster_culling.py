"""Cluster culling: prove that no primitives of a surface come close, without testing each.

The surface is divided into clusters of a few vertices each. A cluster owns the points, edges and triangles whose first
vertex along the Morton curve belongs to it. Cluster pairs that are close at rest are tested by their affine poses
(`springbench.solvers.contact.broad_phase.cluster_bounds`), all others by bounding boxes. Primitives are tested only
where both fail. The result is a lower bound of all distances at the end of the motion. Boxes are tested again only
after vertices have moved relative to each other by that bound.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact import ccd
from springbench.solvers.contact.broad_phase import bvh, cluster_bounds, cluster_fit
from springbench.solvers.contact.broad_phase.bvh import BVH
from springbench.solvers.contact.broad_phase.cluster_bounds import ClusterPairs, ProjectionBasis
from springbench.solvers.contact.broad_phase.cluster_fit import ClusterPose, RestClusters
from springbench.solvers.contact.broad_phase.cluster_primitives import ClusterPrimitives, cluster_candidates
from springbench.solvers.contact.ccd import max_relative_displacement
from springbench.solvers.contact.collisions import Candidates, copy_padded
from springbench.solvers.contact.geometry.aabb import ClearanceBounds, CollisionQuery, IndexArray
from springbench.solvers.contact.potentials.barrier import compute_distances
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.model.step_problem import Positions

FloatArray = NDArray[np.float64]

_CLUSTER_SIZE = 16
"""Number of vertices assigned to a cluster; its primitives add vertices of neighbouring clusters."""

_QUERY_INFLATION = 1.5
"""Query distance relative to the required one: a larger clearance stays valid for longer."""

_REMOTE_INFLATION = 4.0
"""Further factor on the query distance for clusters not close at rest; if pairs remain, it is queried without it."""

_POSITION_TOLERANCE = 1e-12
"""Tolerance, relative to the query distance, within which two positions count as the same."""

_MAX_PRIMITIVE_PAIRS = 4096
"""Maximum number of primitive pairs; beyond it, some pair is assumed to come close."""


class CullingScratch(NamedTuple):
    """Scratch memory of a query.

    Attributes:
        tile: (3 k, 8).
        stack: of the tree traversal.
        projection: of the clusters.
        unresolved_pairs: cluster pairs that are not proved to be separated (k, 2).
        start_aabbs, end_aabbs: boxes of a cluster's primitives (k, 6, 8).
        primitive_pairs: (k, 4).
        displacement: of vertices (n, 4).
        displacement_min, displacement_max: boxes of the displacements of each cluster (m, 4).
    """

    tile: FloatArray
    stack: IndexArray
    projection: ProjectionBasis
    unresolved_pairs: IndexArray
    start_aabbs: FloatArray
    end_aabbs: FloatArray
    primitive_pairs: IndexArray
    displacement: FloatArray
    displacement_min: FloatArray
    displacement_max: FloatArray


@dataclass(frozen=True, eq=False)
class ClusterCulling:
    """Clusters of a surface.

    Attributes:
        rest_clusters: clusters at rest.
        bvh: tree over the clusters.
        points, edges, triangles: primitives of the clusters.
        rest_query_distance: lower bound of the rest distance of all pairs that are not stored [m].
        cluster_pairs: first all pairs that are close at rest, sorted, then memory for more.
        scratch: scratch memory.
        pair_starts: first pair of each cluster (clusters + 1,).
        recent_poses: poses at the last two positions.
        remote_clearances: position of the last query, and the clearance there of clusters not close at rest [m].
        is_dense: whether too many clusters are close at rest, as in a stack of sheets, for culling to be useful.
    """

    rest_clusters: RestClusters
    bvh: BVH
    points: ClusterPrimitives
    edges: ClusterPrimitives
    triangles: ClusterPrimitives
    rest_query_distance: float
    cluster_pairs: ClusterPairs
    scratch: CullingScratch
    pair_starts: IndexArray
    recent_poses: list[_ClusterSnapshot] = field(default_factory=list["_ClusterSnapshot"])
    remote_clearances: list[tuple[Positions, float]] = field(default_factory=list[tuple[Positions, float]])
    is_dense: bool = False

    @classmethod
    def from_rest_shape(
        cls, rest: Positions, points: BVH, edges: BVH, triangles: BVH, rest_query_distance: float
    ) -> ClusterCulling:
        """Divide a rest shape into clusters.

        Args:
            rest: rest shape (n, 3) [m].
            points, edges, triangles: trees over the primitives.
            rest_query_distance: distance up to which cluster pairs count as close at rest [m].
        """
        many = max(1, -(-len(points.primitives) // _CLUSTER_SIZE))
        rank = np.zeros(len(rest), np.int64)
        rank[points.primitives[:, 0]] = np.arange(len(points.primitives)) // _CLUSTER_SIZE
        owned = (
            ClusterPrimitives.from_primitives(points.primitives, rank, many),
            ClusterPrimitives.from_primitives(edges.primitives, rank, many),
            ClusterPrimitives.from_primitives(triangles.primitives, rank, many),
        )
        at_rest = cluster_fit.build_rest_clusters(rest, np.concatenate([one.cluster_vertices() for one in owned]), many)
        tree, most = BVH.from_count(many), max(int(np.diff(one.cluster_starts).max()) for one in owned)
        room, eights = 24 * many + 8, -(-most // 8) + -(-most // 64) + 1
        patches = len(at_rest.centre)
        scratch = CullingScratch(
            tile=np.empty((3 * at_rest.vertices.shape[1], 8)),
            stack=bvh.allocate_traversal_stack(),
            projection=ProjectionBasis.allocate_basis(patches),
            unresolved_pairs=np.empty((room, 2), np.int64),
            start_aabbs=np.empty((eights, 6, 8)),
            end_aabbs=np.empty((eights, 6, 8)),
            primitive_pairs=np.empty((_MAX_PRIMITIVE_PAIRS, 4), np.int64),
            displacement=np.empty((len(rest), 4)),
            displacement_min=np.empty((patches, 4)),
            displacement_max=np.empty((patches, 4)),
        )
        made = cls(
            at_rest,
            tree,
            *owned,
            rest_query_distance,
            ClusterPairs.allocate_pairs(room),
            scratch,
            np.zeros(many + 1, np.int64),
        )
        return made._with_rest_pairs(rest)

    def compute_clearance_bounds(self, p: Positions, q: Positions, query: CollisionQuery) -> ClearanceBounds | None:
        """Return clearance bounds at q, if the motion violates no limit.

        Pairs with a common vertex are excluded.

        Args:
            p: start positions (n, 3) [m].
            q: end positions (n, 3) [m].
            query: limits of the distances.

        Returns:
            Clearance bounds; None if the test is inconclusive.
        """
        if self.is_dense:
            return None
        query = query._replace(max_displacement=max_relative_displacement(p, q))
        begin, end, memory = self._fit_clusters(p, query), self._fit_clusters(q, query), self.scratch
        wide = query._replace(inflation_radius=_QUERY_INFLATION * query.inflation_radius)
        far, others = self._known_remote_clearance(p, q, query), 0
        if not far:
            for far in (_REMOTE_INFLATION * wide.inflation_radius, wide.inflation_radius):
                others = self._find_cluster_pairs(begin, end, query._replace(inflation_radius=far))
                if not others:
                    self.remote_clearances[:] = [(q.copy(), far)]
                    break
            if others < 0:
                return None
        count = self.num_rest_pairs + others
        count, near = cluster_bounds.unresolved_cluster_pairs(
            begin.pose,
            end.pose,
            self.cluster_pairs,
            count,
            query,
            wide.inflation_radius,
            memory.projection,
            memory.tile,
            memory.unresolved_pairs,
        )
        if count:
            pairs = self._find_primitive_pairs(memory.unresolved_pairs[:count], begin.positions, end.positions, wide)
            if pairs is None:
                return None
            pairs, scratch = pairs._replace(min_distance=query.inflation_radius), ccd.allocate_ccd_scratch()
            np.subtract(end.positions, begin.positions, out=memory.displacement)
            if ccd.collision_free_step_size(pairs, begin.positions, memory.displacement, 1.0, *scratch) < 1.0:
                return None
            near = min(near, float(compute_distances(pairs, q).min(initial=wide.inflation_radius)))
        return ClearanceBounds(near, near if others else far)

    def _known_remote_clearance(self, p: Positions, q: Positions, query: CollisionQuery) -> float:
        """Return the known clearance [m] at q of clusters not close at rest.

        The result is 0 unless the known clearances prove that the motion from p to q violates no limit.
        """
        for at, far in self.remote_clearances:
            before, after = max_relative_displacement(at, p), max_relative_displacement(at, q)
            if max(
                query.inflation_radius, query.min_distance + query.relative_min_distance * (far + before)
            ) <= far - max(before, after):
                return far - after
        return 0.0

    def max_relative_displacement(self, p: Positions, q: Positions) -> float:
        """Return the largest relative displacement of two vertices of clusters that are close at rest.

        Args:
            p: start positions, contiguous (n, 3) [m].
            q: end positions, contiguous (n, 3) [m].

        Returns:
            Upper bound [m].
        """
        memory = self.scratch
        return cluster_fit.max_cluster_displacement(
            self.rest_clusters.vertices,
            self.cluster_pairs.clusters,
            self.num_rest_pairs,
            p,
            q,
            memory.displacement,
            memory.tile,
            memory.displacement_min,
            memory.displacement_max,
        )

    def _fit_clusters(self, p: Positions, query: CollisionQuery) -> _ClusterSnapshot:
        for k, one in enumerate(self.recent_poses):
            if ccd.is_rigid_translation(one.positions, p, _POSITION_TOLERANCE * query.inflation_radius):
                self.recent_poses.append(self.recent_poses.pop(k))  # the first entry is the next to be overwritten
                return one
        one = (
            self.recent_poses.pop(0)
            if len(self.recent_poses) > 1
            else _ClusterSnapshot.allocate_snapshot(self.rest_clusters, self.bvh, len(p))
        )
        copy_padded(p, one.positions)
        leaf = self.bvh.num_nodes - len(self.rest_clusters.centre) // 8
        cluster_fit.fit_affine(self.rest_clusters, one.positions, leaf, one.aabbs, self.scratch.tile, one.pose)
        self.recent_poses.append(one)
        return one

    def _find_cluster_pairs(self, begin: _ClusterSnapshot, end: _ClusterSnapshot, query: CollisionQuery) -> int:
        """Find cluster pairs to test in addition to those close at rest.

        The result is their number, or -1 if the capacity does not suffice.
        """
        known, pairs = self.num_rest_pairs, self.cluster_pairs
        here, there = begin.aabbs, end.aabbs
        for around in (here, there):
            bvh.propagate_bounds(around, len(self.bvh.primitives))
        many = bvh.traverse_trees(
            self.bvh, self.bvh, (here, here), (there, there), query, True, self.scratch.stack, pairs.clusters[known:]
        )
        if known + many > len(pairs.clusters):
            return -1
        count = keep_new_pairs(pairs.clusters, self.pair_starts, many)
        pairs.rest_distance[known : known + count] = self.rest_query_distance
        cluster_bounds.compute_rest_relations(self.rest_clusters, known, known + count, pairs)
        return count

    def _find_primitive_pairs(
        self, patches: IndexArray, x: FloatArray, y: FloatArray, query: CollisionQuery
    ) -> Candidates | None:
        """Return primitive pairs whose boxes may violate the limits; None if there are too many.

        patches: cluster pairs (k, 2).
        """
        memory = self.scratch
        owned = self.points, self.edges, self.triangles
        first, many = cluster_candidates(
            owned, patches, x, y, query, memory.start_aabbs, memory.end_aabbs, memory.primitive_pairs
        )
        if many > len(memory.primitive_pairs):
            return None
        nothing = np.empty(0)
        return Candidates(
            memory.primitive_pairs[:many], first, np.ones(many), nothing, nothing, query.inflation_radius, 0.0
        )

    def _with_rest_pairs(self, rest: Positions) -> ClusterCulling:
        """Return the clusters with the pairs that are close at rest (n, 3)."""
        limits = CollisionQuery(self.rest_query_distance, self.rest_query_distance, 0.0, 0.0)
        many, at, pairs = len(self.bvh.primitives), self._fit_clusters(rest, limits), self.cluster_pairs
        others = self._find_cluster_pairs(at, at, limits)
        if not 0 <= others <= len(pairs.clusters) // 2:
            return replace(self, recent_poses=[], is_dense=True)
        each = np.arange(many)
        met = np.concatenate([np.column_stack([each, each]), pairs.clusters[:others]])
        known = len(met)
        pairs.clusters[:known] = met[np.lexsort((met[:, 1], met[:, 0]))]
        for k in range(known):
            near = self._find_primitive_pairs(pairs.clusters[k : k + 1], at.positions, at.positions, limits)
            pairs.rest_distance[k] = (
                compute_distances(near, rest).min(initial=self.rest_query_distance) if near else 0.0
            )
        cluster_bounds.compute_rest_relations(self.rest_clusters, 0, known, pairs)
        starts = np.searchsorted(pairs.clusters[:known, 0], np.arange(many + 1))
        return replace(self, pair_starts=starts, recent_poses=[])

    @property
    def num_rest_pairs(self) -> int:
        """Number of cluster pairs that are close at rest."""
        return int(self.pair_starts[-1])


class _ClusterSnapshot(NamedTuple):
    """Poses and bounding boxes of clusters at x (n, 4), padded positions."""

    positions: FloatArray
    pose: ClusterPose
    aabbs: FloatArray

    @classmethod
    def allocate_snapshot(cls, rest: RestClusters, tree: BVH, vertices: int) -> _ClusterSnapshot:
        """Allocate a snapshot."""
        many = len(rest.centre)
        around = np.empty((tree.num_nodes, 6, 8))
        around[:, :3], around[:, 3:] = np.inf, -np.inf
        lies = ClusterPose(*(np.zeros((many, 4)) for _ in ClusterPose._fields))
        return cls(np.empty((vertices, 4)), lies, around)


@jit_kernel
def keep_new_pairs(pairs, starts, num_new_pairs):
    """Remove new pairs that are already stored as close at rest, and compact the others.

    Args:
        pairs: cluster pairs (k, 2), those close at rest first; updated.
        starts: first pair of each cluster (clusters + 1,).
        num_new_pairs: number of pairs after those close at rest.

    Returns:
        Number of remaining new pairs.
    """
    known = starts[-1]
    count = known
    for e in range(known, known + num_new_pairs):
        a, b = pairs[e, 0], pairs[e, 1]
        new = True
        for k in range(starts[a], starts[a + 1]):
            new &= pairs[k, 1] != b
        if new:
            pairs[count, 0], pairs[count, 1] = a, b
            count += 1
    return count - known
