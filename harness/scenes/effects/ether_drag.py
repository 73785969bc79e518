"""Ether drag (Liu et al. 2013, section 5): before each step the velocity decays, v <- exp(-c dt) v.

So a step is split, at order 1. Integrators that take forces at their unknowns have it as what it is, a linear force
f = -c M v, and keep their order.
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
    """Damping of the velocity relative to space at rest, the same at any time step."""

    exact_to: ClassVar[float] = inf
    damps: ClassVar[bool] = True
    plain: ClassVar[bool] = True

    kind: Literal["ether-drag"] = "ether-drag"
    rate: NonNegativeFloat
    """The rate of decay c [1/s]; the paper's factor a step is exp(-c dt)."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """A filter that scales the velocity; none at all for a rate of zero."""
        if self.rate == 0.0:
            return Contribution()

        def drag() -> Contribution:
            return Contribution(energies=(Energy.of_vertices(self.rate * mass),))

        return Contribution(filters=(Decay(exp(-self.rate * time_step)),), continuous=(drag,))
