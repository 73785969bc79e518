"""Air drag on vertices, in air at rest: f = -c v, or f = -c |v| v.

The linear one is an energy (see `solvers.energies.quadratic`): unconditionally stable, and in Q. The quadratic one acts
on the velocity before each step, by the exact solution of m dv/dt = -c |v| v over it: v <- m v / (m + c dt |v|),
unconditionally stable too, and of order 1. Integrators that take forces at their unknowns have it as a force, up to
what stops a vertex in one step, and keep their order. Wind on triangles drags as well, by their area and how they face
the air.
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
"""Of the largest kinetic energy: more than this, on average over the last quarter, and the scene does not rest."""


class AirDrag(Model):
    """Drag of the air on the vertices, spread as the mass is."""

    exact_to: ClassVar[float] = inf
    damps: ClassVar[bool] = True

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

        def force() -> Contribution:
            return Contribution(forces=(_force(c, mass / time_step),))

        return Contribution(filters=(QuadraticDrag(mass, c * time_step),), continuous=(force,))

    @classmethod
    def called_for(cls, seen: Seen) -> str:
        """See `harness.scenes.effects.base.Effect`: nothing drives the motion, and it does not end."""
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
    """The force for c (n,) [kg/m], at most `limit` (n,) [kg/s] times the velocity."""

    def drag(p: Positions, v: Positions, t: float) -> Positions:
        return -np.minimum(c * np.linalg.norm(v, axis=1), limit)[:, None] * v

    return drag


def _kinetic(mass: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """The kinetic energy in each frame [J]."""
    return 0.5 * np.einsum("i,fix,fix->f", mass, v, v)
