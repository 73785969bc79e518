"""Gravity: f_i = m_i g."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from harness.base.model import Model, Vector
from harness.scenes.effects.base import Contribution, steady
from harness.scenes.mesh.base import Mesh


class Gravity(Model):
    """Gravity on every vertex: its mass times one acceleration."""

    exact_to: ClassVar[float] = inf
    plain: ClassVar[bool] = True

    kind: Literal["gravity"] = "gravity"
    acceleration: Vector = (0.0, -9.81, 0.0)
    """Acceleration of gravity [m/s^2]."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the force m g on every vertex."""
        forces = steady(mass[:, None] * np.array(self.acceleration))
        return Contribution(forces=forces, once=("gravity",) if forces else ())
