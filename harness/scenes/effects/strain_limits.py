"""Strain limits: springs that resist only beyond a shortest and a longest length (Bouaziz et al. 2014)."""

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
"""Cloth that stretches further than this looks like rubber (Provot 1995)."""


class StrainLimits(Model):
    """Limits how far the mesh's springs along and across its cells stretch and shrink, with a stated stiffness or
    exactly."""

    exact_to: ClassVar[float] = 1.0

    kind: Literal["strain-limits"] = "strain-limits"
    longest: float = Field(default=1.1, ge=1.0, le=1e6)
    """The largest length, as a multiple of the rest length."""
    shortest: float = Field(default=0.0, ge=0.0, le=1.0)
    """The smallest length, as a multiple of the rest length; 0 lets springs shrink freely."""
    stiffness: NonNegativeFloat | Literal["exact"]
    """What a spring resists with beyond its limits, in the unit of the `stretch` of springs by the same rule; or
    `exact`: none is beyond them, which `avbd` alone can do."""
    rule: Literal["continuum", "fixed", "liu2013"] = "continuum"
    """What the stiffness means when the mesh size changes, as for springs."""
    reference: PositiveInt | None = None
    """liu2013: the mesh size at which the stiffness holds."""

    @model_validator(mode="after")
    def _limits(self) -> "StrainLimits":
        if self.shortest == self.longest:
            raise ValueError("leave no length but one; use springs")
        return self

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The limits as one energy, none at all for a stiffness of zero, or as lengths that are exact."""
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
        """See `harness.scenes.effects.base.Effect`: springs stretch as no cloth does."""
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
