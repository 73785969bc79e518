"""Measure the time of the cheapest method for an error relative to a baseline, for each performance target of a config.

    python -m tests.bench.targets [CONFIG] [--results FOLDER]

CONFIG is `targets.yaml` (five minutes) or `controlled.yaml` next to this file, or another config of this form. Rows are
stored in FOLDER/<config>/targets.parquet. The exit code is 1 if a target is missed.

Method and baseline are timed interleaved in one process on one core. Their times are the smallest CPU times of several
rounds, including preparation. With `verify` the errors are computed from the reference solution. The method's error may
then be at most twice the requested one. It may be below a third of it only where larger step sizes would be unstable.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path
from time import thread_time
from typing import Any

import pyarrow as pa
from rich.table import Table
from springbench.harness.console import get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.execution import machine_info
from springbench.harness.experiments.accuracy.accuracy_units import open_reference_store
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget
from springbench.harness.experiments.error_control.method_search import (
    MIN_ERROR_FRACTION,
    compute_predictability_horizon,
    search_cheapest_method,
)
from springbench.harness.experiments.error_control.method_trials import Trial
from springbench.harness.experiments.provenance import build_provenance_columns
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.results import parquet_rows
from springbench.harness.results.folder_ownership import claim_folder
from springbench.harness.results.run_schema import PROVENANCE_COLUMN_SPECS, ColumnSpec, build_schema
from springbench.solvers.model.step_problem import NotPositiveDefinite, Unsupported

from tests.bench.target_baseline import TargetBaseline, find_baseline
from tests.bench.target_config import TargetCase, TargetPlan, load_targets

MIN_ROUNDS, MAX_ROUNDS, MIN_TOTAL_SECONDS = 3, 15, 0.5
"""Smallest and largest number of rounds; rounds above the minimum end at this total CPU time of the method [s]."""
MAX_TARGET_ERROR_RATIO = 2.0
"""Largest accepted ratio of the error to the requested one."""

TARGET_COLUMNS = (
    ColumnSpec("status", pa.string(), "", "ok or failed"),
    ColumnSpec("reason", pa.string(), "", "why it failed, or a remark on the error"),
    ColumnSpec("scene", pa.string(), "", "name of the scene"),
    ColumnSpec("size", pa.int64(), "", "mesh size"),
    ColumnSpec("vertices", pa.int64(), "", "vertices of the mesh"),
    ColumnSpec("t_end", pa.float64(), "s", "simulated time"),
    ColumnSpec("error_requested", pa.float64(), "", "relative error at the end"),
    ColumnSpec("error_estimated", pa.float64(), "", "estimated error of the method"),
    ColumnSpec("error", pa.float64(), "", "error of the method against the reference solution"),
    ColumnSpec("method", pa.string(), "", "the cheapest method"),
    ColumnSpec("cpu_seconds", pa.float64(), "s", "CPU time of the method"),
    ColumnSpec("baseline", pa.string(), "", "the baseline"),
    ColumnSpec("baseline_error", pa.float64(), "", "its error, estimated as that of the method"),
    ColumnSpec("baseline_seconds", pa.float64(), "s", "its CPU time, in the same process"),
    ColumnSpec("target_ratio", pa.float64(), "", "target ratio of the method's time to the baseline's"),
    *PROVENANCE_COLUMN_SPECS,
)
TARGET_SCHEMA = build_schema(TARGET_COLUMNS)


@dataclass(frozen=True, slots=True)
class TargetResult:
    """Measured result of a performance target.

    Attributes:
        target: the performance target.
        size: size of the mesh.
        vertices: number of vertices.
        method: name of the cheapest method.
        error_estimated: its estimated error.
        seconds: its CPU time [s].
        baseline: name of the baseline.
        baseline_error: error of the baseline.
        baseline_seconds: CPU time of the baseline [s].
        is_lower_bound: whether the baseline would take longer than baseline_seconds.
        error: error of the method against the reference solution; None without `verify`.
        note: why the method is much more accurate than requested; empty otherwise.
        reason: why there is no result; empty if there is one.
    """

    target: TargetCase
    size: int
    vertices: int = 0
    method: str = ""
    error_estimated: float = inf
    seconds: float = inf
    baseline: str = ""
    baseline_error: float = inf
    baseline_seconds: float = inf
    is_lower_bound: bool = False
    error: float | None = None
    note: str = ""
    reason: str = ""

    @property
    def time_ratio(self) -> float:
        """CPU time of the method divided by that of the baseline.

        It is an upper bound if `is_lower_bound`.
        """
        return self.seconds / self.baseline_seconds

    @property
    def is_error_accepted(self) -> bool:
        """Whether the error against the reference solution, if known, is close to the requested one."""
        if self.error is None:
            return True
        return self.error <= MAX_TARGET_ERROR_RATIO * self.target.error and (
            self.error >= MIN_ERROR_FRACTION * self.target.error or bool(self.note)
        )

    @property
    def is_met(self) -> bool:
        """Whether the error is as requested and the time ratio at most the target ratio."""
        return not self.reason and self.is_error_accepted and self.time_ratio <= self.target.target.target_ratio


def measure_targets(
    targets: TargetPlan, reference_store: ReferenceStore, print_message: Callable[[str], None]
) -> Iterator[TargetResult]:
    """Measure the targets one after the other; a failure is reported as `reason`.

    Args:
        targets: the performance targets.
        reference_store: store of the reference solutions.
        print_message: prints a remark.
    """
    for one in targets.cases:
        print_message(f"{one.scene} {one.size or ''} to {one.error:g} after {one.target.t_end:g} s:")
        requested = None
        try:
            requested = ErrorTarget.from_scene(targets.scenes[one.scene], one.size, one.target.t_end)
            yield _measure_target(one, requested, reference_store, print_message)
        except (RunFailed, Unsupported, NotPositiveDefinite) as error:
            yield TargetResult(one, requested.size if requested else one.size or 0, reason=str(error))


def _measure_target(
    performance_target: TargetCase,
    error_target: ErrorTarget,
    reference_store: ReferenceStore,
    print_message: Callable[[str], None],
) -> TargetResult:
    horizon = compute_predictability_horizon(error_target, performance_target.error, print_message)
    reference = (
        reference_store.load_trajectory(
            error_target.scene, error_target.size, [error_target.t_end], error=performance_target.error
        )
        if performance_target.target.verify
        else None
    )
    found = search_cheapest_method(error_target, performance_target.error, horizon, print_message)
    best, free_vertices = (
        found.best_trial,
        error_target.build_scene(error_target.frame_seconds, "substepping").system.free_vertices,
    )
    end = best.trajectory.positions[-1]
    baseline = find_baseline(
        performance_target,
        error_target,
        found,
        lambda p: reference.measure_error(-1, p) if reference else found.compute_error(p, free_vertices),
        print_message,
    )
    seconds, baseline_seconds = _time_interleaved(best, baseline)
    return TargetResult(
        *(performance_target, error_target.size, len(end), str(best.method), best.error_estimated, seconds),
        *(baseline.name, baseline.error, baseline_seconds, baseline.is_lower_bound),
        error=reference.measure_error(-1, end) if reference else None,
        note=found.note,
    )


def _time_interleaved(trial: Trial, baseline: TargetBaseline) -> tuple[float, float]:
    """Return the smallest CPU seconds of the method and of the baseline, timed interleaved."""
    seconds, baseline_seconds = list[float](), [baseline.seconds]
    while len(seconds) < MIN_ROUNDS or (sum(seconds) < MIN_TOTAL_SECONDS and len(seconds) < MAX_ROUNDS):
        seconds.append(_measure_cpu_seconds(trial.rerun_trial))
        baseline_seconds += [baseline.rerun_timed()] if baseline.rerun_timed else []
    return min(seconds), min(baseline_seconds)


def _measure_cpu_seconds(call: Callable[[], object]) -> float:
    began = thread_time()
    call()
    return thread_time() - began


def build_row(result: TargetResult) -> dict[str, Any]:
    """Return the row of a result, without its provenance."""
    return {
        "status": "failed" if result.reason else "ok",
        "reason": result.reason or result.note or None,
        "scene": result.target.scene,
        "size": result.size,
        "vertices": result.vertices,
        "t_end": result.target.target.t_end,
        "error_requested": result.target.error,
        "error_estimated": result.error_estimated,
        "error": result.error,
        "method": result.method,
        "cpu_seconds": result.seconds,
        "baseline": result.baseline,
        "baseline_error": result.baseline_error if isfinite(result.baseline_error) else None,
        "baseline_seconds": result.baseline_seconds,
        "target_ratio": result.target.target.target_ratio,
    }


def build_cells(result: TargetResult) -> tuple[str, ...]:
    """Return the cells of a result in the printed table."""
    error = f"{result.error_estimated:.1g} (estimated)" if result.error is None else f"{result.error:.2g}"
    verdict = result.reason or ("met" if result.is_met else "missed") + (f": {result.note}" if result.note else "")
    return (
        f"{result.target.scene} {result.size or ''}",
        f"{result.target.error:g}",
        "" if result.reason else error,
        result.method,
        result.baseline,
        "–" if result.reason else format_ratio(result.time_ratio, is_upper_bound=result.is_lower_bound),
        format_ratio(result.target.target.target_ratio),
        verdict,
    )


def format_ratio(ratio: float, *, is_upper_bound: bool = False) -> str:
    """Format a ratio of times."""
    text = f"1/{1 / ratio:.3g}" if ratio < 1.0 else f"{ratio:.3g}"
    return f"at most {text}" if is_upper_bound else text


def run_targets(config: Path, results: Path) -> bool:
    """Measure all targets of a config, print them and store their rows.

    Args:
        config: file of the targets.
        results: folder of results.
    Returns: whether all targets are met.
    """
    plan = load_targets(config)
    folder = claim_folder(results / plan.name, config)
    table = Table("scene", "requested", "error", "method", "baseline", "time ratio", "target", "verdict")
    found = list[TargetResult]()
    with machine_info.limit_threads(1):
        for one in measure_targets(plan, open_reference_store(results), print_message):
            found.append(one)
            *_, error, _, _, ratio, target, verdict = cells = build_cells(one)
            print_message(f"  error {error}, time ratio {ratio}, target {target}: {verdict}")
            table.add_row(*cells)
    provenance = build_provenance_columns()
    rows = [build_row(one) | provenance for one in found]
    parquet_rows.write_rows(folder / "targets.parquet", rows, TARGET_SCHEMA)
    get_output_console().print(split_wide_table(table))
    print_message(f"rows are in {folder / 'targets.parquet'}")
    return all(one.is_met for one in found)


def main(arguments: list[str] | None = None) -> int:
    """Measure the targets of a config, and return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("config", nargs="?", type=Path, default=Path(__file__).with_suffix(".yaml"))
    parser.add_argument("--results", type=Path, default=Path("results"))
    given = parser.parse_args(arguments)
    try:
        return 0 if run_targets(given.config, given.results) else 1
    except InputError as error:
        print_message(f"targets: {error}")
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
