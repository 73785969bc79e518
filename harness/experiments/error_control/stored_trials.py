"""Read the trials of earlier searches, to select the methods worth running again.

A row of the kind `method` states in the column `predicted_seconds` the CPU seconds predicted for the requested error.
For a similar error, methods whose predicted cost was several times the smallest are left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import log
from pathlib import Path
from typing import Any

from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.execution import machine_info
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget, list_candidate_methods
from springbench.harness.experiments.error_control.method_trials import SearchResult
from springbench.harness.results import parquet_rows, row_store

ResultRow = dict[str, Any]

_MAX_ERROR_RATIO = 10.0
"""Largest ratio of two errors for which a stored prediction is used; for others it has little value."""
_MAX_COST_RATIO = 2.0
"""Largest ratio to the smallest predicted cost at which a method is run again: the accuracy of predictions."""


def format_problem_id(error_target: ErrorTarget) -> str:
    """Return an identifier of the simulated problem, including its frames."""
    return (
        f"{error_target.scene.with_time_step(1.0).scene_digest[:12]}-{error_target.size}-"
        f"{error_target.t_end:.9g}-{error_target.num_frames}"
    )


def read_stored_trials(folder: Path, error_target: ErrorTarget) -> list[ResultRow]:
    """Return the stored trials of a motion by the same source code on this machine.

    Args:
        folder: folder of accuracy rows.
        error_target: motion, identified by scene, size, end time and frames.

    Returns:
        Rows of the kind `method`.
    """
    here = {
        "problem_digest": format_problem_id(error_target),
        "machine_id": machine_info.describe_machine().machine_id,
        "source_fingerprint": machine_info.hash_sources(),
    }
    units = [unit for unit in row_store.list_units(folder) if "-error-" in unit.name]
    found = parquet_rows.read_rows(units, ACCURACY_SCHEMA).to_pylist() if units else []
    return [row for row in found if row["kind"] == "method" and here.items() <= row.items()]


def select_best_predicted(
    stored_trials: Sequence[ResultRow], error: float
) -> tuple[float, list[tuple[str, SolverSpec]]]:
    """Return the stored error nearest to `error`, and the methods that are cheap at it.

    Args:
        stored_trials: rows of earlier trials.
        error: relative error to reach.

    Returns:
        The nearest error, and integrators with solvers; none where no stored error is similar.
    """
    nearest = min(
        (row["error_requested"] for row in stored_trials),
        key=lambda requested: abs(log(requested / error)),
        default=0.0,
    )
    if not error / _MAX_ERROR_RATIO <= nearest <= error * _MAX_ERROR_RATIO:
        return nearest, []
    there = [row for row in stored_trials if row["error_requested"] == nearest]
    most = _MAX_COST_RATIO * min(row["predicted_seconds"] for row in there)
    cheap = {(row["integrator"], row["solver"]) for row in there if row["predicted_seconds"] <= most}
    return nearest, [
        (integrator, solver) for integrator, solver in list_candidate_methods() if (integrator, solver.name) in cheap
    ]


def build_trial_rows(search_result: SearchResult, stored_trials: Iterable[ResultRow], error: float) -> list[ResultRow]:
    """Build the rows of the trials of a search.

    Stored trials of the same error are added.

    Args:
        search_result: result of the search.
        stored_trials: rows of earlier trials; methods that were run again are left out.
        error: requested error.
    """
    made = [
        {
            "kind": "method",
            "status": "ok",
            "parameters": "{}",
            "predicted_seconds": predicted,
            "solver": one.method.solver,
            **one.columns,
            "num_iterations": one.trajectory.num_iterations,
            "seconds": [one.trajectory.wall_seconds],
            "cpu_seconds": one.trajectory.cpu_seconds,
        }
        for one, predicted in search_result.trials
    ]
    again = {(row["integrator"], row["solver"]) for row in made}
    trial_rows = [
        row
        for row in stored_trials
        if row["error_requested"] == error and (row["integrator"], row["solver"]) not in again
    ]
    return [*made, *trial_rows]
