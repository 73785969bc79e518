"""Rayleigh damping (Rayleigh 1877): the damping matrix is C = a M + b K.

A mode of the angular frequency w is damped by the fraction (a/w + b w)/2 of critical damping. K is the stiffness of
springs along their directions at the step's start, k nn', so that b damps no rotation, and the matrix of bending. Gas,
strain limits and attachments have no share.
"""

from collections.abc import Sequence
from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat

from harness.base.model import Model
from harness.scenes.effects.base import Contribution
from harness.scenes.mesh.base import Mesh
from solvers.energies.dashpots import RayleighDashpots
from solvers.energies.quadratic import Quadratic, RayleighDamping
from solvers.energies.springs import Springs
from solvers.problem import Energy, is_lagged


class Rayleigh(Model):
    """Damping in proportion to masses and to stiffness."""

    exact_to: ClassVar[float] = inf
    damps: ClassVar[bool] = True

    kind: Literal["rayleigh"] = "rayleigh"
    mass: NonNegativeFloat = 0.0
    """The coefficient a [1/s] of the masses: slow modes and motion as a whole decay, v by exp(-a t)."""
    stiffness: NonNegativeFloat = 0.0
    """The coefficient b [s] of the stiffness: fast modes decay."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The damping of masses as an energy, that of the other effects' energies once they are known."""
        damping = self.mass * mass
        return Contribution(
            energies=(RayleighDamping.of_vertices(damping),) if damping.any() else (),
            derived=(self._of,) if self.stiffness else (),
        )

    def _of(self, energies: Sequence[Energy]) -> tuple[Energy, ...]:
        b = self.stiffness
        springs = [energy for energy in energies if isinstance(energy, Springs)]
        constant = [e for e in energies if isinstance(e, Quadratic) and not is_lagged(e)]
        return (
            *(RayleighDashpots(s.edges, b * s.stiffness, s.rest_direction, np.zeros(len(s.edges))) for s in springs),
            *(RayleighDamping.of(energy.A, b * energy.weight) for energy in constant),
        )
