"""Contact of the mesh's points, edges and triangles with the surfaces of obstacles, including meshes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
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
from springbench.harness.scenes.edge_triangle_intersections import IntersectionCheck
from springbench.harness.scenes.effects.effect_interface import EffectContribution, PinGroup
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.surface_obstacles import (
    AnySurface,
    SurfaceMesh,
    build_obstacle_surface,
    is_deforming,
    place_obstacle_points,
)
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.contact.contact_potential import ObstacleContact
from springbench.solvers.contact.lagged_friction import MAX_FRICTION_ITERATIONS
from springbench.solvers.contact.obstacle_mesh import MeshPrimitives, ObstacleCollisionMesh
from springbench.solvers.model.step_problem import Energy, Positions

_MAX_SAG_FRACTION = 0.1
"""Largest inward deviation of the triangles of round obstacles, relative to `min_distance`."""


class SurfaceContactEffect(ConfigModel):
    """Separates points, edges and triangles of the mesh from those of obstacles by a barrier.

    The barrier acts on either side and diverges as the gap closes (formulas:
    `springbench.solvers.contact.potentials.barrier`). All intermediate positions are intersection-free. Moving
    obstacles advance along their motion without passing through the mesh. Planes, spheres, capsules and boxes are
    represented by triangles too; those of round obstacles lie at most a tenth of `min_distance` inside.
    """

    max_convergence_order: ClassVar[float] = 1.0

    kind: Literal["surface-contact"] = "surface-contact"
    obstacles: tuple[AnySurface, ...] = Field(min_length=1)
    """Obstacles that the mesh collides with."""
    min_distance: Annotated[PositiveFloat, Field(le=1e9)] = 0.002
    """Minimum distance [m] from an obstacle's triangles; the mesh rests at slightly more."""
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

    @property
    def resolved_dhat(self) -> float:
        """Barrier activation distance beyond `min_distance` [m], with its default resolved."""
        return self.min_distance if self.dhat is None else self.dhat

    def build_obstacle_surfaces(self, rest_positions: Positions) -> list[SurfaceMesh]:
        """Build the surfaces of the obstacles in their declared poses.

        Args:
            rest_positions: rest positions of the mesh (n, 3) [m]; the triangles of planes extend beyond them.
        """
        return [
            build_obstacle_surface(one, _MAX_SAG_FRACTION * self.min_distance, rest_positions) for one in self.obstacles
        ]

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the barrier as one energy, with a stiffness from the other effects.

        Args:
            mesh: mesh, whose triangles and stretch springs collide; empty if it has none.
            mass: vertex masses (n,) [kg], for the stiffness where none is given.
            time_step: dt [s], for the stiffness where none is given.

        Raises:
            InputError: if an obstacle is invalid.
        """
        (edges, faces), n, shapes = (
            find_collision_primitives(mesh),
            len(mesh.rest_positions),
            self.build_obstacle_surfaces(mesh.rest_positions),
        )
        if not len(edges):
            return EffectContribution()
        sizes = np.cumsum([0, *(len(points) for points, _ in shapes)]).tolist()
        points = np.concatenate([points for points, _ in shapes])
        triangles = np.concatenate([first + faces for first, (_, faces) in zip(sizes, shapes, strict=False)])
        sides = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        ends = np.unique(np.sort(sides, axis=1), axis=0)
        moving = any(one.motion or is_deforming(one) for one in self.obstacles)

        @lru_cache(maxsize=2)  # a step's end is the start of the next one
        def place_at_time(time: float) -> Positions:
            parts = zip(shapes, self.obstacles, strict=True)
            return np.concatenate([place_obstacle_points(one, x, time) for (x, _), one in parts])

        def place(time: float) -> Positions:
            return place_at_time(time) if moving else points

        def carry(begin: float, end: float, p: Positions) -> list[Positions]:
            rigid = [one.motion for one in self.obstacles if one.motion is not None and not is_deforming(one)]
            carried = [motion.transform_points(motion.invert_points(p, begin), end) for motion in rigid]
            for (x, _), one in zip(shapes, self.obstacles, strict=True):
                if is_deforming(one):  # by the mean displacement of its points
                    carried.append(
                        p + (place_obstacle_points(one, x, end) - place_obstacle_points(one, x, begin)).mean(axis=0)
                    )
            return carried

        def energy(stiffness: NDArray[np.float64]) -> ObstacleContact:
            own, others = (
                MeshPrimitives.from_rest_shape(mesh.rest_positions, edges, faces),
                MeshPrimitives.from_rest_shape(points, ends, triangles, n),
            )
            against = ObstacleCollisionMesh(own, others, stiffness, self.min_distance, self.resolved_dhat)
            return ObstacleContact.from_collision_mesh(
                against, place, carry, self.friction, self.eps_v, self.friction_iterations
            )

        def derive_energies(energies: Sequence[Energy]) -> tuple[Energy, ...]:
            return (energy(compute_barrier_stiffness(self.barrier_stiffness, mass, time_step, energies)),)

        apart = IntersectionCheck(((edges, n + triangles), (n + ends, mesh.triangles)), place)

        def check(start: Positions, pins: Sequence[PinGroup]) -> None:
            """Raise InputError for exact pins that move, and for a start (n, 3) [m] with intersections."""
            require_fixed_exact_pins(self.kind, start, pins)
            if crossed := apart.find_intersections(start, 0.0):
                raise InputError(
                    f"{self.kind}: the start passes through obstacles, "
                    f"{describe_intersections(crossed, mesh)}; move them apart"
                )
            require_intersection_free(self.kind, energy(np.ones(n)), start, self.min_distance, mesh)

        return EffectContribution(
            derived_energies=(derive_energies,),
            scene_checks=(check,),
            end_of_step_reasons=END_OF_STEP_REASON,
            intersection_checks=(apart,),
        )
