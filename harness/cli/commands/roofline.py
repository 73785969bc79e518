"""Command `springbench roofline`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer
from springbench.harness.cli.shared_options import (
    InProcessOption,
    RerunOption,
    RerunStaleOption,
    ResultsOption,
    describe_config,
)
from springbench.harness.console import get_error_console, get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError, InputMistake


def roofline(
    config: Annotated[Path, describe_config("CONFIG", "Sweep (YAML), or name of a shipped one.")],
    results: ResultsOption = Path("results"),
    budget: Annotated[float, typer.Option(help="Time budget of a candidate at one size [s].")] = 210.0,
    rerun: RerunOption = False,
    rerun_stale: RerunStaleOption = False,
    in_process: InProcessOption = False,
) -> None:
    """Time a sweep's solvers interleaved, with a C++ baseline and roofline microbenchmarks."""
    from springbench.harness.config.config_loader import load_sweep, require_fixed_steps
    from springbench.harness.config.run_options import AUTO
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.roofline.roofline_comparison import run_roofline
    from springbench.harness.report.charts.speed_chart import build_speed_chart
    from springbench.harness.report.figures.chart_sheets import draw_chart_sheets
    from springbench.harness.report.site import refresh_results_page
    from springbench.harness.report.speed.speed_figures import compute_speed_figures
    from springbench.harness.report.speed.speed_table import build_speed_table, describe_speed
    from springbench.harness.results.folder_ownership import claim_folder

    if not 0.0 < budget < math.inf:
        raise InputError(InputMistake(f"got {budget:g}; expected a number of seconds above 0", key="--budget"))
    sweep = load_sweep(config)
    require_fixed_steps(sweep.list_runs())
    if any(run.rtol == AUTO for run in sweep.list_runs()):
        raise InputError(InputMistake("needs the steps before; give a number, or null", config, key="rtol"))
    folder = claim_folder(results / sweep.name, config)
    found = compute_speed_figures(
        run_roofline(
            sweep,
            folder,
            create_display(get_error_console()),
            print_message,
            rerun=rerun,
            rerun_stale=rerun_stale,
            budget=budget,
            isolated=not in_process,
        )
    )
    get_output_console().print(split_wide_table(build_speed_table(found), key_columns=2))
    for line in describe_speed(found):
        print_message(line)
    draw_chart_sheets(build_speed_chart(found), folder / "pictures" / "speed")
    print_message(f"rows and pictures are in {folder}")
    refresh_results_page(results, folder, print_message)
    raise typer.Exit(1 if any(f.status in ("failed", "diverged") for f in found) else 0)
