"""Rows of step snapshots: the step, its minima, and a solver's curves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

from springbench.harness.config.accuracy_config import BenchmarkCase, CurveSpec, format_snapshot
from springbench.harness.execution import machine_info
from springbench.harness.experiments.accuracy.accuracy_failures import build_accuracy_failure_columns
from springbench.harness.experiments.accuracy.convergence_curves import ScoredCurve, measure_convergence
from springbench.harness.experiments.accuracy.solve_recording import record_solve
from springbench.harness.experiments.accuracy.step_scales import compute_stiffness_ratio, compute_vertex_distances
from springbench.harness.experiments.provenance import build_provenance_columns
from springbench.harness.reference.certified_minimum import KnownMinima, MinimumCertificate
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.step_snapshot import StepSnapshot, build_exact_scene
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.device_stepping import build_device_columns
from springbench.harness.simulation.time_loop import apply_initial_guess
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solver, System
from springbench.solvers.registry import SOLVER_TABLE, load_target

ResultRow = dict[str, Any]

BASIN_STATIONARITY_TOLERANCE = 1e-2
"""Stationarity below which a solver counts as having reached the basin of its last iterate."""

MINIMUM_DISTANCE_TOLERANCE = 1e-3
"""Largest distance of a vertex from a known minimum at which the minimum counts as reached, in mean rest lengths."""


@dataclass(frozen=True, eq=False)
class SnapshotEvaluation:
    """Step snapshot of a case, with the objects that score iterates on it.

    Attributes:
        case: scene, size and integrator.
        snapshot_name: name of the snapshot, as in the rows.
        step_snapshot: the problem of the step.
        reference_store: store of the reference solutions.
    """

    case: BenchmarkCase
    snapshot_name: str
    step_snapshot: StepSnapshot
    reference_store: ReferenceStore

    @classmethod
    def load_snapshot(
        cls, case: BenchmarkCase, snapshot_name: str | int, reference_store: ReferenceStore
    ) -> SnapshotEvaluation:
        """Load a step snapshot, or compute it if it is not stored.

        Args:
            case: scene, size and integrator.
            snapshot_name: name of the snapshot, or number of the frame.
            reference_store: store of the reference solutions.

        Raises:
            InputError: the scene cannot be built.
            RunFailed: a step of the reference run does not converge.
        """
        scene, size, integrator = case.scene, case.size, case.integrator
        if isinstance(snapshot_name, int):
            frozen = reference_store.load_frames(scene, size, [snapshot_name], integrator)[snapshot_name]
        else:
            frozen = reference_store.load_snapshots(scene, size, integrator)[snapshot_name]
        return cls(case, format_snapshot(snapshot_name), frozen, reference_store)

    @cached_property
    def scene(self) -> Scene:
        """The scene with all pins exact."""
        return build_exact_scene(self.case.scene, self.case.size, self.case.integrator)

    @cached_property
    def reference_evaluator(self) -> ReferenceEvaluator:
        """Reference evaluator that scores iterates."""
        return ReferenceEvaluator(self.step_snapshot.problem.system)

    @property
    def known_minima(self) -> KnownMinima:
        """The minima that are known at the time of the call."""
        return self.reference_store.find_minima(self.step_snapshot)

    @cached_property
    def mean_rest_length(self) -> float:
        """Mean rest length of the springs [m]; nan without springs."""
        lengths = self.scene.all_springs.rest_length
        return float(lengths.mean()) if len(lengths) else float("nan")

    def build_shared_columns(self) -> ResultRow:
        """Build the columns of the step that all its rows share."""
        return {
            "vertices": self.step_snapshot.problem.system.num_vertices,
            "springs": len(self.scene.all_springs.edges),
            "problem_digest": self.step_snapshot.digest,
            "snapshot": self.snapshot_name,
            "frame": self.step_snapshot.frame,
            "status": "ok",
        }

    def build_rows(self) -> list[ResultRow]:
        """Build the rows of the step and of its minima.

        The first is `uncertified` without a certified minimum.
        """
        case, problem, reference = self.case, self.step_snapshot.problem, self.known_minima
        common = self.build_shared_columns() | build_provenance_columns()
        common |= {"scene": case.scene_name, "size": case.size, "integrator": case.integrator}
        common["time_step"] = case.scene.time_step
        best = reference.minima[0].positions if reference.minima else problem.current_positions
        row = common | {
            "kind": "snapshot",
            "stiffness_ratio": compute_stiffness_ratio(problem.system, self.scene.all_springs.stiffness),
            "mean_rest_length": self.mean_rest_length,
            "objective_initial": problem.value(problem.current_positions),
            "objective_inertial": problem.value(apply_initial_guess(problem, "inertial").initial_guess),
            "objective_magnitude": problem.value_scale(best),
        }
        if not reference.minima:
            row |= {"status": "uncertified", "reason": reference.reason}
        return [row, *(common | self._build_minimum_row(branch, m) for branch, m in enumerate(reference.minima))]

    def _build_minimum_row(self, index: int, minimum: MinimumCertificate) -> ResultRow:
        return {
            "kind": "minimum",
            "minimum_index": index,
            "minimum_id": minimum.minimum_id,
            "objective": minimum.objective,
            "stationarity": self.reference_evaluator.measure_stationarity(
                self.step_snapshot.problem, minimum.positions
            ).stationarity,
            "min_eigenvalue": minimum.min_eigenvalue,
            "is_certified": minimum.is_certified,
        }

    def find_reached_minimum(self, p: Positions, stationarity: float) -> MinimumCertificate | None:
        """Return the minimum whose basin contains the last iterate of a solver.

        Args:
            p: positions (n, 3) [m].
            stationarity: relative stationarity at p.

        Returns:
            The minimum, or None if p has not converged enough, or if no certified minimum is found.
        """
        if not stationarity <= BASIN_STATIONARITY_TOLERANCE:
            return None
        for known in self.known_minima.minima:
            if (
                compute_vertex_distances(self.step_snapshot.problem.system, p, known.positions)[0]
                <= MINIMUM_DISTANCE_TOLERANCE * self.mean_rest_length
            ):
                return known
        found = self.reference_store.classify_minimum(self.step_snapshot, p)
        return found if found.is_certified else None


def build_curve_rows(
    spec: CurveSpec, step: SnapshotEvaluation, results_folder: Path, tick: Callable[[], None]
) -> list[ResultRow]:
    """Measure one solver on one step: its preparation, and a curve from each initial guess.

    An error of the solver becomes a row.

    Args:
        spec: the curves of the solver.
        step: the step snapshot.
        results_folder: folder of the config's results.
        tick: called after each curve.
    """
    solver: Solver = load_target(SOLVER_TABLE[spec.solver.name])(**spec.solver.parameters)
    shared = step.build_shared_columns()
    try:
        with machine_info.limit_threads(spec.measurement.threads):
            prepared, row = _time_preparation(solver, step, spec.measurement.rounds)
            shared |= build_device_columns(prepared)
            found = [shared | row]
            for first_guess in spec.initial_guesses:
                found += [shared | row for row in _measure_curve(spec, prepared, step, first_guess, results_folder)]
                tick()
    except Exception as error:  # a solver may raise any exception; the other solvers continue
        return [
            shared | build_accuracy_failure_columns(error) | {"kind": "curve", "initial_guess": guess}
            for guess in spec.initial_guesses
        ]
    return found


def _time_preparation(solver: Solver, step: SnapshotEvaluation, num_rounds: int) -> tuple[PreparedSolver, ResultRow]:
    system, seconds = step.step_snapshot.problem.system, list[float]()
    began = perf_counter()
    prepared = solver.prepare(system)
    cold = perf_counter() - began
    for _ in range(num_rounds):
        began = perf_counter()
        prepared = solver.prepare(system)
        seconds.append(perf_counter() - began)
    return prepared, {"kind": "prepare", "cold_seconds": cold, "seconds": seconds}


def _measure_curve(
    spec: CurveSpec, prepared: PreparedSolver, step: SnapshotEvaluation, initial_guess: str, folder: Path
) -> list[ResultRow]:
    known = step.known_minima.minima
    curve = measure_convergence(
        prepared,
        step.step_snapshot.build_problem(initial_guess),
        step.reference_evaluator,
        known[0].objective if known else None,
        max_iterations=spec.max_iterations,
        time_limit=spec.measurement.time_limit,
        num_rounds=spec.measurement.rounds,
    )
    reached = (
        step.find_reached_minimum(curve.positions[-1], curve.stationarity[-1]) if curve.status != "saddle" else None
    )
    shared: ResultRow = {
        "kind": "curve",
        "initial_guess": initial_guess,
        "max_iterations": spec.max_iterations,
        "status": curve.status,
        "reason": curve.reason or None,
        "preempted": curve.preempted,
    }
    reference = step.known_minima  # again: this solver may have found a minimum
    if not reference.minima and curve.status == "ok":
        shared |= {"status": "uncertified", "reason": reference.reason}
    if reached:
        shared["minimum_index"] = reference.find_index(reached)
    if spec.recordings and initial_guess == spec.initial_guesses[0]:
        shared["recording_path"] = str(
            record_solve(spec, step, step.scene, initial_guess, curve, folder).relative_to(folder)
        )
    against = reached or next(iter(reference.minima), None)
    return [shared | row for row in _build_iterate_rows(curve, step.step_snapshot.problem.system, against)]


def _build_iterate_rows(curve: ScoredCurve, system: System, minimum: MinimumCertificate | None) -> list[ResultRow]:
    rows: list[ResultRow] = []
    for k, number in enumerate(curve.iterate_indices):
        row: ResultRow = {
            "iteration": number,
            "objective": _finite_or_none(curve.g[k]),
            "stationarity": _finite_or_none(curve.stationarity[k]),
            "seconds": curve.seconds[k].tolist(),
        }
        if minimum:
            largest, rms = compute_vertex_distances(system, curve.positions[k], minimum.positions)
            row |= {"minimum_id": minimum.minimum_id, "position_error_max_m": largest, "position_error_rms_m": rms}
        rows.append(row)
    return rows


def _finite_or_none(value: float) -> float | None:
    """Return the value, or None if it is not finite because an iterate overflows."""
    return value if math.isfinite(value) else None
