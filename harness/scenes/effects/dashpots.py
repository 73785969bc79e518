"""Dashpots: damping along the springs, f = -c n n'(v_i - v_j), scaled by a rule of `harness.scenes.material`."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveInt

from harness.base.model import Model
from harness.scenes.effects.base import Contribution
from harness.scenes.material import spring_stiffness
from harness.scenes.mesh.base import Mesh
from solvers.energies import dashpots


class Dashpots(Model):
    """Damping of the rate of change of spring lengths; rigid motion of the mesh is not damped."""

    exact_to: ClassVar[float] = inf
    damps: ClassVar[bool] = True

    kind: Literal["dashpots"] = "dashpots"
    rule: Literal["continuum", "fixed", "liu2013"] = "continuum"
    """Scaling rule of the coefficients with the mesh size, as for springs."""
    stretch: NonNegativeFloat
    """Along the mesh's lines, in the unit of spring stiffness times seconds: `fixed` [N s/m] each."""
    shear: NonNegativeFloat | None = None
    """Across the mesh's cells, in the same unit; equal to `stretch` by default."""
    reference: PositiveInt | None = None
    """liu2013: the mesh size for which the coefficients above are given."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the dashpots as one energy; empty if no spring is damped."""
        shear = self.stretch if self.shear is None else self.shear
        c = spring_stiffness(
            mesh, rule=self.rule, stretch=self.stretch, shear=shear, bend=0.0, reference=self.reference
        )
        damped = np.flatnonzero(c)
        if not len(damped):
            return Contribution()
        return Contribution(energies=(dashpots.Dashpots.along(mesh.rest, mesh.springs[damped], c[damped]),))
