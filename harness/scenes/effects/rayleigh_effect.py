"""Rayleigh damping (Rayleigh 1877): the damping matrix is C = a M + b K.

A mode of angular frequency w has the damping ratio (a/w + b w)/2. K is the stiffness of springs along their directions
at the start of the step, k nn', so that b does not damp rotations, and the bending matrix. Gas, strain limits and
attachments are not included.
"""

from collections.abc import Sequence
from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies.dashpot_energy import RayleighDashpots
from springbench.solvers.model.energies.quadratic_energy import Quadratic, RayleighDamping
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Energy, is_lagged


class RayleighEffect(ConfigModel):
    """Damping proportional to mass and to stiffness."""

    max_convergence_order: ClassVar[float] = inf
    is_dissipative: ClassVar[bool] = True

    kind: Literal["rayleigh"] = "rayleigh"
    mass_coefficient: NonNegativeFloat = 0.0
    """Mass coefficient a [1/s]: damps slow modes and rigid motion, v by exp(-a t)."""
    stiffness_coefficient: NonNegativeFloat = 0.0
    """Stiffness coefficient b [s]: damps fast modes."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the mass damping, and the damping derived from the other effects' energies.

        Args:
            mesh, time_step: mesh and dt [s], which do not matter here.
            mass: vertex masses (n,) [kg]; the damping [kg/s] is the mass coefficient times these.
        """
        damping = self.mass_coefficient * mass
        return EffectContribution(
            energies=(RayleighDamping.from_vertices(damping),) if damping.any() else (),
            derived_energies=(self._damp_energies,) if self.stiffness_coefficient else (),
        )

    def _damp_energies(self, energies: Sequence[Energy]) -> tuple[Energy, ...]:
        b = self.stiffness_coefficient
        springs = [energy for energy in energies if isinstance(energy, Springs)]
        constant = [e for e in energies if isinstance(e, Quadratic) and not is_lagged(e)]
        return (
            *(RayleighDashpots(s.edges, b * s.stiffness, s.rest_direction, np.zeros(len(s.edges))) for s in springs),
            *(RayleighDamping.from_operator(energy.A, b * energy.weight) for energy in constant),
        )
