"""Dashpots: damping along the mesh's springs, f = -c n n'(v_i - v_j), by a rule of `scenes.material` like springs."""

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
    """Damping of the speed at which springs change their length; motion of the mesh as a whole is not damped."""

    exact_to: ClassVar[float] = inf
    damps: ClassVar[bool] = True

    kind: Literal["dashpots"] = "dashpots"
    rule: Literal["continuum", "fixed", "liu2013"] = "continuum"
    """What the numbers below mean when the mesh size changes, as for springs."""
    stretch: NonNegativeFloat
    """Along the mesh's lines, in the unit of the stiffness of springs times seconds: `fixed` [N s/m] each."""
    shear: NonNegativeFloat | None = None
    """Across the mesh's cells, in the same unit; as `stretch` if left out."""
    reference: PositiveInt | None = None
    """liu2013: the mesh size at which the coefficients above hold."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The dashpots as one energy; none at all where no spring is damped."""
        shear = self.stretch if self.shear is None else self.shear
        c = spring_stiffness(
            mesh, rule=self.rule, stretch=self.stretch, shear=shear, bend=0.0, reference=self.reference
        )
        damped = np.flatnonzero(c)
        if not len(damped):
            return Contribution()
        return Contribution(energies=(dashpots.Dashpots.along(mesh.rest, mesh.springs[damped], c[damped]),))
