"""Dashpots: damping along the springs, f = -c n n'(v_i - v_j).

The coefficients c are scaled by a rule of `springbench.harness.scenes.spring_stiffness`.
"""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveInt
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.spring_stiffness import compute_spring_stiffness
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies import dashpot_energy


class DashpotsEffect(ConfigModel):
    """Damping of the rate of change of spring lengths, but not of rigid motion."""

    max_convergence_order: ClassVar[float] = inf
    is_dissipative: ClassVar[bool] = True

    kind: Literal["dashpots"] = "dashpots"
    scaling_rule: Literal["continuum", "area", "fixed", "liu2013"] = "continuum"
    """Scaling rule of the coefficients with the mesh size, as for springs."""
    stretch: NonNegativeFloat
    """Along the mesh's lines, in the unit of spring stiffness times seconds: `fixed` [N s/m] each."""
    shear: NonNegativeFloat | None = None
    """Across the mesh's cells, in the same unit; equal to `stretch` by default."""
    reference_size: PositiveInt | None = None
    """liu2013: the mesh size for which the coefficients above are given."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the dashpots as one energy; empty if no spring is damped.

        Args:
            mesh: mesh, along whose springs the dashpots act.
            mass, time_step: vertex masses (n,) [kg] and dt [s], which do not matter here.

        Raises:
            InputError: the scaling rule or its reference size does not fit the mesh.
        """
        shear = self.stretch if self.shear is None else self.shear
        c = compute_spring_stiffness(
            mesh,
            scaling_rule=self.scaling_rule,
            stretch=self.stretch,
            shear=shear,
            bend=0.0,
            reference_size=self.reference_size,
        )
        damped = np.flatnonzero(c)
        if not len(damped):
            return EffectContribution()
        return EffectContribution(
            energies=(dashpot_energy.Dashpots.from_rest_shape(mesh.rest_positions, mesh.springs[damped], c[damped]),)
        )
