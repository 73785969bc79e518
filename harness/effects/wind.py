"""Wind as a force: a constant one, or the field of the University of Toronto assignment.

The assignment's, with t the simulated time [s] at the step's start, b the length of the diagonal of the rest
bounding box and phi = x / b + t at each vertex's current x:

    f = (3 + 1.5 (1 + cos 5 phi),  1 + cos(0.3 + phi),  sin phi)     newtons a vertex

(the assignment adds its gravity of -9.8 newtons to the second component; here that is an effect of its own).
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from harness.effects.base import Contribution, Force, steady
from harness.mesh.base import Mesh
from harness.model import Model, Vector
from solvers.problem import Positions


class Wind(Model):
    """A force field that blows on the vertices."""

    kind: Literal["wind"] = "wind"
    field: Literal["assignment", "constant"] = "constant"
    """`constant`: one force everywhere; `assignment`: the assignment's gusts, which travel along x."""
    force: Vector = (1.0, 0.0, 0.0)
    """The constant field's force [N]."""
    per: Literal["vertex", "share"] = "share"
    """`vertex`: the force acts on every vertex, as the assignment has it, so a finer mesh feels more of it;
    `share`: it is the total, spread over the vertices as the mass is, the same at every mesh size."""
    strength: float = 1.0
    """A factor on the field."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The field as one force; none at all for a strength of zero."""
        weight = self.strength * (np.ones(len(mass)) if self.per == "vertex" else mesh.shares)[:, None]
        return Contribution(forces=_FIELDS[self.field](self, weight, mesh.size or 1.0) if self.strength else ())


def _constant(wind: Wind, weight: NDArray[np.float64], diagonal: float) -> tuple[Force, ...]:
    return steady(weight * np.array(wind.force))


def _assignment(wind: Wind, weight: NDArray[np.float64], diagonal: float) -> tuple[Force, ...]:
    def force(p: Positions, v: Positions, t: float) -> Positions:
        phi = p[:, 0] / diagonal + t
        f = np.stack([3.0 + 1.5 * (1.0 + np.cos(5.0 * phi)), 1.0 + np.cos(0.3 + phi), np.sin(phi)], axis=1)
        return weight * f

    return (force,)


_FIELDS = {"constant": _constant, "assignment": _assignment}
