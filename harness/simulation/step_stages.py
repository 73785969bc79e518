"""A step in stages, which the integrator defines and a prepared solver solves in turn.

All forces, pins and energies are evaluated at the time of the stage. Lagged quantities, which are forces that
depend on the motion and directions of dashpots, are evaluated at the expected position of the stage first. The stage is
then solved again `order - 2` times with the quantities at the last solution; each solve gains one order of accuracy.
Exact pins have the exact velocity of their motion. Velocity filters and contact apply to the whole step and are of
order 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import numpy as np
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.contact.lagged_friction import FrictionConvergence, solve_with_friction
from springbench.solvers.model.integrators import Motion, Stage, StagedIntegrator, StageSolution, StepEnd
from springbench.solvers.model.step_problem import (
    Positions,
    PreparedSolver,
    Solution,
    StepProblem,
    StepStart,
    StopRule,
    Unsupported,
)

GuessFunction = Callable[[StepProblem], StepProblem]


class StepResult(NamedTuple):
    """Result of a step.

    Attributes:
        stages: problem and solution of each stage.
        end: end of the step.
        iteration_counts: number of iterations of each solve.
        friction_rounds: friction rounds of the worst stage.
    """

    stages: tuple[tuple[StepProblem, Solution], ...]
    end: StepEnd
    iteration_counts: tuple[int, ...]
    friction_rounds: FrictionConvergence | None


class StageSequence:
    """The stages of one step of a scene, which starts from a filtered motion."""

    def __init__(self, scene: Scene, now: Motion, acceleration: Positions | None, time: float) -> None:
        """Start a step.

        Args:
            scene: scene of the step, whose integrator has stages.
            now: motion at the start of the step, after the velocity filters.
            acceleration: acceleration (n, 3) [m/s^2] at the start; None if unknown, it is then computed where needed.
            time: time [s] at the start.
        """
        method = scene.integrator
        assert isinstance(method, StagedIntegrator)
        self.scene, self.time, pins = scene, time, scene.system.pins
        self._exact, self._pinned = pins.exact_mask, pins.vertices[pins.exact_mask]
        self.now = self._apply_pins(now, time)
        if acceleration is None and method.needs_start_acceleration:
            acceleration = self._compute_acceleration()
        self._unknowns = method.iterate_stages(self.now, acceleration, scene.system.time_step)
        self._again = method.order - 2 if scene.varying_forces or any(map(_is_lagged, scene.system.energies)) else 0

    def solve_stages(self, prepared: PreparedSolver, stop: StopRule, guess: GuessFunction) -> StepResult:
        """Solve all stages of the step.

        Args:
            prepared: solver prepared for the scene's system.
            stop: stop rule of each solve.
            guess: function that sets the initial guess of a problem.
        """
        found, counts, unknown = list[tuple[StepProblem, Solution]](), list[int](), next(self._unknowns)
        friction = list[FrictionConvergence]()
        while True:
            solved = solve_with_friction(prepared, guess(self.build_problem(unknown)), stop)
            counts += solved.iteration_counts
            for _ in range(self._again):
                x = solved.solution.positions
                solved = solve_with_friction(prepared, replace(self.build_problem(unknown, x), initial_guess=x), stop)
                counts += solved.iteration_counts
            stated, solution = solved.problem, solved.solution
            found.append((stated, solution))
            friction += [solved.convergence] if solved.convergence else []
            try:
                unknown = self._unknowns.send(self._finish_stage(stated, solution))
            except StopIteration as ended:
                worst = FrictionConvergence(*map(max, zip(*friction, strict=True))) if friction else None
                return StepResult(tuple(found), self._finish_step(ended.value), tuple(counts), worst)

    def build_first_problem(self) -> StepProblem:
        """Build the problem of the first stage."""
        return self.build_problem(next(self._unknowns))

    def build_problem(self, stage: Stage, expected: Positions | None = None) -> StepProblem:
        """Build a stage's problem, with the current positions as initial guess.

        Args:
            stage: stage of the integrator.
            expected: expected solution (n, 3) [m]; extrapolated from the motion if omitted.
        """
        scene, system = self.scene, self.scene.system
        until = self.time + stage.stage_fraction * system.time_step
        pin_targets, moving = scene.compute_pin_targets(until), scene.compute_pin_velocities(until)
        stage.velocity_origin[self._pinned] = pin_targets[self._exact] - moving[self._exact] / system.velocity_rate
        if expected is None:
            expected = stage.inertial_target.copy()
            if stage.predicted_acceleration is not None:
                expected += (system.time_step**2 / system.inertia_factor) * stage.predicted_acceleration
            expected[system.pins.vertices] = pin_targets
        current = self.now.positions.copy()
        current[system.pins.vertices] = pin_targets
        begun = StepStart(
            *(self.now.positions, self.now.velocity, self.time, stage.velocity_origin, system.velocity_rate, until),
            lag_override=expected,
            predicted_acceleration=stage.predicted_acceleration,
        )
        v = begun.velocity_at(expected) if scene.varying_forces else expected
        force = reduce(
            lambda total, effect: total + effect(expected, v, until), scene.varying_forces, scene.constant_force
        )
        return StepProblem(system, stage.inertial_target, force, pin_targets, current, current, begun)

    def _finish_stage(self, step_problem: StepProblem, solution: Solution) -> StageSolution:
        system, x = self.scene.system, solution.positions
        acceleration = (system.inertia_factor / system.time_step**2) * (x - step_problem.inertial_target)
        acceleration[self._pinned] = 0.0
        return StageSolution(x, step_problem.step_start.velocity_at(x), acceleration)

    def _finish_step(self, end: StepEnd) -> StepEnd:
        """Set the positions and velocities of exact pins at the end of the step."""
        return end._replace(motion=self._apply_pins(end.motion, self.time + self.scene.system.time_step))

    def _apply_pins(self, motion: Motion, time: float) -> Motion:
        if not len(self._pinned):
            return motion
        p, v = (part.copy() for part in motion)
        p[self._pinned] = self.scene.compute_pin_targets(time)[self._exact]
        v[self._pinned] = self.scene.compute_pin_velocities(time)[self._exact]
        return Motion(p, v)

    def build_start_problem(self) -> StepProblem:
        """Build the problem of the start, whose gradient there has no inertia term [N]."""
        (p, v), system = self.now, self.scene.system
        begun = StepStart(p, v, self.time, p - v / system.velocity_rate, system.velocity_rate, self.time)
        force = reduce(
            lambda total, effect: total + effect(p, v, self.time), self.scene.varying_forces, self.scene.constant_force
        )
        pin_targets = self.scene.compute_pin_targets(self.time)
        return StepProblem(system, p, force, pin_targets, p, p, begun)

    def _compute_acceleration(self) -> Positions:
        """Compute the initial acceleration (n, 3) [m/s^2], zero at exact pins; raises Unsupported."""
        require_masses(self.scene)
        pull = self.build_start_problem().gradient(self.now.positions)
        mass = self.scene.system.mass[:, None]
        return np.divide(pull, -mass, out=np.zeros_like(pull), where=mass > 0.0)


def require_masses(scene: Scene) -> None:
    """Raise Unsupported if an integrator needs the acceleration of a massless vertex."""
    method, system = scene.integrator, scene.system
    if (
        isinstance(method, StagedIntegrator)
        and method.needs_start_acceleration
        and not system.mass[system.free_vertices].all()
    ):
        raise Unsupported(
            "the integrator starts from the acceleration, and vertices without mass have none; give them mass, or use "
            "one that does not need it: sdirk-2, sdirk-3, sdirk-4, implicit-euler, bdf2, midpoint"
        )


def _is_lagged(energy: object) -> bool:
    """Return whether an energy depends on the expected solution of a stage."""
    return getattr(energy, "is_lag_extrapolated", False)
