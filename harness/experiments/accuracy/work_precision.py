"""Work-precision of whole simulations: error at the horizon and wall time.

    error = |p(T) - reference(T)| / |reference(T) - p(0)|        Frobenius norms over the vertices that are not pinned

The error combines time stepping and solver, which is what a user gets. Pins are exact here, as they are in the
reference. Where the error is smaller than the reference's own, the row is `uncertified`: it has a time and no error.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

import numpy as np
from springbench.harness.config.accuracy_config import WorkSpec
from springbench.harness.config.run_options import RUN_OPTIONS
from springbench.harness.execution import machine_info
from springbench.harness.experiments.accuracy.accuracy_failures import TimeLimitExceeded, build_accuracy_failure_columns
from springbench.harness.experiments.accuracy.step_scales import compute_stiffness_ratio
from springbench.harness.experiments.provenance import convert_tolerance
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, UnpredictableMotion
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.auto_tolerance import build_stop_rule
from springbench.harness.simulation.stopwatch import PhaseWatch, Stopwatch, retry_on_mismatch
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.harness.simulation.timing_pass import DivergenceError
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solver
from springbench.solvers.registry import SOLVER_TABLE, load_target

ResultRow = dict[str, Any]

NUM_WARMUP_STEPS = 2
"""Steps before the clock starts: they compile, and access memory for the first time."""


def build_work_rows(
    spec: WorkSpec, trajectory: ReferenceTrajectory | Exception, tick: Callable[[], None]
) -> list[ResultRow]:
    """Measure one simulation and build its row; an error becomes status and reason.

    Args:
        spec: the simulation.
        trajectory: reference up to the horizon, or the error that prevents it.
        tick: called after each round.
    """
    shared: ResultRow = {"kind": "work", "status": "ok", **build_option_columns(spec), "t_end": spec.t_end}
    try:
        if isinstance(trajectory, Exception):
            raise trajectory
        with machine_info.limit_threads(spec.measurement.threads):
            return [shared | _measure_simulation(spec, trajectory, tick)]
    except Exception as error:  # a solver may raise any exception; the other solvers continue
        return [shared | build_accuracy_failure_columns(error)]


def build_option_columns(spec: WorkSpec) -> ResultRow:
    """Build the columns of a simulation's options."""
    columns = {RUN_OPTIONS[name].column: value for name, value in spec.options.items()}
    return columns | {"residual_rtol": convert_tolerance(spec.options["rtol"])}


def _measure_simulation(spec: WorkSpec, trajectory: ReferenceTrajectory, tick: Callable[[], None]) -> ResultRow:
    case = spec.case
    scene = build_exact_scene(case.scene, case.size, case.integrator)
    solver: Solver = load_target(SOLVER_TABLE[spec.solver.name])(**spec.solver.parameters)
    prepared = prepare(scene, solver)
    row: ResultRow = {
        "vertices": scene.system.num_vertices,
        "springs": len(scene.all_springs.edges),
        "solver_description": prepared.description,
    }
    row["stiffness_ratio"] = compute_stiffness_ratio(scene.system, scene.all_springs.stiffness)
    frames = round(spec.t_end / case.scene.time_step)
    seconds: list[float] = []
    row["preempted"] = False
    p, *_ = _simulate_timed(
        spec, scene, prepared, min(NUM_WARMUP_STEPS, frames), time_limit=inf
    )  # compilation is not timed
    for _ in range(spec.measurement.rounds):
        p, iterations, watched = _simulate_timed(spec, scene, prepared, frames)
        seconds.append(watched["wall_seconds_sum"])
        row["cpu_seconds"] = min(row.get("cpu_seconds", inf), watched["cpu_seconds"])
        row["preempted"] |= watched["preempted"]
        row["num_iterations"] = iterations
        tick()
    away = (p - trajectory.positions[-1])[scene.system.free_vertices]
    row["error"], row["reference_kind"] = trajectory.measure_error(-1, p), trajectory.reference_kind
    row["reference_error"] = trajectory.get_error_bound(-1)
    row["end_error_rms_m"] = float(np.sqrt(np.einsum("ij,ij->i", away, away).mean()))
    row |= {"seconds": seconds, "seconds_per_simulated_second": float(np.median(seconds)) / spec.t_end}
    try:
        trajectory.require_accuracy(row["error"])
    except UnpredictableMotion as doubt:
        del row["error"], row["end_error_rms_m"]
        row |= build_accuracy_failure_columns(doubt)
    return row


@retry_on_mismatch
def _simulate_timed(
    spec: WorkSpec, scene: Scene, prepared: PreparedSolver, frames: int, *, time_limit: float | None = None
) -> tuple[Positions, int, ResultRow]:
    """Simulate under a clock; return the last positions, the number of iterations and timing columns.

    The positions are (n, 3) [m]. `time_limit` is in seconds; that of the spec if left out. Raises RunFailed if a second
    clock disagrees.
    """
    seconds, iterations, p, watch = 0.0, 0, scene.mesh.rest_positions, PhaseWatch(spec.measurement.threads)
    clock = Stopwatch(watch)
    stop = build_stop_rule(spec.options["max_iterations"], spec.options["rtol"])
    time_limit = spec.measurement.time_limit if time_limit is None else time_limit
    run = simulate_scene(scene, prepared, stop, initial_guess=spec.options["initial_guess"], frames=frames)
    for _ in range(frames):
        with clock:
            step = next(run)
        p = step.positions
        seconds += clock.seconds
        iterations += step.num_iterations
        if not np.isfinite(p).all():
            raise DivergenceError(f"positions are not finite from frame {step.index} on")
        if min(seconds, watch.process_seconds) > time_limit and step.index < frames:
            raise TimeLimitExceeded(f"the limit of {time_limit:g} s was reached in frame {step.index} of {frames}")
    return p, iterations, watch.build_columns("step", [seconds])
