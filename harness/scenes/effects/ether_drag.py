"""Ether drag (Liu et al. 2013, section 5): velocity decay before each step, v <- exp(-c dt) v.

This splits a step, at order 1. Integrators that evaluate forces at their stages treat it as the linear force
f = -c M v, and retain their order.
"""

from math import exp, inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat

from harness.base.model import Model
from harness.scenes.effects.base import Contribution
from harness.scenes.mesh.base import Mesh
from solvers.energies.quadratic import EtherDrag as Energy
from solvers.filters import Decay


class EtherDrag(Model):
    """Damping of the absolute velocity, independent of the time step."""

    exact_to: ClassVar[float] = inf
    damps: ClassVar[bool] = True
    plain: ClassVar[bool] = True

    kind: Literal["ether-drag"] = "ether-drag"
    rate: NonNegativeFloat
    """Decay rate c [1/s]; the paper's factor per step is exp(-c dt)."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return a filter that scales the velocity; empty for a zero rate."""
        if self.rate == 0.0:
            return Contribution()

        def drag() -> Contribution:
            return Contribution(energies=(Energy.of_vertices(self.rate * mass),))

        return Contribution(filters=(Decay(exp(-self.rate * time_step)),), continuous=(drag,))
