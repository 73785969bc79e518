"""Error-controlled run of a sweep (`error_target`) with a given solver.

A search selects the integrator and the step size.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import RunFailed
from springbench.harness.execution.worker_process import ProgressCallback
from springbench.harness.experiments.error_control.candidate_methods import (
    ErrorTarget,
    list_contact_methods_of_solver,
    list_methods_of_solver,
)
from springbench.harness.experiments.error_control.method_search import (
    compute_predictability_horizon,
    search_cheapest_contact_method,
    search_cheapest_method,
)
from springbench.harness.experiments.error_control.method_trials import SearchResult
from springbench.harness.results.quantities import compute_ms_per_step
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.adaptive_stepping import Trajectory
from springbench.harness.simulation.energy_balance import EnergyGain, StepDissipation
from springbench.harness.simulation.instrumentation_pass import compute_strain_columns, count_intersections
from springbench.harness.simulation.timing_pass import hash_positions
from springbench.solvers.model.step_problem import Positions


@dataclass(frozen=True, slots=True, eq=False)
class ErrorControlledRun:
    """Result of an error-controlled run.

    Attributes:
        scene: the scene, built with the frame as its time step.
        search_result: method, setting and error estimate.
        error_requested: requested relative error.
        timed_trajectories: the same motion, timed again in each round.
        frame_dissipation: energies and dissipation by frame, from the method's own steps.
        messages: remarks, stored in the rows.
    """

    scene: Scene
    search_result: SearchResult
    error_requested: float
    timed_trajectories: tuple[Trajectory, ...]
    frame_dissipation: dict[int, StepDissipation]
    messages: list[str] = field(default_factory=list[str])

    @property
    def positions(self) -> Positions:
        """Positions at the start and after each frame, (frames + 1, n, 3) [m]."""
        return self.timed_trajectories[0].positions

    @property
    def ms_per_step(self) -> float:
        """Time per step [ms], where each frame counts as one step."""
        return compute_ms_per_step([seconds for path in self.timed_trajectories for seconds in path.frame_seconds])

    def build_rows(self) -> list[dict[str, Any]]:
        """Build a row for each frame of each round."""
        best, scene = self.search_result.best_trial, self.scene
        balances = self.search_result.compute_balances(scene)
        shared = {
            "phase": "step",
            **self.search_result.build_status_columns(balances),
            "vertices": scene.system.num_vertices,
            "springs": len(scene.all_springs.edges),
            "max_iterations": None,
            "initial_guess": None,
            "error_requested": self.error_requested,
            **best.columns,
            "search_seconds": self.search_result.search_seconds,
            "solver_description": "; ".join(
                [f"{best.method} of {len(self.search_result.trials)} methods", *self.messages]
            ),
        }
        seen = [self._build_frame_columns(k, self.positions[k], balance) for k, balance in balances.items()]
        return [
            shared
            | columns
            | {
                "round": number,
                "seconds": seconds,
                "wall_seconds_check": one.wall_seconds,
                "wall_seconds_sum": sum(one.frame_seconds),
            }
            for number, one in enumerate(self.timed_trajectories)
            for columns, seconds in zip(seen, one.frame_seconds, strict=True)
        ]

    def _build_frame_columns(self, frame: int, p: Positions, balance: EnergyGain) -> dict[str, Any]:
        crossed = count_intersections(self.scene, p, self.scene.compute_time(frame))
        return {
            "frame": frame,
            **balance.columns,
            **self.frame_dissipation[frame].columns,
            **compute_strain_columns(self.scene, p),
            "num_intersections": crossed,
            "positions_digest": hash_positions(p),
        }


def run_error_controlled(run: RunSpec, error: float, tick: ProgressCallback, results: Path) -> ErrorControlledRun:
    """Find the cheapest method of the run's solver, and time it in each round.

    Args:
        run: specification of the run.
        error: relative error at the end of the run.
        tick: called with the name of the phase as the run progresses.
        results: folder of results, with the stored references by which errors with contact are measured.

    Returns:
        The method with its timed motions, from which rows are built.

    Raises:
        RunFailed: no setting reaches the error, or a round ends at positions that are not bitwise identical.
        Unsupported: the solver does not support error control. Errors of the solver are raised unchanged.
    """
    error_target = ErrorTarget.from_scene(run.scene, run.size, run.frames * run.scene.time_step)
    messages = list[str]()
    tick("choosing steps")
    answer = _search_method(run, error_target, error, tick, results, messages)
    best, rounds = answer.best_trial, list[Trajectory]()
    for _ in range(run.rounds):
        rounds.append(best.rerun_trial())
        if not np.array_equal(rounds[-1].positions, best.trajectory.positions):
            raise RunFailed("the positions of a round differ from those of the first; expected equal bits")
        for _ in range(run.frames):
            tick("timed pass")
    return ErrorControlledRun(
        error_target.build_scene(error_target.frame_seconds, "substepping"),
        answer,
        error,
        tuple(rounds),
        best.measure_dissipation(error_target.frame_seconds),
        messages,
    )


def _search_method(
    run: RunSpec,
    error_target: ErrorTarget,
    error: float,
    tick: ProgressCallback,
    results: Path,
    messages: list[str],
) -> SearchResult:
    """Search the cheapest method of the run's solver; remarks are added to the messages."""
    if not error_target.has_contact:
        pairs = list_methods_of_solver(run.solver)
        growth = compute_predictability_horizon(error_target, error, messages.append)
        return search_cheapest_method(error_target, error, growth, lambda line: tick("choosing steps"), pairs)
    pairs = list_contact_methods_of_solver(run.solver)
    return search_cheapest_contact_method(
        error_target, error, results, messages.append, lambda line: tick("choosing steps"), pairs
    )
