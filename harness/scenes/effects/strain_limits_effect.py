"""Strain limits: springs that act only beyond a minimum and a maximum length (Bouaziz et al. 2014)."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveInt, model_validator
from springbench.harness.scenes.effects.effect_interface import (
    NEGLIGIBLE_FRACTION,
    EffectContribution,
    ObservedMotion,
    build_length_constraints,
)
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.spring_stiffness import compute_spring_stiffness
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies import strain_limit_energy
from springbench.solvers.model.energies.edge_energy import rest_directions

RUBBERY_STRAIN = 0.1
"""Strain above which cloth looks like rubber (Provot 1995)."""


class StrainLimitsEffect(ConfigModel):
    """Limits of the stretch and compression of the springs along and across cells.

    They are enforced by a stiffness or exactly.
    """

    max_convergence_order: ClassVar[float] = 1.0

    kind: Literal["strain-limits"] = "strain-limits"
    max_stretch: float = Field(default=1.1, ge=1.0, le=1e6)
    """Largest length relative to the rest length."""
    min_stretch: float = Field(default=0.0, ge=0.0, le=1.0)
    """Smallest length relative to the rest length; 0 lets springs shrink freely."""
    stiffness: NonNegativeFloat | Literal["exact"]
    """Stiffness of a spring beyond its limits, in the unit of the `stretch` of springs by the same rule; or `exact`:
    inequality constraints of the length, supported by `avbd` only."""
    scaling_rule: Literal["continuum", "area", "fixed", "liu2013"] = "continuum"
    """Scaling rule of the stiffness with the mesh size, as for springs."""
    reference_size: PositiveInt | None = None
    """liu2013: the mesh size for which the stiffness is given."""

    @model_validator(mode="after")
    def _check_limits(self) -> "StrainLimitsEffect":
        if self.min_stretch == self.max_stretch:
            raise ValueError("`min_stretch` and `max_stretch` should differ; use springs for a fixed length")
        return self

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the limits as one energy, empty for zero stiffness, or as length constraints.

        Args:
            mesh: mesh, to whose rest lengths the limits are relative.
            mass, time_step: vertex masses (n,) [kg] and dt [s], which do not matter here.

        Raises:
            InputError: the scaling rule does not fit the mesh, or an exactly limited spring has no length.
        """
        s = 1.0 if self.stiffness == "exact" else self.stiffness
        k = compute_spring_stiffness(
            mesh, scaling_rule=self.scaling_rule, stretch=s, shear=s, bend=0.0, reference_size=self.reference_size
        )
        limited = np.flatnonzero(k > 0.0)
        if not len(limited):
            return EffectContribution()
        if self.stiffness == "exact":
            return build_length_constraints(mesh, limited, self.min_stretch, self.max_stretch)
        edges = mesh.springs[limited]
        rest, direction = rest_directions(mesh.rest_positions, edges)
        if mesh.spring_properties is not None:
            rest = mesh.spring_properties.rest_length[limited]
        limits = self.min_stretch * rest, self.max_stretch * rest
        return EffectContribution(energies=(strain_limit_energy.StrainLimits(edges, k[k > 0.0], *limits, direction),))

    @classmethod
    def find_evidence(cls, observed: ObservedMotion) -> str:
        """Return evidence for strain limits: springs that stretch more than cloth does."""
        rest = observed.springs.rest_length
        if not rest.any():
            return ""
        strain = np.array(
            [observed.springs.edge_lengths(p)[rest > 0.0] / rest[rest > 0.0] - 1.0 for p in observed.positions]
        )
        ever = int((strain.max(axis=0) > RUBBERY_STRAIN).sum())
        if ever <= NEGLIGIBLE_FRACTION * len(rest):
            return ""
        frame = int(strain.max(axis=1).argmax())
        return (
            f"{ever} of {len(rest)} springs stretch by more than {100 * RUBBERY_STRAIN:.0f} %, one by "
            f"{100 * strain.max():.0f} % at {observed.compute_frame_time(frame):.2f} s"
        )
