"""Air drag on vertices, in air at rest: f = -c v, or f = -c |v| v.

The linear one is an energy (see `solvers.energies.quadratic`): unconditionally stable, and in Q. The quadratic one acts
on the velocity before each step, by the exact solution of m dv/dt = -c |v| v over it: v <- m v / (m + c dt |v|),
unconditionally stable too. Wind on triangles drags as well, by their area and how they face the air.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat

from harness.base.model import Model
from harness.scenes.effects.base import Contribution, VelocityFilter
from harness.scenes.mesh.base import Mesh
from solvers.energies.quadratic import AirDrag as Energy
from solvers.problem import Positions


class AirDrag(Model):
    """Drag of the air on the vertices, spread as the mass is."""

    kind: Literal["air-drag"] = "air-drag"
    law: Literal["linear", "quadratic"] = "linear"
    """How the drag grows with the speed."""
    coefficient: NonNegativeFloat
    """The drag of the whole mesh at a speed of 1 m/s [N]: c [N s/m] if linear, half of the air's density times area
    times drag coefficient [kg/m] if quadratic."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The drag as an energy or as a filter; none at all for a coefficient of zero."""
        c = self.coefficient * mesh.shares
        if not c.any():
            return Contribution()
        if self.law == "linear":
            return Contribution(energies=(Energy.of_vertices(c),))
        return Contribution(filters=(_quadratic(mass, c * time_step),))


def _quadratic(mass: NDArray[np.float64], c: NDArray[np.float64]) -> VelocityFilter:
    """The filter for masses (n,) [kg] and c dt (n,) [kg s/m]."""

    def slow(v: Positions) -> Positions:
        drag = c * np.linalg.norm(v, axis=1)
        return v * np.divide(mass, mass + drag, out=np.ones_like(mass), where=drag > 0.0)[:, None]

    return slow
