"""Ether drag (Liu et al. 2013, section 5): velocity decay before each step, v <- exp(-c dt) v.

This splits a step, at order 1. Integrators that evaluate forces at their stages treat it as the linear force
f = -c M v, and retain their order.
"""

from math import exp, inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies.quadratic_energy import EtherDrag as Energy
from springbench.solvers.model.velocity_filters import ExponentialDecay


class EtherDragEffect(ConfigModel):
    """Damping of the absolute velocity, independent of the time step."""

    max_convergence_order: ClassVar[float] = inf
    is_dissipative: ClassVar[bool] = True
    is_baseline_effect: ClassVar[bool] = True

    kind: Literal["ether-drag"] = "ether-drag"
    decay_rate: NonNegativeFloat
    """Decay rate c [1/s]; the paper's factor per step is exp(-c dt)."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return a filter that scales the velocity; empty for a zero rate.

        Args:
            mesh: mesh, which does not matter here.
            mass: vertex masses (n,) [kg], for the equivalent force.
            time_step: dt [s], over which the velocity decays.
        """
        if self.decay_rate == 0.0:
            return EffectContribution()

        def drag() -> EffectContribution:
            return EffectContribution(energies=(Energy.from_vertices(self.decay_rate * mass),))

        return EffectContribution(
            velocity_filters=(ExponentialDecay(exp(-self.decay_rate * time_step)),), continuous_forms=(drag,)
        )
