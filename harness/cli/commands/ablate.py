"""Command `springbench ablate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from springbench.harness.cli.shared_options import (
    SCENE_HELP,
    InProcessOption,
    RerunOption,
    RerunStaleOption,
    ResultsOption,
    describe_config,
)
from springbench.harness.console import get_error_console, get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError

DEFAULT_ABLATION_SOLVER, DEFAULT_ABLATION_TOLERANCE = "hybrid", 1e-4
"""Default solver, which supports all effects, and its tolerance.

It converges far enough that the solver's own error does not hide the change from an effect.
"""

DEFAULT_OVERHEAD_TOLERANCE = 1e-6
"""Default tolerance of --all-solvers: it includes iterations far from the minimum and close to it."""

DEFAULT_NUM_ROUNDS = 5
"""Default number of times that each step is timed."""


def ablate(
    context: typer.Context,
    scene: Annotated[Path, describe_config("SCENE", SCENE_HELP)],
    results: ResultsOption = Path("results"),
    solver: Annotated[
        str | None,
        typer.Option(help=f"Solver; {DEFAULT_ABLATION_SOLVER} to {DEFAULT_ABLATION_TOLERANCE:g} by default."),
    ] = None,
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default size by default.")] = None,
    with_pairs: Annotated[bool, typer.Option("--with-pairs", help="Also omit each pair of effects.")] = False,
    all_solvers: Annotated[
        bool, typer.Option("--all-solvers", help="Measure the overhead of each effect per iteration, for all solvers.")
    ] = False,
    rerun: RerunOption = False,
    rerun_stale: RerunStaleOption = False,
    in_process: InProcessOption = False,
) -> None:
    """Measure the cost and the influence of each effect, and suggest missing ones."""
    from springbench.harness.config.config_loader import load_config
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.ablation.ablation_unit import run_ablation
    from springbench.harness.report.ablation_summary import build_ablation_table, read_ablation, summarise_ablation
    from springbench.harness.report.charts.ablation_charts import build_effect_chart
    from springbench.harness.report.figures.chart_sheets import draw_chart_sheets
    from springbench.harness.report.site import refresh_results_page
    from springbench.harness.results.folder_ownership import claim_folder

    if all_solvers:
        if solver is not None or with_pairs:
            raise InputError("--all-solvers: cannot be combined with --solver or --with-pairs; omit them")
        _measure_overheads(context, scene, results, size, rerun, rerun_stale, in_process)
        return
    usual = {"rounds": DEFAULT_NUM_ROUNDS, "threads": 1} | ({} if solver else {"rtol": DEFAULT_ABLATION_TOLERANCE})
    sweep = load_config(
        scene, solvers=[solver or DEFAULT_ABLATION_SOLVER], sizes=[size] if size else [], **usual | context.obj
    )
    folder = claim_folder(results / sweep.name, scene)
    path = run_ablation(
        sweep,
        folder,
        create_display(get_error_console()),
        print_message,
        with_pairs=with_pairs,
        rerun=rerun,
        rerun_stale=rerun_stale,
        isolated=not in_process,
    )
    rows = read_ablation(path)
    if rows[0]["status"] != "ok":  # the first row is that of the whole scene, with which the others are compared
        print_message(f"{sweep.name}: {rows[0]['status']}: {rows[0]['reason']}")
        raise typer.Exit(1)
    get_output_console().print(split_wide_table(build_ablation_table(rows)))
    for line in summarise_ablation(rows):
        print_message(line)
    paths = draw_chart_sheets(build_effect_chart({path.stem: rows}), folder / "pictures" / f"ablation-{path.stem}")
    print_message(f"rows are in {path}" + (f", the picture is {paths[0]}" if paths else ""))
    refresh_results_page(results, folder, print_message)


def _measure_overheads(
    context: typer.Context,
    scene: Path,
    results: Path,
    size: int | None,
    rerun: bool,
    rerun_stale: bool,
    in_process: bool,
) -> None:
    """Run `--all-solvers`."""
    from springbench.harness.config.config_loader import load_config
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.ablation.overhead_unit import measure_all_overheads
    from springbench.harness.report.ablation_summary import build_overhead_table, read_ablation
    from springbench.harness.report.site import refresh_results_page
    from springbench.harness.results.folder_ownership import claim_folder
    from springbench.solvers.registry import SOLVERS, load_target

    minimising = [name for name, target in SOLVERS.items() if load_target(target).is_minimiser]
    usual = {"rounds": DEFAULT_NUM_ROUNDS, "threads": 1, "rtol": DEFAULT_OVERHEAD_TOLERANCE}
    sweep = load_config(scene, solvers=minimising, sizes=[size] if size else [], **usual | context.obj)
    folder = claim_folder(results / sweep.name, scene)
    paths = measure_all_overheads(
        sweep,
        folder,
        create_display(get_error_console()),
        print_message,
        rerun=rerun,
        rerun_stale=rerun_stale,
        isolated=not in_process,
    )
    get_output_console().print(
        split_wide_table(build_overhead_table([row for path in paths for row in read_ablation(path)]))
    )
    print_message(f"rows are in {paths[0].parent}")
    refresh_results_page(results, folder, print_message)
