"""Scenes with one effect each, in motion, for the tests of effects and of the solvers that take them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from harness.scenes.bind import Scene
from harness.scenes.effects.air_drag import AirDrag
from harness.scenes.effects.attachments import Attachments
from harness.scenes.effects.base import Effect
from harness.scenes.effects.bending import Bending
from harness.scenes.effects.contact import Contact
from harness.scenes.effects.dashpots import Dashpots
from harness.scenes.effects.gas import Gas
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.rayleigh import Rayleigh
from harness.scenes.effects.springs import Springs
from harness.scenes.effects.strain_limits import StrainLimits
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.surfaces import Balloon
from harness.scenes.motion import Key, KeyedMotion
from harness.simulation.step import State, problem
from solvers import integrators
from solvers.methods.newton import Newton
from solvers.problem import Positions, Solver, StepProblem, StopRule
from tests.scenes import scene

MOVES = KeyedMotion(keys=(Key(time=0.0), Key(time=1.0, offset=(0.1, 0.2, 0.0), turn=90.0)))

BEND = Bending(stiffness=0.5)
LIMITS = StrainLimits(longest=1.02, shortest=0.98, stiffness=500.0)
DASHPOTS = Dashpots(stretch=2.0)
RAYLEIGH = Rayleigh(mass=0.5, stiffness=0.02)
DRAG = AirDrag(coefficient=2.0)
ATTACHED = Attachments(at=("bottom",), stiffness=50.0, motion=MOVES)
GAS = Gas(pressure=200.0)
FLOOR = Contact.model_validate({"obstacles": [{"kind": "plane", "point": (0, -0.02, 0)}], "friction": 0.3})
"""So little below the level cloth that in `stepped` some of its vertices arrive."""


def cloth(*effects: Effect) -> Scene:
    pins = Pins(at=("top_corners",), motion=MOVES)
    return scene(Grid(), Springs(stretch=300.0, shear=60.0), Gravity(), pins, *effects, size=6)


def balloon(*effects: Effect) -> Scene:
    return scene(Balloon(), Springs(stretch=100.0), Gravity(), Pins(at=("pole_top",)), *effects, size=2)


SCENES: dict[str, Callable[[], Scene]] = {
    "bending": lambda: cloth(BEND),
    "strain limits": lambda: cloth(LIMITS),
    "dashpots": lambda: cloth(DASHPOTS),
    "rayleigh": lambda: cloth(RAYLEIGH, BEND),
    "air drag": lambda: cloth(DRAG),
    "attachments": lambda: cloth(ATTACHED),
    "all that are projective": lambda: cloth(BEND, LIMITS, DASHPOTS, RAYLEIGH, DRAG, ATTACHED),
    "contact": lambda: cloth(FLOOR),
    "gas": lambda: balloon(GAS),
    "gas and all others": lambda: balloon(GAS, BEND, LIMITS, DASHPOTS, RAYLEIGH, DRAG),
}
"""Scenes by what is in them besides springs, gravity and moving pins."""


def stepped(made: Scene, integrator: str = "implicit-euler") -> StepProblem:
    """A step of the scene from positions that are a little stretched and disturbed, and from velocities."""
    rng, rest = np.random.default_rng(0), made.mesh.rest
    now, before = (
        integrators.Motion(stretch * rest + 0.01 * rng.normal(size=rest.shape), 0.3 * rng.normal(size=rest.shape))
        for stretch in (1.05, 1.04)
    )
    return problem(integrated(made, integrator), State(now, before, 3), "current")


def integrated(made: Scene, name: str) -> Scene:
    """The same scene with an integrator by name."""
    method = integrators.INTEGRATORS[name]
    return replace(made, integrator=method, system=replace(made.system, factor=method.factor))


def at_rest(made: Scene, solver: Solver | None = None, *, iterations: int = 200, tolerance: float = 1e-9) -> Positions:
    """Where a scene comes to rest, (n, 3) [m]: one step so long that inertia (M/dt^2) and damping weigh nothing."""
    long = replace(made, system=replace(made.system, time_step=1e3))
    stated = problem(long, State(integrators.Motion(made.mesh.rest, np.zeros_like(made.mesh.rest)), None, 0), "current")
    solution = (solver or Newton()).prepare(long.system).solve(stated, StopRule(iterations, tolerance))
    assert solution.stopped != "iterations", "the static solve has not converged"
    return solution.positions
