"""The assignment's external force: the same newtons on every vertex, whatever its mass."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from harness.base.model import Model, Vector
from harness.scenes.effects.base import Contribution, steady
from harness.scenes.mesh.base import Mesh


class ConstantForce(Model):
    """One force on every vertex. It is gravity only where every vertex weighs the same."""

    exact_to: ClassVar[float] = inf

    kind: Literal["constant-force"] = "constant-force"
    force: Vector
    """The force on each vertex [N]."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The force on every vertex."""
        return Contribution(forces=steady(np.tile(np.array(self.force), (len(mass), 1))))
