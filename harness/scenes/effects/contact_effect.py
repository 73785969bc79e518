"""Contact of vertices with obstacles, with Coulomb friction; vertices do not collide with each other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator
from springbench.harness.errors import InputError
from springbench.harness.scenes.clearance_checks import (
    compute_largest_gap_radius,
    find_first_violation,
    find_sample_times,
)
from springbench.harness.scenes.effects.effect_interface import EffectContribution, PinGroup
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.primitive_obstacles import AnyObstacle
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact as Energy
from springbench.solvers.contact.lagged_friction import MAX_FRICTION_ITERATIONS
from springbench.solvers.model.step_problem import DirichletPins, Positions, ProjectiveEnergy, System
from springbench.solvers.model.step_problem import Energy as AnyEnergy
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

_STIFFNESS_SAFETY = 4.0
"""Safety factor of the contact stiffness relative to one collision at full speed: neighbours that are stopped in turn
exert a force as well."""

_MARGIN_FRACTION = 0.1
"""Largest displacement of a vertex by forces in one step, as a fraction of the mesh's size."""


class ContactEffect(ConfigModel):
    """Contact that prevents vertices of the mesh from entering obstacles.

    Thin obstacles cannot be tunnelled within a step.

    The stiffness k of contact follows from the penetration tolerance. A vertex that arrives with the speed v ends at
    most v dt Q_ii / k deep, where Q_ii is the resistance of inertia and springs: k_i = 4 Q_ii max(1, v dt / tolerance).
    """

    max_convergence_order: ClassVar[float] = 1.0

    kind: Literal["contact"] = "contact"
    obstacles: tuple[AnyObstacle, ...] = Field(min_length=1)
    """Obstacles that the vertices collide with."""
    min_distance: Annotated[PositiveFloat, Field(le=1e9)] = 0.005
    """Minimum distance [m] of vertices from an obstacle's surface; shorter than every spring at rest."""
    friction: NonNegativeFloat = 0.0
    """Coulomb's friction coefficient mu, both static and kinetic."""
    penetration_tolerance: PositiveFloat | None = None
    """Penetration [m] into `min_distance` that is allowed at the end of a step; by default a tenth of it."""
    max_speed: PositiveFloat = 10.0
    """Largest speed [m/s] at which the penetration tolerance is met."""
    eps_v: PositiveFloat = 1e-5
    """Tangential speed [m/s] below which vertices count as sticking, and creep."""
    friction_iterations: PositiveInt = MAX_FRICTION_ITERATIONS
    """Maximum number of solves per step until friction converges, each with the normal forces of the previous one; 1
    uses those of the step's start, which is of order 1 and misses the first step of contact."""

    @model_validator(mode="after")
    def _check_tolerance(self) -> ContactEffect:
        if not self.max_penetration < self.min_distance:
            raise ValueError(f"the tolerance of {self.max_penetration:g} m should be less than `min_distance`")
        return self

    @property
    def max_penetration(self) -> float:
        """Penetration tolerance [m]."""
        return self.min_distance / 10.0 if self.penetration_tolerance is None else self.penetration_tolerance

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the contact as one energy, with a stiffness from the other effects.

        Args:
            mesh: mesh, whose springs at rest must be longer than the minimum distance.
            mass: vertex masses (n,) [kg], which resist penetration.
            time_step: dt [s], in which a vertex may advance into an obstacle.

        Raises:
            InputError: if a spring is at most `min_distance` long at rest.
        """
        lengths = mesh.rest_lengths
        if len(lengths) and not self.min_distance < lengths.min():
            raise InputError(
                f"contact: got a min_distance of {self.min_distance:g} m, which is not below the shortest of the "
                f"springs at rest, {lengths.min():.3g} m; take a smaller one, or a coarser mesh"
            )
        obstacles = tuple(one.build_obstacle() for one in self.obstacles)

        def derive_energies(energies: Sequence[AnyEnergy]) -> tuple[AnyEnergy, ...]:
            projective = [energy for energy in energies if isinstance(energy, ProjectiveEnergy)]
            everything = np.arange(len(mass))
            pinned_system = System(mass, time_step, pins=DirichletPins(everything, np.full(len(mass), np.inf)))
            resists = np.asarray(assemble_system_matrix(pinned_system, projective).diagonal(), np.float64)
            stiffness = _STIFFNESS_SAFETY * max(1.0, self.max_speed * time_step / self.max_penetration) * resists
            rubs = self.eps_v, _MARGIN_FRACTION * mesh.bounding_box_diagonal, time_step, self.friction_iterations
            return (Energy(obstacles, self.min_distance, self.friction, stiffness, *rubs),)

        return EffectContribution(derived_energies=(derive_energies,), scene_checks=(partial(self._check_start, mesh),))

    def _check_start(self, mesh: Mesh, start: Positions, pins: Sequence[PinGroup]) -> None:
        """Raise InputError for pins or a start (n, 3) [m] inside an obstacle, or planes without a gap."""
        limit = self.min_distance - self.max_penetration
        for k, given in enumerate(self.obstacles):
            obstacle = given.build_obstacle()
            for pin in pins:
                if met := find_first_violation(obstacle, given.motion, pin.targets, pin.motion, limit):
                    time, distance = met
                    self._raise_penetration(mesh, f"pins fix vertex {{}} at {time:g} s", k, distance, pin.vertices)
            self._raise_penetration(
                mesh, "vertex {} starts", k, obstacle.signed_distance(start, 0.0), np.arange(len(start))
            )
        planes = [one for one in self.obstacles if one.kind == "plane"]
        if len(planes) > 1 and any(one.motion for one in planes):  # the start lies between fixed planes
            solid = [one.build_obstacle() for one in planes]
            for time in find_sample_times([one.motion for one in planes]):
                if (radius := compute_largest_gap_radius(solid, time)) < limit:
                    raise InputError(
                        f"contact: the planes leave no room at {time:g} s: {max(2.0 * radius, 0.0):.3g} m at most lie "
                        f"between them, and vertices stay {self.min_distance:g} m away from each; move them less"
                    )

    def _raise_penetration(
        self, mesh: Mesh, subject: str, k: int, distance: NDArray[np.float64], vertices: NDArray[np.int64]
    ) -> None:
        near = np.flatnonzero(distance < self.min_distance - self.max_penetration)
        if len(near):
            worst = near[distance[near].argmin()]
            vertex = f"{vertices[worst]}{mesh.format_file_numbers(int(vertices[worst]))}"
            raise InputError(
                f"contact: {subject.format(vertex)} {distance[worst]:.3g} m from the surface of obstacles[{k}] "
                f"({self.obstacles[k].kind}), which is nearer than the min_distance of {self.min_distance:g} m; move "
                "one of them" + (" (negative distances are inside)" if distance[worst] < 0.0 else "")
            )
