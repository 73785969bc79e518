"""Strain limits: springs that act only beyond a minimum and a maximum length (Bouaziz et al. 2014)."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeFloat, PositiveInt, model_validator

from harness.base.model import Model
from harness.scenes.effects.base import FEW, Contribution, Seen, kept
from harness.scenes.material import spring_stiffness
from harness.scenes.mesh.base import Mesh
from solvers.energies import strain_limits
from solvers.energies.edges import rest_directions

STRETCH = 0.1
"""Strain above which cloth looks like rubber (Provot 1995)."""


class StrainLimits(Model):
    """Limits the stretch and compression of the springs along and across cells, by a stiffness or exactly."""

    exact_to: ClassVar[float] = 1.0

    kind: Literal["strain-limits"] = "strain-limits"
    longest: float = Field(default=1.1, ge=1.0, le=1e6)
    """Largest length relative to the rest length."""
    shortest: float = Field(default=0.0, ge=0.0, le=1.0)
    """Smallest length relative to the rest length; 0 lets springs shrink freely."""
    stiffness: NonNegativeFloat | Literal["exact"]
    """Stiffness of a spring beyond its limits, in the unit of the `stretch` of springs by the same rule; or `exact`:
    inequality constraints of the length, supported by `avbd` only."""
    rule: Literal["continuum", "fixed", "liu2013"] = "continuum"
    """Scaling rule of the stiffness with the mesh size, as for springs."""
    reference: PositiveInt | None = None
    """liu2013: the mesh size for which the stiffness is given."""

    @model_validator(mode="after")
    def _limits(self) -> "StrainLimits":
        if self.shortest == self.longest:
            raise ValueError("leave no length but one; use springs")
        return self

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the limits as one energy, empty for zero stiffness, or as length constraints."""
        s = 1.0 if self.stiffness == "exact" else self.stiffness
        k = spring_stiffness(mesh, rule=self.rule, stretch=s, shear=s, bend=0.0, reference=self.reference)
        edges = mesh.springs[k > 0.0]
        if not len(edges):
            return Contribution()
        if self.stiffness == "exact":
            return kept(mesh, edges, self.shortest, self.longest)
        rest, direction = rest_directions(mesh.rest, edges)
        limits = self.shortest * rest, self.longest * rest
        return Contribution(energies=(strain_limits.StrainLimits(edges, k[k > 0.0], *limits, direction),))

    @classmethod
    def called_for(cls, seen: Seen) -> str:
        """Return evidence for strain limits: springs that stretch more than cloth does."""
        rest = seen.springs.rest_length
        if not rest.any():
            return ""
        strain = np.array([seen.springs.lengths(p)[rest > 0.0] / rest[rest > 0.0] - 1.0 for p in seen.positions])
        ever = int((strain.max(axis=0) > STRETCH).sum())
        if ever <= FEW * len(rest):
            return ""
        frame = int(strain.max(axis=1).argmax())
        return (
            f"{ever} of {len(rest)} springs stretch by more than {100 * STRETCH:.0f} %, one by "
            f"{100 * strain.max():.0f} % at {seen.time(frame):.2f} s"
        )
