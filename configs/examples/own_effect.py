"""An effect of one's own, linear drag: f = -c v, by the velocity at the step's start. In a scene:

effects: [{kind: "./own_effect.py:LinearDrag", coefficient: 0.01}]
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat

import harness
from harness.base.model import Model
from harness.scenes.effects.base import Contribution
from harness.scenes.mesh.base import Mesh
from solvers.problem import Positions


class LinearDrag(Model):
    """Drag on every vertex, in proportion to its velocity."""

    kind: Literal["linear-drag"] = "linear-drag"
    coefficient: NonNegativeFloat
    """The drag coefficient c [N s/m]."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The drag as a force."""

        def drag(p: Positions, v: Positions, t: float) -> Positions:
            return -self.coefficient * v

        return Contribution(forces=(drag,))


if __name__ == "__main__":
    fall = {"mesh": {"kind": "chain"}, "mass": 1.0, "time_step": "1/30", "frames": 30, "default_size": 4}
    for drag in (0.0, 0.5):
        effects = [{"kind": "springs", "stretch": 300.0}, {"kind": "gravity"}, LinearDrag(coefficient=drag)]
        print(
            f"c = {drag}: {harness.Simulation(harness.make_scene(**fall, effects=effects)).steps(30)[-1, 0, 1]:.2f} m"
        )
