"""Gravity: f_i = m_i g."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.effects.effect_interface import EffectContribution, build_constant_force
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel, Vector3


class GravityEffect(ConfigModel):
    """Gravity on every vertex: its mass times one acceleration."""

    max_convergence_order: ClassVar[float] = inf
    is_baseline_effect: ClassVar[bool] = True

    kind: Literal["gravity"] = "gravity"
    acceleration: Vector3 = (0.0, -9.81, 0.0)
    """Acceleration of gravity [m/s^2]."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the force m g on every vertex; empty without acceleration or mass.

        Args:
            mesh, time_step: mesh and dt [s], which do not matter here.
            mass: vertex masses m (n,) [kg].
        """
        forces = build_constant_force(mass[:, None] * np.array(self.acceleration))
        return EffectContribution(forces=forces, exclusive_features=("gravity",) if forces else ())
