"""Scenes with contact for the tests: sheets and bodies against one obstacle of each kind."""

from __future__ import annotations

from typing import Any

import numpy as np

from harness.scenes.bind import Scene
from harness.scenes.effects.base import Effect
from harness.scenes.effects.contact import Contact
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.springs import Springs
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.solids import Block
from harness.simulation.step import Step, prepare, simulate
from solvers.methods.newton import Newton
from solvers.problem import Positions, Solver, StopRule
from tests.scenes import scene

THICKNESS, DT = 0.01, 1 / 30
TILT = {"keys": [{"time": 0, "turn": 20}], "axis": (0, 0, 1)}
OBSTACLES: dict[str, dict[str, Any]] = {
    "plane": {"kind": "plane", "point": (0, -0.25, 0), "normal": (0.2, 1, 0.1)},
    "sphere": {"kind": "sphere", "center": (0.05, -0.6, 0), "radius": 0.3},
    "capsule": {"kind": "capsule", "ends": ((-0.7, -0.5, 0.1), (0.6, -0.4, 0)), "radius": 0.1},
    "plate": {"kind": "box", "low": (-0.8, -0.305, -0.8), "high": (0.8, -0.295, 0.8)},  # as thin as the cloth is thick
    "tilted box": {"kind": "box", "low": (-0.4, -0.7, -0.5), "high": (0.3, -0.35, 0.4), "motion": TILT},
}
"""Below a level sheet of a metre at y = 0."""

DESCENT = StopRule(40, 1e-9)


def contact(*obstacles: dict[str, Any], friction: float = 0.0, **more: Any) -> Contact:
    given = {"obstacles": obstacles, "thickness": THICKNESS, "friction": friction}
    return Contact.model_validate(given | more)


def sheet(
    *effects: Effect, size: int = 6, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), time_step: float = DT
) -> Scene:
    """A free level sheet that falls."""
    springs = Springs(stretch=300.0, shear=60.0)
    return scene(Grid(), springs, Gravity(), *effects, size=size, velocity=velocity, time_step=time_step)


def on_slope(slope: float, friction: float, *, time_step: float = 1 / 60) -> Scene:
    """A block of 10 kg on a slope of this tangent, whose frame is the scene's: gravity leans instead."""
    angle = np.arctan(slope)
    down = (9.81 * float(np.sin(angle)), -9.81 * float(np.cos(angle)), 0.0)
    ground = contact({"kind": "plane", "point": (0, -THICKNESS, 0)}, friction=friction)
    effects = Springs(stretch=2e4), Gravity(acceleration=down), ground
    return scene(Block(), *effects, size=3, mass=10.0, time_step=time_step)


def steps(made: Scene, frames: int, *, solver: Solver | None = None, stop: StopRule = DESCENT) -> list[Step]:
    return list(simulate(made, prepare(made, solver or Newton()), stop, first_guess="current", frames=frames))


def depth(made: Scene, p: Positions, time: float) -> float:
    """How much nearer than the thickness the nearest vertex is [m], negative where there is room."""
    (energy,) = (e for e in made.system.energies if type(e).__name__ == "Contact")
    obstacles = energy.obstacles  # pyright: ignore[reportAttributeAccessIssue]
    return max(THICKNESS - float(one.distance(p, time).min()) for one in obstacles)
