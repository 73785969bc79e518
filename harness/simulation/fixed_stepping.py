"""Time stepping by an integrator with a fixed step size and automatic tolerance (`rtol: auto`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, inf
from time import perf_counter, thread_time
from typing import ClassVar

from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.adaptive_stepping import (
    MAX_SOLVE_ITERATIONS,
    StepObserver,
    Stepper,
    Trajectory,
    build_budget_error,
    share_frame_seconds,
    stack_motions,
)
from springbench.harness.simulation.auto_tolerance import AutoTolerance
from springbench.harness.simulation.time_loop import build_initial_state, prepare, simulate_scene
from springbench.solvers.model.step_problem import Solver


@dataclass(frozen=True, eq=False)
class FixedImplicitStepper(Stepper):
    """Stepping by an integrator with a fixed step size.

    Attributes:
        build_scene: builds the scene with a given step size [s].
        solver: solver of the steps.
        t_end: end time [s].
        frames: number of frames up to the end time; the setting is the number of steps of each, at least one.
    """

    build_scene: Callable[[float], Scene]
    solver: Solver
    t_end: float
    frames: int

    has_fixed_step: ClassVar[bool] = True

    @property
    def order(self) -> int:
        """The order of convergence of the integrator."""
        return self.build_scene(self.t_end / self.frames).integrator.order

    def integrate_motion(
        self, setting: float, *, cpu_limit: float = inf, observe: StepObserver | None = None
    ) -> Trajectory:
        """Integrate the motion up to the end time.

        Args:
            setting: number of steps of each frame, rounded up.
            cpu_limit: limit on the processor time [s] of this thread.
            observe: called after each step.

        Raises:
            Unsupported: the solver or the automatic tolerance does not support the scene.
            TimeBudgetExceeded: the limit is exceeded.
        """
        cpu, parts = thread_time(), ceil(setting)
        scene = self.build_scene(self.t_end / (self.frames * parts))
        ready, seen, reached, iterations = (
            prepare(scene, self.solver),
            [build_initial_state(scene).motion],
            list[float](),
            0,
        )
        began, steps = perf_counter(), self.frames * parts
        for step in simulate_scene(
            scene, ready, AutoTolerance(MAX_SOLVE_ITERATIONS), initial_guess="extrapolated", frames=steps
        ):
            iterations += step.num_iterations
            if observe:
                observe(scene, step, scene.compute_time(step.index))
            if step.index % parts == 0:
                seen.append(step.state.motion)
                reached.append(perf_counter() - began)
            if thread_time() - cpu > cpu_limit:
                raise build_budget_error(cpu_limit, scene.compute_time(step.index))
        h = scene.system.time_step
        shared, processor = share_frame_seconds(reached), thread_time() - cpu
        return Trajectory(*stack_motions(seen), steps, 0, 1, iterations, (h, h), reached[-1], shared, processor)
