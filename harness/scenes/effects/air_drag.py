"""Air drag on vertices in still air: f = -c v, or f = -c |v| v.

Linear drag is an energy (see `solvers.energies.quadratic`): unconditionally stable, and part of Q.
Quadratic drag acts on the velocity before each step, by the exact solution of m dv/dt = -c |v| v:
v <- m v / (m + c dt |v|), which is unconditionally stable too, and of order 1. Integrators that evaluate forces at
their stages treat it as a force, limited to what stops a vertex in one step, and retain their order. Wind on triangles
includes drag as well, by their area and their angle to the flow.
"""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat

from harness.base.model import Model
from harness.scenes.effects.base import Contribution, Force, Seen
from harness.scenes.mesh.base import Mesh
from solvers.energies.quadratic import AirDrag as Energy
from solvers.filters import QuadraticDrag
from solvers.problem import Positions

ALIVE = 0.1
"""Ratio of kinetic energy to its maximum: a larger average over the last quarter means that the scene does not rest."""


class AirDrag(Model):
    """Air drag on the vertices, distributed like the mass."""

    exact_to: ClassVar[float] = inf
    damps: ClassVar[bool] = True

    kind: Literal["air-drag"] = "air-drag"
    law: Literal["linear", "quadratic"] = "linear"
    """Growth of the drag with the speed: linear or quadratic."""
    coefficient: NonNegativeFloat
    """Drag of the whole mesh at a speed of 1 m/s [N]: c [N s/m] if linear; if quadratic, half of the air density times
    area times drag coefficient [kg/m]."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """Return the drag as an energy or a filter; empty for a zero coefficient."""
        c = self.coefficient * mesh.shares
        if not c.any():
            return Contribution()
        if self.law == "linear":
            return Contribution(energies=(Energy.of_vertices(c),))

        def force() -> Contribution:
            return Contribution(forces=(_force(c, mass / time_step),))

        return Contribution(filters=(QuadraticDrag(mass, c * time_step),), continuous=(force,))

    @classmethod
    def called_for(cls, seen: Seen) -> str:
        """Return evidence for drag: motion without driving forces that does not end."""
        mass, v = seen.mass, seen.velocities
        if seen.driven or seen.damped or len(v) < 8:
            return ""
        most = float(_kinetic(mass, v).max())
        if not seen.held:  # what nothing holds may fly, fall or slide on as a whole
            v = v - np.einsum("i,fix->fx", mass / mass.sum(), v)[:, None]
        late = float(_kinetic(mass, v[-len(v) // 4 :]).mean())
        if not most or late <= ALIVE * most:
            return ""
        return (
            f"nothing drives the motion or damps it; in the last quarter of {seen.time(len(v) - 1):.2f} s it still "
            f"has {100 * late / most:.0f} % of its largest kinetic energy, and only the time integrator's own "
            "damping, which depends on the time step, would ever bring it to rest"
        )


def _force(c: NDArray[np.float64], limit: NDArray[np.float64]) -> Force:
    """Build the force for c (n,) [kg/m], limited to `limit` (n,) [kg/s] times the velocity."""

    def drag(p: Positions, v: Positions, t: float) -> Positions:
        return -np.minimum(c * np.linalg.norm(v, axis=1), limit)[:, None] * v

    return drag


def _kinetic(mass: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the kinetic energy of each frame [J]."""
    return 0.5 * np.einsum("i,fix,fix->f", mass, v, v)
