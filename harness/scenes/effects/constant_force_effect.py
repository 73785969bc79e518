"""The assignment's external force: equal for all vertices, whatever their mass."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.effects.effect_interface import EffectContribution, build_constant_force
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel, Vector3


class ConstantForceEffect(ConfigModel):
    """One force on every vertex.

    It equals gravity only if all vertices have the same mass.
    """

    max_convergence_order: ClassVar[float] = inf

    kind: Literal["constant-force"] = "constant-force"
    force: Vector3
    """Force on each vertex [N]."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the force on every vertex.

        Args:
            mesh, time_step: mesh and dt [s], which do not matter here.
            mass: vertex masses (n,) [kg], of which only the number matters.
        """
        return EffectContribution(forces=build_constant_force(np.tile(np.array(self.force), (len(mass), 1))))
