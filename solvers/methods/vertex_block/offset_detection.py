"""Contact detection of offset geometric contact (OGC): contacts, and displacement bounds of vertices.

    b_v = gamma min(reach, gaps of all pairs of a point and a triangle or of two edges that v belongs to)

With gamma < 1/2 no pair closes its gap, in whichever direction its vertices move by up to b_v: the points of a triangle
or an edge move by no more than one of its vertices. Source: Chen et al. 2025, "Offset geometric contact", ACM TOG
44(4). There a contact counts once, whatever the number of primitives around its features; barriers count all.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.broad_phase.candidate_cache import (
    CACHE_INFLATION,
    CachedCandidates,
    compute_roundoff_margin,
)
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.collisions import EDGE_EDGE, allocate_collisions, build_collisions, pad_positions
from springbench.solvers.contact.contact_potential import BarrierContact
from springbench.solvers.contact.obstacle_mesh import ObstacleCollisionMesh
from springbench.solvers.methods.vertex_block import offset_blocks
from springbench.solvers.methods.vertex_block.offset_blocks import SurfaceAdjacency
from springbench.solvers.model.step_problem import Positions

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]


class OffsetCollisions(NamedTuple):
    """Contacts of a detection, and the clearances.

    Attributes:
        vertices: (k, 4); points and edges repeat their last vertex in place of those of a triangle.
        is_edge_pair: (k,).
        min_distance, radius: distance at which a contact closes, and range beyond it in which it acts [m], (k,).
        stiffness: (k,) [N/m].
        clearance: smallest gap of each vertex, obstacles included, at most the reach of the detection [m], (N,).
    """

    vertices: IndexArray
    is_edge_pair: NDArray[np.bool_]
    min_distance: FloatArray
    radius: FloatArray
    stiffness: FloatArray
    clearance: FloatArray


class OffsetSurface(NamedTuple):
    """The surfaces of a contact energy, prepared for detections.

    Attributes:
        adjacency: neighbours of all vertices, those of obstacles last.
        mean_edge_length: of the mesh at rest [m].
        vertex_stiffness: contact stiffness of the vertices of the mesh [N/m], (n,).
        cached_candidates: candidates of an inflated query, at most one.
    """

    adjacency: SurfaceAdjacency
    mean_edge_length: float
    vertex_stiffness: FloatArray
    cached_candidates: list[CachedCandidates]

    @classmethod
    def from_contact(cls, contact: BarrierContact) -> OffsetSurface:
        """Prepare the surfaces of a contact energy."""
        mesh: Any = contact.collision_mesh
        sides = [mesh] if isinstance(mesh, CollisionMesh) else [mesh.mesh, mesh.obstacles]
        edges, triangles = (
            np.concatenate([getattr(side, kind).primitives for side in sides]) for kind in ("edges", "triangles")
        )
        num_vertices = 1 + max(int(edges.max(initial=-1)), int(triangles.max(initial=-1)))
        adjacency = SurfaceAdjacency.from_primitives(edges, triangles, num_vertices)
        return cls(adjacency, float(sides[0].edge_lengths.mean()), mesh.stiffness, [])

    def detect_contacts(
        self, contact: BarrierContact, p: Positions, reach: float, bound_fraction: float
    ) -> OffsetCollisions:
        """Detect the contacts at positions, and those that bounded displacements may lead to.

        Args:
            contact: the energy of the step.
            p: positions of the mesh (n, 3) [m].
            reach: largest gap [m] of the pairs that are found, at least the contact radius.
            bound_fraction: displacement bound of a vertex relative to its clearance.
        """
        p, mesh = contact.append_obstacle_positions(p), contact.collision_mesh
        candidates = self._find_candidates(contact, p, reach)
        x, is_contact = pad_positions(p), np.empty(len(candidates.vertices), np.bool_)
        clearance, gap = np.full(len(p), reach), np.empty(len(candidates.vertices))
        offset_blocks.find_offset_contacts(
            self.adjacency, candidates, x, reach, bound_fraction, gap, is_contact, clearance
        )
        num_contacts = int(is_contact.sum())
        contacts = candidates._replace(
            vertices=candidates.vertices[is_contact],
            num_point_triangle=int(is_contact[: candidates.num_point_triangle].sum()),
            distance_scale=candidates.distance_scale[is_contact],
            stiffness=candidates.stiffness[is_contact],
            mollifier_threshold=np.zeros(num_contacts),
            dhat=reach,
        )
        collisions = build_collisions(contacts, x, allocate_collisions(num_contacts, contacts.min_distance, reach))
        scale = collisions.distance_scale.copy()
        return OffsetCollisions(
            collisions.vertices.copy(),
            collisions.kind == EDGE_EDGE,
            scale * mesh.min_distance,
            scale * mesh.dhat,
            self._average_stiffness(collisions.vertices, collisions.coefficients),
            clearance,
        )

    def _find_candidates(self, contact: BarrierContact, p: Positions, reach: float) -> Any:
        """Find all pairs with gaps up to `reach` [m] at p, and possibly more."""
        limit = contact.collision_mesh.min_distance + reach
        if not (self.cached_candidates and self.cached_candidates[0].covers_positions(p, limit)):
            inflated = CACHE_INFLATION * limit + compute_roundoff_margin(p)
            pairs = contact.collision_mesh.find_proximity_candidates(p, inflated)
            self.cached_candidates[:] = [CachedCandidates(p.copy(), inflated, pairs)]
        return self.cached_candidates[0].candidates

    def _average_stiffness(self, vertices: IndexArray, coefficients: FloatArray) -> FloatArray:
        """Return the mean stiffness [N/m] of each contact's mesh vertices, weighted by coefficients (k, 4)."""
        own = vertices < len(self.vertex_stiffness)
        weight = np.where(own, np.abs(coefficients), 0.0)
        total = np.einsum("ki,ki->k", weight, self.vertex_stiffness[np.where(own, vertices, 0)])
        return np.asarray(total / weight.sum(axis=1), np.float64)


def is_supported_contact(energy: object) -> bool:
    """Return whether the surfaces of an energy are those of a mesh and of obstacles."""
    return isinstance(energy, BarrierContact) and isinstance(
        energy.collision_mesh, (CollisionMesh, ObstacleCollisionMesh)
    )
