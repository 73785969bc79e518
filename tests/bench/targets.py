"""Command `springbench targets`: compare the time to an error with a baseline."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated

import typer
from springbench.harness.cli.shared_options import ResultsOption
from springbench.harness.console import get_output_console, print_message, split_wide_table


def targets(
    config: Annotated[Path, typer.Argument(help="Goals (YAML).")],
    results: ResultsOption = Path("results"),
) -> None:
    """Measure performance targets: the cheapest method for an error, against a baseline."""
    from rich.table import Table
    from springbench.harness.config.performance_targets import load_targets
    from springbench.harness.execution import machine_info
    from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
    from springbench.harness.experiments.accuracy.accuracy_units import open_reference_store
    from springbench.harness.experiments.error_control.target_measurement import TargetResult, measure_targets
    from springbench.harness.experiments.error_control.third_party_integrators import THIRD_PARTY_INTEGRATORS
    from springbench.harness.experiments.provenance import build_provenance_columns
    from springbench.harness.results import parquet_rows
    from springbench.harness.results.folder_ownership import claim_folder
    from springbench.solvers.registry import SOLVER_TABLE

    asked = load_targets(config, list(THIRD_PARTY_INTEGRATORS), list(SOLVER_TABLE))
    folder = claim_folder(results / asked.name, config)
    table = Table("", "asked", "error", "way", "against", "times its cost", "wanted", "")
    found = list[TargetResult]()
    with machine_info.limit_threads(1):
        for one in measure_targets(asked, open_reference_store(results), print_message):
            found.append(one)
            wanted, ratio = (
                _format_ratio(one.target.target.wanted),
                "–" if one.reason else _format_ratio(one.time_ratio, is_upper_bound=one.is_lower_bound),
            )
            verdict = one.reason or ("holds" if one.is_met else "does not hold") + (f": {one.note}" if one.note else "")
            error = f"{one.error_estimated:.1g} estimated" if one.error is None else f"{one.error:.2g}"
            print_message(f"  an error of {error}, {ratio} of the processor time, wanted {wanted}: {verdict}")
            cells = (
                f"{one.target.scene} {one.size or ''}",
                f"{one.target.error:g}",
                "" if one.reason else error,
                one.method,
            )
            table.add_row(*cells, one.baseline, ratio, wanted, verdict)
    (folder / "accuracy").mkdir(exist_ok=True)
    shared = {"kind": "goal", "sweep": asked.name, "threads": 1} | build_provenance_columns()
    written = [
        shared
        | {
            "status": "failed" if one.reason else "ok",
            "reason": one.reason or one.note or None,
            "scene": one.target.scene,
        }
        | {"error": one.error}
        | {"size": one.size, "vertices": one.vertices, "horizon": one.target.target.horizon, "asked": one.target.error}
        | {"solver": one.method, "estimated": one.error_estimated, "cpu_seconds": one.seconds, "against": one.baseline}
        | {
            "against_error": one.baseline_error if isfinite(one.baseline_error) else None,
            "against_seconds": one.baseline_seconds,
            "wanted": one.target.target.wanted,
        }
        for one in found
    ]
    parquet_rows.write_rows(folder / "accuracy" / "goals.parquet", written, ACCURACY_SCHEMA)
    get_output_console().print(split_wide_table(table))
    print_message(f"rows are in {folder / 'accuracy'}")
    raise typer.Exit(0 if all(one.is_met for one in found) else 1)


def _format_ratio(ratio: float, *, is_upper_bound: bool = False) -> str:
    """Format a ratio of costs."""
    told = f"1/{1 / ratio:.3g}" if ratio < 1.0 else f"{ratio:.3g}"
    return f"at most {told}" if is_upper_bound else told
