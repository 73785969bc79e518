"""Air drag on vertices in still air: f = -c v, or f = -c |v| v.

Linear drag is an energy (`springbench.solvers.model.energies.quadratic_energy`): it is unconditionally stable, and
part of Q. Quadratic drag acts on the velocity before each step, by the exact solution of m dv/dt = -c |v| v:
v <- m v / (m + c dt |v|), which is unconditionally stable too, and of order 1. Integrators that evaluate forces at
their stages treat it as a force, limited to what stops a vertex in one step, and retain their order. Wind on triangles
includes drag as well, by their area and their angle to the flow.
"""

from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat
from springbench.harness.scenes.effects.effect_interface import EffectContribution, ObservedMotion
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies.quadratic_energy import AirDrag as Energy
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.model.velocity_filters import QuadraticDrag

MIN_ENERGY_FRACTION = 0.1
"""Ratio of kinetic energy to its maximum: a larger average over the last quarter means that the scene does not rest."""


class AirDragEffect(ConfigModel):
    """Air drag on the vertices, distributed like the mass."""

    max_convergence_order: ClassVar[float] = inf
    is_dissipative: ClassVar[bool] = True

    kind: Literal["air-drag"] = "air-drag"
    drag_law: Literal["linear", "quadratic"] = "linear"
    """Growth of the drag with the speed: linear or quadratic."""
    coefficient: NonNegativeFloat
    """Drag of the whole mesh at a speed of 1 m/s [N]: c [N s/m] if linear; if quadratic, half of the air density times
    area times drag coefficient [kg/m]."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the drag as an energy or a filter; empty for a zero coefficient.

        Args:
            mesh: mesh, whose mass fractions distribute the coefficient over the vertices.
            mass: vertex masses (n,) [kg], for quadratic drag.
            time_step: dt [s], for quadratic drag.
        """
        c = self.coefficient * mesh.mass_fractions
        if not c.any():
            return EffectContribution()
        if self.drag_law == "linear":
            return EffectContribution(energies=(Energy.from_vertices(c),))

        def force() -> EffectContribution:
            return EffectContribution(forces=(QuadraticDragForce(c, mass / time_step),))

        return EffectContribution(velocity_filters=(QuadraticDrag(mass, c * time_step),), continuous_forms=(force,))

    @classmethod
    def find_evidence(cls, observed: ObservedMotion) -> str:
        """Return evidence for drag: motion without driving forces that does not end."""
        mass, v = observed.mass, observed.velocities
        if observed.is_driven or observed.is_damped or len(v) < 8:
            return ""
        most = float(_compute_kinetic_energy(mass, v).max())
        if not observed.has_pins:  # a body without supports may fly, fall or slide as a whole
            v = v - np.einsum("i,fix->fx", mass / mass.sum(), v)[:, None]
        late = float(_compute_kinetic_energy(mass, v[-len(v) // 4 :]).mean())
        if not most or late <= MIN_ENERGY_FRACTION * most:
            return ""
        return (
            "nothing drives the motion or damps it; in the last quarter of "
            f"{observed.compute_frame_time(len(v) - 1):.2f} s it still "
            f"has {100 * late / most:.0f} % of its largest kinetic energy, and only the time integrator's own "
            "damping, which depends on the time step, would ever bring it to rest"
        )


@dataclass(frozen=True, eq=False)
class QuadraticDragForce:
    """Force of quadratic drag at the stages of an integrator.

    Attributes:
        c: coefficients (n,) [kg/m].
        limit: largest ratio of force to velocity (n,) [kg/s].
    """

    c: NDArray[np.float64]
    limit: NDArray[np.float64]

    is_dissipative: ClassVar[bool] = True

    def __call__(self, p: Positions, v: Positions, t: float) -> Positions:
        """Return the force (n, 3) [N].

        Args:
            p, t: positions (n, 3) [m] and time [s], on which the force does not depend.
            v: velocities (n, 3) [m/s].
        """
        return -np.minimum(self.c * np.linalg.norm(v, axis=1), self.limit)[:, None] * v


def _compute_kinetic_energy(mass: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the kinetic energy of each frame [J]."""
    return 0.5 * np.einsum("i,fix,fix->f", mass, v, v)
