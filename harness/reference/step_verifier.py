"""Verifier of steps: stationarity, minimality of the solution, and distance from a reference run.

Stationarity is measured by `springbench.harness.reference.reference_evaluator` with a matrix that it assembles and
factorises itself, independently of the solver. A stationary point is a minimum where the smallest eigenvalue of its
Hessian is positive beyond round-off (`springbench.harness.reference.hessian_curvature`). The motion is compared with a
reference run, each step of which was solved to round-off. The comparison is by vertex: a distance is relative to the
size of the vertex's connected component. A step with exact lengths is evaluated by its Lagrangian
(`springbench.harness.reference.exact_lengths`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.harness.reference.certified_minimum import UNLIMITED_STOP_RULE
from springbench.harness.reference.exact_lengths import PENALTY_FACTOR, StationarityEvaluator
from springbench.harness.reference.hessian_curvature import HessianCurvature, compute_curvature
from springbench.harness.reference.reference_evaluator import StationarityReading, measure_component_sizes
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import SimulationStep, prepare, simulate_scene
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem

MAX_REFERENCE_STATIONARITY = 1e-6
"""Maximum stationarity beyond round-off at the end of a step of the reference run."""


class StepVerifier:
    """Computes the accuracy columns of each step of one run."""

    def __init__(self, scene: Scene, reference: NDArray[np.float64] | None, *, is_minimiser: bool) -> None:
        """Create a verifier for a scene.

        Args:
            scene: scene of the run.
            reference: positions (frames, n, 3) [m], nan from the frame on in which there is none; None without a
                reference.
            is_minimiser: whether the solver minimises the step's objective.
        """
        self._stationarity = StationarityEvaluator()
        self._sizes = measure_component_sizes(scene.system, scene.mesh.rest_positions)
        self._reference, self._minimises = reference, is_minimiser

    def __call__(self, step: SimulationStep) -> dict[str, Any]:
        """Compute the accuracy columns of a step's row.

        They are `stationarity`, `stationarity_roundoff_bound`, `stationarity_above_roundoff`, `is_local_minimum` and
        `is_degenerate` (absent for a method that does not minimise), and `reference_distance`. In a step of several
        stages all are evaluated, and the first three columns are those of the worst.
        """
        row: dict[str, Any] = {}
        if self._reference is not None:
            away = np.linalg.norm(step.positions - self._reference[step.index - 1], axis=1) / self._sizes
            row["reference_distance"] = float(away.max()) if np.isfinite(away).all() else None
        if self._minimises:
            readings = [self.measure_stationarity(stated, solution.positions) for stated, solution in step.stages]
            row["stationarity"], row["stationarity_roundoff_bound"], row["stationarity_above_roundoff"] = max(
                readings, key=_rank_reading
            )
            found = [self.measure_curvature(stated, solution.positions) for stated, solution in step.stages]
            row["is_local_minimum"], row["is_degenerate"] = (
                all(one.is_convex for one in found),
                any(one.is_degenerate for one in found),
            )
        return row

    def measure_stationarity(self, problem: StepProblem, p: Positions) -> StationarityReading:
        """Evaluate the stationarity at p (`springbench.harness.reference.exact_lengths`).

        Args:
            problem: step problem that was solved.
            p: positions (n, 3) [m], its solution.
        """
        return self._stationarity(problem, p)

    def measure_curvature(self, problem: StepProblem, p: Positions) -> HessianCurvature:
        """Compute the curvature of the objective, or of a Lagrangian with large penalties.

        Args:
            problem: step problem; where its lengths are exact, the Lagrangian replaces its objective.
            p: positions (n, 3) [m], with exact pins at their targets.
        """
        exact = self._stationarity.get_exact_lengths(problem.system)
        return compute_curvature(
            exact.build_lagrangian(problem, exact.compute_tensions(problem, p), PENALTY_FACTOR) if exact else problem, p
        )


def compute_reference_positions(
    scene: Scene, solver: Solver, *, initial_guess: str, frames: int
) -> NDArray[np.float64]:
    """Compute positions of a run with steps solved to round-off.

    Args:
        scene: scene that is stepped.
        solver: solver of the steps.
        initial_guess: name of the initial guess.
        frames: number of steps.

    Returns:
        Positions (frames, n, 3) [m], nan from the first step on that does not end at a stationary point.
    """
    evaluator, found = (
        StepVerifier(scene, None, is_minimiser=True),
        np.full((frames, len(scene.mesh.rest_positions), 3), np.nan),
    )
    for step in simulate_scene(
        scene, prepare(scene, solver), UNLIMITED_STOP_RULE, initial_guess=initial_guess, frames=frames
    ):
        if not all(
            evaluator.measure_stationarity(stated, s.positions).above_roundoff <= MAX_REFERENCE_STATIONARITY
            for stated, s in step.stages
        ):
            break
        found[step.index - 1] = step.positions
    return found


def _rank_reading(reading: StationarityReading) -> float:
    """Return the key by which a reading is ranked; non-finite readings are the worst."""
    return reading.above_roundoff if np.isfinite(reading.above_roundoff) else np.inf


def is_minimum(problem: StepProblem, p: Positions) -> bool:
    """Return whether the objective is convex at p, beyond round-off.

    Args:
        problem: step problem with the objective.
        p: positions (n, 3) [m], with exact pins at their targets; stationarity is not checked.
    """
    return compute_curvature(problem, p).is_convex
