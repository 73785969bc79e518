"""Self-contact: the mesh cannot intersect itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from springbench.harness.errors import InputError
from springbench.harness.scenes.collision_primitives import (
    END_OF_STEP_REASON,
    compute_barrier_stiffness,
    describe_intersections,
    find_collision_primitives,
    require_fixed_exact_pins,
    require_intersection_free,
)
from springbench.harness.scenes.edge_triangle_intersections import IntersectionCheck, find_edge_triangle_intersections
from springbench.harness.scenes.effects.effect_interface import EffectContribution, ObservedMotion, PinGroup
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.contact_potential import SelfContact as Energy
from springbench.solvers.contact.lagged_friction import MAX_FRICTION_ITERATIONS
from springbench.solvers.model.step_problem import Energy as AnyEnergy
from springbench.solvers.model.step_problem import Positions

MIN_DISTANCE_FRACTION = 0.5
"""Distance relative to the mean rest length below which vertices practically coincide."""
NUM_SAMPLED_FRAMES = 30
"""Number of frames, evenly spaced, that are searched for close vertices."""


class SelfContactEffect(ConfigModel):
    """Separates points from triangles and edges from edges of the mesh by a barrier.

    The barrier diverges as the gap of a pair closes (formulas: `springbench.solvers.contact.potentials.barrier`). All
    intermediate positions are intersection-free. Pairs that share a vertex are excluded. For pairs that are closer at
    rest than `min_distance` plus `dhat`, both are reduced in proportion to the rest distance, so the mesh may be
    arbitrarily fine. Vertices in no edge and no triangle do not collide.
    """

    max_convergence_order: ClassVar[float] = 1.0

    kind: Literal["self-contact"] = "self-contact"
    min_distance: Annotated[PositiveFloat, Field(le=1e9)] = 0.002
    """Minimum distance [m] between points and triangles, and between edges: two layers rest at slightly more than this
    distance."""
    dhat: PositiveFloat | None = None
    """Distance [m] beyond `min_distance` at which the barrier activates; equal to `min_distance` by default."""
    barrier_stiffness: PositiveFloat | None = None
    """Barrier stiffness k [N/m] at each vertex; by default a tenth of the resistance of inertia and springs at the
    time step of the scene's file; other time steps retain it."""
    friction: NonNegativeFloat = 0.0
    """Coulomb's friction coefficient mu, both static and kinetic."""
    eps_v: PositiveFloat = 1e-3
    """Tangential speed [m/s] below which pairs count as sticking, and creep."""
    friction_iterations: PositiveInt = MAX_FRICTION_ITERATIONS
    """Maximum number of solves per step until friction converges, each with the normal forces of the previous one; 1
    uses those of the step's start, which is of order 1 and misses the first step of contact."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the barrier as one energy, with a stiffness from the other effects.

        Args:
            mesh: mesh, whose triangles and stretch springs collide; empty if it has none.
            mass: vertex masses (n,) [kg], for the stiffness where none is given.
            time_step: dt [s], for the stiffness where none is given.

        Raises:
            InputError: if the mesh intersects itself at rest.
        """
        (edges, faces), rest = find_collision_primitives(mesh), mesh.rest_positions
        if not len(edges):
            return EffectContribution()
        reach = self.min_distance if self.dhat is None else self.dhat
        if crossed := find_edge_triangle_intersections(rest, edges, mesh.triangles):
            raise InputError(
                "self-contact: the mesh passes through itself at rest, "
                f"{describe_intersections(crossed, mesh)}; repair it"
            )

        def energy(stiffness: NDArray[np.float64]) -> Energy:
            surface = CollisionMesh.from_rest_shape(rest, edges, faces, stiffness, self.min_distance, reach)
            if (surface.rest_close_pairs[1] <= 0.0).any():
                raise InputError("self-contact: the mesh touches itself at rest; move what touches apart, or join it")
            return Energy(surface, self.friction, self.eps_v, self.friction_iterations)

        def derive_energies(energies: Sequence[AnyEnergy]) -> tuple[AnyEnergy, ...]:
            return (energy(compute_barrier_stiffness(self.barrier_stiffness, mass, time_step, energies)),)

        def check(start: Positions, pins: Sequence[PinGroup]) -> None:
            """Raise InputError for exact pins that move, and for a start (n, 3) [m] with intersections."""
            require_fixed_exact_pins("self-contact", start, pins)
            if crossed := find_edge_triangle_intersections(start, edges, mesh.triangles):
                raise InputError(
                    "self-contact: the start passes through itself, "
                    f"{describe_intersections(crossed, mesh)}; move them apart"
                )
            require_intersection_free("self-contact", energy(np.ones(len(mass))), start, self.min_distance, mesh)

        apart = (IntersectionCheck(((edges, mesh.triangles),)),)
        return EffectContribution(
            derived_energies=(derive_energies,),
            scene_checks=(check,),
            exclusive_features=("self-contact",),
            end_of_step_reasons=END_OF_STEP_REASON,
            intersection_checks=apart,
        )

    @classmethod
    def find_evidence(cls, observed: ObservedMotion) -> str:
        """Return evidence for self-contact: vertices that practically coincide."""
        frames, n = len(observed.positions), len(observed.mesh.rest_positions)
        reach = MIN_DISTANCE_FRACTION * observed.mean_spring_length
        known = _encode_pairs(
            np.concatenate([observed.mesh.springs, _find_close_pairs(observed.mesh.rest_positions, reach)]), n
        )
        most, closest, at = 0, np.inf, 0
        for frame in np.unique(np.linspace(0, frames - 1, NUM_SAMPLED_FRAMES).astype(int)):
            p = observed.positions[frame]
            pairs = _find_close_pairs(p, reach)
            pairs = pairs[~np.isin(_encode_pairs(pairs, n), known)]
            if len(pairs) > most:
                most, at = len(pairs), int(frame)
            if len(pairs):
                closest = min(closest, float(np.linalg.norm(p[pairs[:, 0]] - p[pairs[:, 1]], axis=1).min()))
        if not most:
            return ""
        return (
            f"{most} pairs of vertices without a spring between them are closer than "
            f"{MIN_DISTANCE_FRACTION:g} mean rest lengths at "
            f"{observed.compute_frame_time(at):.2f} s, two come as close as "
            f"{closest / observed.mean_spring_length:.2g}; contact with obstacles "
            "does not separate them"
        )


def _find_close_pairs(p: NDArray[np.float64], reach: float) -> NDArray[np.int64]:
    """Find pairs of vertices (k, 2) closer than `reach` [m]."""
    from scipy.spatial import KDTree

    return KDTree(p).query_pairs(reach, output_type="ndarray").astype(np.int64)


def _encode_pairs(pairs: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Encode each pair as one number, independent of the order of its ends."""
    return pairs.min(axis=1) * n + pairs.max(axis=1)
