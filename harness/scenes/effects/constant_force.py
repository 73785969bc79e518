"""The assignment's external force: equal for all vertices, whatever their mass."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from harness.base.model import Model, Vector
from harness.scenes.effects.base import Contribution, steady
from harness.scenes.mesh.base import Mesh


class ConstantForce(Model):
    """One force on every vertex. It equals gravity only if all vertices have the same mass."""

    exact_to: ClassVar[float] = inf

    kind: Literal["constant-force"] = "constant-force"
    force: Vector
    """Force on each vertex [N]."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the force on every vertex."""
        return Contribution(forces=steady(np.tile(np.array(self.force), (len(mass), 1))))
