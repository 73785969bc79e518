"""An effect of one's own, linear drag: f = -c v, by the velocity at the step's start. In a scene:

effects: [{kind: "./own_effect.py:LinearDrag", coefficient: 0.01}]
"""

from typing import Literal

import numpy as np
import springbench
from numpy.typing import NDArray
from pydantic import NonNegativeFloat
from springbench import ConfigModel, EffectContribution, Mesh


class LinearDrag(ConfigModel):
    """Drag on every vertex, in proportion to its velocity."""

    kind: Literal["linear-drag"] = "linear-drag"
    coefficient: NonNegativeFloat
    """The drag coefficient c [N s/m]."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """The drag as a force, of positions p [m], velocities v [m/s] and time t [s]."""
        return EffectContribution(forces=(lambda p, v, t: -self.coefficient * v,))


if __name__ == "__main__":
    fall = {"mesh": {"kind": "chain"}, "mass": 1.0, "time_step": "1/30", "frames": 30, "default_size": 4}
    springs, gravity = {"kind": "springs", "stretch": 300.0}, {"kind": "gravity"}
    for c in (0.0, 0.5):
        scene = springbench.make_scene(**fall, effects=[springs, gravity, LinearDrag(coefficient=c)])
        print(f"c = {c}: {springbench.Simulation(scene).run_steps(30)[-1, 0, 1]:.2f} m")
