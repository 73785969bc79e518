"""Obstacle collision mesh: points against triangles of both sides, and edges against edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact import ccd
from springbench.solvers.contact.broad_phase.bvh import BVH, find_candidate_pairs
from springbench.solvers.contact.collisions import Candidates, pad_positions
from springbench.solvers.contact.geometry import aabb
from springbench.solvers.contact.geometry.aabb import ClearanceBounds, CollisionQuery
from springbench.solvers.contact.potentials.barrier import compute_distances
from springbench.solvers.contact.potentials.edge_edge_mollifier import MOLLIFIER_THRESHOLD_SCALE
from springbench.solvers.model.step_problem import Positions

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


class MeshPrimitives(NamedTuple):
    """Primitives of one side, by global vertex indices.

    Attributes:
        points, edges, triangles: trees over the primitives.
        edge_lengths: at rest [m], (m,).
    """

    points: BVH
    edges: BVH
    triangles: BVH
    edge_lengths: FloatArray

    @classmethod
    def from_rest_shape(cls, rest: Positions, edges: IndexArray, triangles: IndexArray, first_vertex: int = 0) -> Self:
        """Build the primitives of a shape.

        Args:
            rest: rest shape (n, 3) [m].
            edges: vertex indices (m, 2).
            triangles: vertex indices (f, 3).
            first_vertex: global index of the first vertex.
        """
        points = np.unique(np.append(edges.ravel(), triangles.ravel())).astype(np.int64)
        trees = (
            BVH.from_primitives(rest, points[:, None]),
            BVH.from_primitives(rest, edges),
            BVH.from_primitives(rest, triangles),
        )
        length = np.linalg.norm(rest[trees[1].primitives[:, 0]] - rest[trees[1].primitives[:, 1]], axis=1)
        one, two, three = (tree._replace(primitives=tree.primitives + first_vertex) for tree in trees)
        return cls(one, two, three, length)


@dataclass(frozen=True, eq=False)
class ObstacleCollisionMesh:
    """A mesh and obstacles, whose vertices follow those of the mesh.

    Attributes:
        mesh: primitives of the mesh.
        obstacles: primitives of the obstacles.
        stiffness: barrier stiffness of the mesh's vertices [N/m], (n,).
        min_distance: minimum distance between both [m].
        dhat: barrier activation distance beyond the minimum distance [m].
    """

    mesh: MeshPrimitives
    obstacles: MeshPrimitives
    stiffness: FloatArray
    min_distance: float
    dhat: float

    def compute_clearance_bounds(self, p: Positions, q: Positions, query: CollisionQuery) -> ClearanceBounds | None:
        """Return clearance bounds at q from one box around each side.

        Args:
            p: start positions of all vertices (N, 3) [m], those of the mesh first.
            q: end positions of all vertices (N, 3) [m].
            query: limits of the distances.

        Returns:
            Clearance bounds; None if the boxes do not prove that no pair violates a limit.
        """
        n = len(self.stiffness)
        clearance = aabb.compute_aabb_clearance((0, n), (n, len(p)), p, q, query)
        return ClearanceBounds(clearance, clearance) if clearance else None

    def max_relative_displacement(self, p: Positions, q: Positions) -> float:
        """Return the largest relative displacement of any two vertices.

        Args:
            p: start positions of all vertices, contiguous (N, 3) [m].
            q: end positions of all vertices, contiguous (N, 3) [m].

        Returns:
            Upper bound [m].
        """
        return ccd.max_relative_displacement(p, q)

    def find_proximity_candidates(self, p: Positions, inflation_radius: float) -> Candidates:
        """Return the pairs of both sides closer than a radius.

        Args:
            p: positions of all vertices (N, 3) [m], those of the mesh first.
            inflation_radius: radius [m].

        Returns:
            Candidates with their barrier parameters.
        """
        x, limits = pad_positions(p), CollisionQuery(inflation_radius, inflation_radius, 0.0, 0.0)
        one, two = (self.find_ccd_candidates(x, x, limits, edges) for edges in (False, True))
        pairs = one._replace(
            vertices=np.concatenate([one.vertices, two.vertices]),
            distance_scale=np.concatenate([one.distance_scale, two.distance_scale]),
            stiffness=np.concatenate([one.stiffness, two.stiffness]),
            mollifier_threshold=np.concatenate([one.mollifier_threshold, two.mollifier_threshold]),
        )
        close = compute_distances(pairs, p) < inflation_radius
        return pairs._replace(
            vertices=pairs.vertices[close],
            num_point_triangle=int(close[: pairs.num_point_triangle].sum()),
            distance_scale=pairs.distance_scale[close],
            stiffness=pairs.stiffness[close],
            mollifier_threshold=pairs.mollifier_threshold[close],
        )

    def find_ccd_candidates(self, x: FloatArray, y: FloatArray, query: CollisionQuery, edges: bool) -> Candidates:
        """Return the pairs of both sides that may violate a limit between x and y.

        Args:
            x: start positions of all vertices (N, 4) [m], those of the mesh first; column 3 is padding.
            y: end positions of all vertices (N, 4) [m]; column 3 is padding.
            query: limits of the distances.
            edges: True for edge-edge pairs, False for point-triangle pairs.

        Returns:
            Candidates with their barrier parameters; their stiffness is the mean over the vertices of the mesh.
        """
        a, b = self.mesh, self.obstacles
        if edges:
            e, f = find_candidate_pairs(a.edges, b.edges, x, y, query).T
            vertices = np.column_stack([a.edges.primitives[e], b.edges.primitives[f]])
            parallel = MOLLIFIER_THRESHOLD_SCALE * (a.edge_lengths[e] * b.edge_lengths[f]) ** 2
        else:
            one, two = (find_candidate_pairs(i.points, j.triangles, x, y, query).T for i, j in ((a, b), (b, a)))
            vertices = np.concatenate(
                [
                    np.column_stack([a.points.primitives[one[0]], b.triangles.primitives[one[1]]]),
                    np.column_stack([b.points.primitives[two[0]], a.triangles.primitives[two[1]]]),
                ]
            )
            parallel = np.zeros(len(vertices))
        own, points = vertices < len(self.stiffness), 0 if edges else len(vertices)
        stiffness = np.where(own, self.stiffness[np.where(own, vertices, 0)], 0.0).sum(axis=1) / own.sum(axis=1)
        return Candidates(vertices, points, np.ones(len(vertices)), stiffness, parallel, self.min_distance, self.dhat)
