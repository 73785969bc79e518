"""Estimate the time-stepping error by halving the step, where error control is impossible.

    |p_h(T) - p_(h/2)(T)| / |p_(h/2)(T) - p(0)|,    Frobenius norms over the free vertices

with implicit Euler and converged steps. Its order is 1, as that of all methods is where contact starts and ends.
Therefore the remaining error is about as large as this change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from time import perf_counter

import numpy as np
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, StopRule

_CONVERGED_STOP_RULE = StopRule(50, 1e-6)


@dataclass(frozen=True, slots=True)
class StepDoublingEstimate:
    """Step-doubling estimate.

    Attributes:
        time_step: last step size that was halved [s].
        relative_change: change of the end positions by that, relative to the displacement; None if time ran out first.
    """

    time_step: float
    relative_change: float | None

    def __str__(self) -> str:
        if self.relative_change is None:
            return f"steps of {self.time_step:.3g} s alone take longer than is spent on saying what can be had"
        return (
            f"what can be had: steps of {self.time_step:.3g} s end within "
            f"{self.relative_change:.1g} of where steps half as long do"
        )


def estimate_by_step_doubling(
    build_scene: Callable[[float, str], Scene], t_end: float, frames: int, *, time_budget: float
) -> StepDoublingEstimate:
    """Halve the step size within a time budget, and return the last change.

    Args:
        build_scene: returns the scene for a time step [s] and an integrator by name.
        t_end: simulated time [s].
        frames: number of steps to start with.
        time_budget: wall time [s].
    """
    _simulate_to_end(build_scene(t_end / frames, "implicit-euler"), 1, inf)  # compiles
    began, before, found = perf_counter(), None, StepDoublingEstimate(t_end / frames, None)
    while True:
        scene = build_scene(t_end / frames, "implicit-euler")
        end = _simulate_to_end(scene, frames, began + time_budget)
        if end is None:
            return found
        if before is not None:
            free, first = scene.system.free_vertices, build_initial_state(scene).motion.positions
            away, moved = (float(np.linalg.norm((end - other)[free])) for other in (before, first))
            found = StepDoublingEstimate(2.0 * t_end / frames, away / moved if moved else 0.0)
        before, frames = end, 2 * frames


def _simulate_to_end(scene: Scene, frames: int, deadline: float) -> Positions | None:
    """Return the positions at the end of the motion; None after the deadline."""
    for step in simulate_scene(
        scene, prepare(scene, NewtonSolver()), _CONVERGED_STOP_RULE, initial_guess="previous", frames=frames
    ):
        if perf_counter() > deadline:
            return None
        if step.index == frames:
            return step.positions
    return None
