"""A step of several stages: the integrator defines them one after the other, a prepared solver solves each.

All forces, pins and energies are evaluated at the time of the stage. Lagged quantities - forces that depend on the
motion, directions of dashpots - are evaluated at the expected position of the stage first. The stage is then solved
again `order - 2` times with the quantities at the last solution; each solve gains one order of accuracy. Exact pins
have the exact velocity of their motion. Velocity filters and contact apply to the whole step and are of order 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import numpy as np

from harness.scenes.bind import Scene
from solvers.contact.friction_rounds import FrictionRounds, solve_with_friction
from solvers.integrators import End, Motion, Solved, Staged, Unknown
from solvers.problem import Positions, Prepared, Solution, Start, StepProblem, StopRule, Unsupported

Guess = Callable[[StepProblem], StepProblem]


class Done(NamedTuple):
    """Result of a step.

    Attributes:
      stages: problem and solution of each stage.
      end: end of the step.
      counts: number of iterations of each solve.
      friction: friction rounds of the worst stage.
    """

    stages: tuple[tuple[StepProblem, Solution], ...]
    end: End
    counts: tuple[int, ...]
    friction: FrictionRounds | None


class Stages:
    """The stages of one step of a scene, from a filtered motion at a time."""

    def __init__(self, scene: Scene, now: Motion, acceleration: Positions | None, time: float) -> None:
        """Start a step; `acceleration` (n, 3) [m/s^2] may be unknown (None)."""
        method = scene.integrator
        assert isinstance(method, Staged)
        self.scene, self.time, pins = scene, time, scene.system.pins
        self._exact, self._held = pins.exact, pins.vertices[pins.exact]
        self.now = self._carried(now, time)
        if acceleration is None and method.starts:
            acceleration = self._acceleration()
        self._unknowns = method.step(self.now, acceleration, scene.system.time_step)
        self._again = method.order - 2 if scene.forces or any(map(_lags, scene.system.energies)) else 0

    def done(self, prepared: Prepared, stop: StopRule, guess: Guess) -> Done:
        """Solve all stages of the step.

        Args:
          prepared: solver prepared for the scene's system.
          stop: stop rule of each solve.
          guess: function that sets the initial guess of a problem.
        """
        found, counts, unknown = list[tuple[StepProblem, Solution]](), list[int](), next(self._unknowns)
        friction = list[FrictionRounds]()
        while True:
            solved = solve_with_friction(prepared, guess(self.stated(unknown)), stop)
            counts += solved.counts
            for _ in range(self._again):
                x = solved.solution.positions
                solved = solve_with_friction(prepared, replace(self.stated(unknown, x), first_guess=x), stop)
                counts += solved.counts
            stated, solution = solved.problem, solved.solution
            found.append((stated, solution))
            friction += [solved.friction] if solved.friction else []
            try:
                unknown = self._unknowns.send(self._solved(stated, solution))
            except StopIteration as ended:
                worst = FrictionRounds(*map(max, zip(*friction, strict=True))) if friction else None
                return Done(tuple(found), self._ended(ended.value), tuple(counts), worst)

    def first(self) -> StepProblem:
        """Build the problem of the first stage."""
        return self.stated(next(self._unknowns))

    def stated(self, unknown: Unknown, expected: Positions | None = None) -> StepProblem:
        """Build a stage's problem, with the current positions as initial guess.

        Args:
          unknown: stage of the integrator.
          expected: expected solution (n, 3) [m]; extrapolated from the motion if omitted.
        """
        scene, system = self.scene, self.scene.system
        until = self.time + unknown.when * system.time_step
        held, moving = scene.pins_at(until), scene.pins_moving(until)
        unknown.origin[self._held] = held[self._exact] - moving[self._exact] / system.rate
        if expected is None:
            expected = unknown.target.copy()
            if unknown.acceleration is not None:
                expected += (system.time_step**2 / system.factor) * unknown.acceleration
            expected[system.pins.vertices] = held
        current = self.now.positions.copy()
        current[system.pins.vertices] = held
        begun = Start(
            *(self.now.positions, self.now.velocity, self.time, unknown.origin, system.rate, until),
            lagged=expected,
            acceleration=unknown.acceleration,
        )
        v = begun.velocity_at(expected) if scene.forces else expected
        force = reduce(lambda total, effect: total + effect(expected, v, until), scene.forces, scene.load)
        return StepProblem(system, unknown.target, force, held, current, current, begun)

    def _solved(self, stated: StepProblem, solution: Solution) -> Solved:
        system, x = self.scene.system, solution.positions
        acceleration = (system.factor / system.time_step**2) * (x - stated.target)
        acceleration[self._held] = 0.0
        return Solved(x, stated.start.velocity_at(x), acceleration)

    def _ended(self, end: End) -> End:
        """Set the positions and velocities of exact pins at the end of the step."""
        return end._replace(motion=self._carried(end.motion, self.time + self.scene.system.time_step))

    def _carried(self, motion: Motion, time: float) -> Motion:
        if not len(self._held):
            return motion
        p, v = (part.copy() for part in motion)
        p[self._held] = self.scene.pins_at(time)[self._exact]
        v[self._held] = self.scene.pins_moving(time)[self._exact]
        return Motion(p, v)

    def _acceleration(self) -> Positions:
        """Compute the initial acceleration (n, 3) [m/s^2], zero at exact pins; raises Unsupported."""
        (p, v), system = self.now, self.scene.system
        require_mass(self.scene)
        begun = Start(p, v, self.time, p - v / system.rate, system.rate, self.time)
        force = reduce(lambda total, effect: total + effect(p, v, self.time), self.scene.forces, self.scene.load)
        held = self.scene.pins_at(self.time)
        pull = StepProblem(system, p, force, held, p, p, begun).gradient(p)
        mass = system.mass[:, None]
        return np.divide(pull, -mass, out=np.zeros_like(p), where=mass > 0.0)


def require_mass(scene: Scene) -> None:
    """Raise Unsupported if an integrator needs the acceleration of a massless vertex."""
    method, system = scene.integrator, scene.system
    if isinstance(method, Staged) and method.starts and not system.mass[system.free].all():
        raise Unsupported(
            "the integrator starts from the acceleration, and vertices without mass have none; give them mass, or use "
            "one that does not need it: sdirk-2, sdirk-3, sdirk-4, implicit-euler, bdf2, midpoint"
        )


def _lags(energy: object) -> bool:
    """Return whether an energy depends on the expected solution of a stage."""
    return getattr(energy, "lagged", False)
