"""Command line: `springbench run`, `roofline`, `accuracy`, `recommend`, `list`, `query`, `schema`, `inspect` and more.

Exit codes: 0 success, 1 a failed run or a performance regression, 2 a mistake of the user, 3 an inconclusive regression
test, 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import sys
from copy import copy
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from springbench.harness.cli.commands.ablate import ablate
from springbench.harness.cli.commands.archive import compact, merge, publish, verify_archive
from springbench.harness.cli.commands.convergence import convergence
from springbench.harness.cli.commands.export_script import export_script
from springbench.harness.cli.commands.figure import figure
from springbench.harness.cli.commands.gallery import gallery
from springbench.harness.cli.commands.grade import grade
from springbench.harness.cli.commands.list_runs import list_command
from springbench.harness.cli.commands.matrices import matrices
from springbench.harness.cli.commands.mesh import mesh
from springbench.harness.cli.commands.new_study import new_study
from springbench.harness.cli.commands.pages import pages
from springbench.harness.cli.commands.preview import preview
from springbench.harness.cli.commands.published import compare, publish_study, reproduce
from springbench.harness.cli.commands.recommend import recommend
from springbench.harness.cli.commands.regress import regress
from springbench.harness.cli.commands.roofline import roofline
from springbench.harness.cli.commands.validate import validate
from springbench.harness.cli.shared_options import (
    CompareOption,
    EndTimeOption,
    ErrorOption,
    ErrorReportingGroup,
    InProcessOption,
    RerunOption,
    RerunStaleOption,
    ResultsOption,
    RowsOption,
    VerifyOption,
    build_command_class,
    describe_config,
    require_output_file,
)
from springbench.harness.console import (
    get_error_console,
    get_output_console,
    print_message,
    show_activity,
    split_wide_table,
)
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.optional_parts import RECORDINGS
from springbench.solvers.platform_calls import can_isolate_processes

if TYPE_CHECKING:
    from springbench.harness.config.config_loader import SweepPlan
    from springbench.harness.experiments.sweep_runner import SweepResults

app = typer.Typer(
    cls=ErrorReportingGroup,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ConfigArgument = Annotated[
    Path,
    describe_config("CONFIG", "Sweep or scene (YAML), or scene of the assignment (JSON), or name of a shipped config."),
]
RecordingsArgument = Annotated[list[Path], typer.Argument(help="Recordings (.rrd) or folders of them.")]


def _print_version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        print(f"springbench {version('springbench')}")
        raise typer.Exit


@app.callback()
def main_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """A laboratory for implicit time stepping of mass-spring systems."""


@app.command(cls=build_command_class())
def run(
    context: typer.Context,
    config: ConfigArgument,
    results: ResultsOption = Path("results"),
    solver: Annotated[
        list[str] | None, typer.Option(help="For a scene: solver; repeatable. The recommended one by default.")
    ] = None,
    size: Annotated[list[int] | None, typer.Option(help="For a scene: mesh size; repeatable.")] = None,
    max_error: ErrorOption = None,
    t_end: EndTimeOption = None,
    verify: VerifyOption = False,
    compare: CompareOption = False,
    positions: Annotated[
        Path | None, typer.Option(help="File (.npz) for the positions of one run after each step, float64.")
    ] = None,
    rerun: RerunOption = False,
    rerun_stale: RerunStaleOption = False,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Number of worker processes; one run is timed at a time.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Run on Dask: address of a scheduler, local:N, or file of a batch system.")
    ] = None,
    in_process: InProcessOption = False,
) -> None:
    """Run the missing runs of a sweep, or of one scene."""
    from springbench.harness.config.config_loader import load_config

    require_output_file(positions, ".npz", "--positions")
    with_error = {"t_end": t_end, "verify": verify, "compare": compare}
    if max_error is not None:
        from springbench.harness.cli.commands.error_control import ErrorRequest, run_error_control

        is_accurate = run_error_control(
            config,
            ErrorRequest(
                error=max_error,
                t_end=t_end,
                size=size[0] if size else None,
                verify=verify,
                compare_third_party=compare,
                positions=positions,
                rerun=rerun,
            ),
            results,
            print_message,
            {
                "solver": solver,
                "scheduler": scheduler,
                "workers": workers,
                **context.obj,
                "size (more than one)": (size or [])[1:],
            },
        )
        raise typer.Exit(0 if is_accurate else 1)
    if name := next((name for name, value in with_error.items() if value), None):
        key = f"--{name.replace('_', '-')}"
        raise InputError(InputMistake("applies only to a run with --error; leave it out", key=key))
    sweep = load_config(config, solvers=solver or (), sizes=size or (), **context.obj)
    runs = sweep.list_runs()
    if any(one.threads == "auto" for one in runs):
        from springbench.harness.execution.machine_info import start_load_sample

        start_load_sample()
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.sweep_runner import ExecutionOptions, run_sweep
    from springbench.harness.results.folder_ownership import claim_folder

    if not in_process and not can_isolate_processes():
        print_message("runs share this process, without limits of time and memory: worker processes need Linux")
    if sweep.options.record and not RECORDINGS.is_installed():
        print_message(f"nothing is recorded, and no pictures are drawn: {RECORDINGS.describe_absence()}")
    folder = claim_folder(results / sweep.name, config)
    swept = run_sweep(
        sweep.name,
        runs,
        folder,
        create_display(get_error_console()),
        print_message,
        ExecutionOptions(
            rerun=rerun,
            rerun_stale=rerun_stale,
            positions=positions,
            isolated=not in_process,
            num_workers=workers,
            scheduler_address=scheduler,
        ),
        background_call=_preload_reports,
    )
    raise typer.Exit(1 if _report_sweep(sweep, swept, config, results, folder) else 0)


def _preload_reports() -> None:
    """Import the modules of `_report_sweep`, which takes as long as drawing a picture."""
    from springbench.harness.execution.progress_events import ignore_progress
    from springbench.harness.execution.timing_lock import lock_timing_shared

    with lock_timing_shared(ignore_progress):
        import_module("springbench.harness.report.sweep_summary")
        import_module("springbench.harness.report.site.sweep_overview")


def _report_sweep(sweep: SweepPlan, swept: SweepResults, config: Path, results: Path, folder: Path) -> list[str]:
    """Report the results of a sweep, and return its failures.

    It prints the summary and draws the reports. The failures are one line for each failed run.
    """
    from springbench.harness.experiments.sweep_runner import list_failed_runs
    from springbench.harness.report.report_plugins import run_reports
    from springbench.harness.report.site import refresh_results_page
    from springbench.harness.report.sweep_summary import build_closing_lines
    from springbench.harness.report.timing_table import build_summary_table, read_run_times

    table = swept.table
    timed_runs = read_run_times(table)
    get_output_console().print(build_summary_table(timed_runs, table, swept.stale_ids))
    print_message(f"rows, recordings and pictures are in {folder}")
    for path in run_reports(sweep.reports, table, folder, sweep.options.time_limit):
        print_message(f"reported in {path}")
    refresh_results_page(results, folder, print_message, is_quiet=True)
    failed = list_failed_runs(table)
    for line in (*failed, *build_closing_lines(timed_runs, config, results, folder)):
        print_message(line)
    return failed


@app.command()
def accuracy(
    config: Annotated[Path, describe_config("CONFIG", "Accuracy config (YAML), or name of a shipped one.")],
    results: ResultsOption = Path("results"),
    rerun: RerunOption = False,
    rerun_stale: RerunStaleOption = False,
    in_process: InProcessOption = False,
) -> None:
    """Measure work and precision: convergence on single steps, and errors of whole simulations."""
    from springbench.harness.config.accuracy_loader import load_accuracy
    from springbench.harness.execution.progress_display import create_display
    from springbench.harness.experiments.accuracy.accuracy_study import list_failed_units, run_accuracy_study
    from springbench.harness.report.accuracy_report import draw_accuracy_report
    from springbench.harness.report.site import refresh_results_page
    from springbench.harness.results.folder_ownership import claim_folder

    plan = load_accuracy(config)
    folder = claim_folder(results / plan.name, config)
    files = run_accuracy_study(
        plan,
        folder,
        create_display(get_error_console()),
        print_message,
        rerun=rerun,
        rerun_stale=rerun_stale,
        isolated=not in_process,
    )
    drawn = draw_accuracy_report(folder, files)
    print_message(f"rows are in {folder / 'accuracy'}; {len(drawn)} pictures and tables show them")
    refresh_results_page(results, folder, print_message)
    failed = list_failed_units(files)
    for line in failed:
        print_message(line)
    raise typer.Exit(1 if failed else 0)


@app.command()
def report(
    results: Annotated[Path, typer.Argument(help="Folder of results, or of one sweep.")] = Path("results"),
    viewer: Annotated[
        bool, typer.Option("--viewer/--no-viewer", help="Include the Rerun viewer in the page (19 MB).")
    ] = True,
) -> None:
    """Write the page of all results, `index.html`, and maps of solvers x cases.

    The maps show the verified runs. Runs on a device also get a picture of the time that the device saves.
    """
    from springbench.harness.experiments.stale_results import find_stale_runs_in_folder
    from springbench.harness.report.robustness import build_score_table
    from springbench.harness.report.site import update_page
    from springbench.harness.report.sweep_sheets import draw_device_sheets, draw_hard_case_sheets

    show_activity("reading the rows")
    for picture, words in draw_device_sheets(results):
        for line in words:
            print_message(line)
        if picture:
            print_message(f"what a device saves is drawn in {picture}")
    show_activity("writing the page")
    page = update_page(results, with_recordings=True, with_viewer=viewer, print_message=print_message)
    for picture, cells in draw_hard_case_sheets(results, find_stale_runs_in_folder):
        get_output_console().print(split_wide_table(build_score_table(cells)))
        print_message(f"the map is {picture}")
    print_message(f"the page is {page}; a browser opens it, and needs no network for it")


app.command(cls=build_command_class("frames", "max_iterations", "rtol", "rounds"))(ablate)
app.command("list")(list_command)
app.command("new")(new_study)
app.command()(roofline)
app.command()(recommend)
app.command()(convergence)
app.command()(export_script)
app.command()(compact)
app.command()(merge)
app.command()(publish)
app.command()(verify_archive)
app.command()(publish_study)
app.command()(reproduce)
app.command()(compare)
app.command()(pages)
app.command()(figure)
app.command()(gallery)
app.command()(mesh)
app.command()(preview)
app.command()(validate)
app.command()(matrices)
app.command()(grade)
app.command()(regress)


@app.command()
def query(
    sql: Annotated[str, typer.Argument(help="Query over the tables `rows`, `accuracy` and `ablation`.")],
    results: RowsOption = Path("results"),
    csv: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
    cpu_limit: Annotated[float, typer.Option(help="Limit of CPU time [s].")] = 15.0,
) -> None:
    """Run an SQL query over the rows of all sweeps."""
    from springbench.harness.report.machine_footer import COMPARISON_NOTE
    from springbench.harness.report.sql_query import MAX_CSV_ROWS, MAX_SHOWN_ROWS, run_query
    from springbench.harness.results.row_store import MANY_FILES

    show_activity("executing the query")
    console = get_output_console()  # imports Rich while the process of the query starts
    found = run_query(sql, results, max_rows=MAX_CSV_ROWS if csv else MAX_SHOWN_ROWS, cpu_seconds=cpu_limit)
    if found.is_truncated:
        more = "" if csv else "; --csv prints more"
        print_message(f"only the first {len(found.values):,} rows of the result are shown{more}")
    if found.num_files >= MANY_FILES:
        print_message(f"read {found.num_files:,} files; `springbench compact {results}` packs them for faster queries")
    if csv:
        found.write_csv(sys.stdout)
    else:
        console.print(found.build_table())
        console.print(f"columns machine and node: {COMPARISON_NOTE}")


@app.command()
def schema() -> None:
    """Print the JSON Schema of scenes and sweeps."""
    from springbench.harness.cli.source_texts import print_schema

    print_schema()


@app.command()
def reference(
    folder: Annotated[Path, typer.Argument(help="Folder of the pages.")] = Path("configs/reference"),
    check: Annotated[bool, typer.Option("--check", help="Write nothing; exit with 1 if a page is stale.")] = False,
) -> None:
    """Write the reference pages: commands, config keys, columns, Python API and solvers."""
    from springbench.harness.cli.reference_pages import build_reference_pages, find_stale_pages, write_stale_pages

    pages = build_reference_pages(typer.main.get_command(app))
    paths = find_stale_pages(pages, folder) if check else write_stale_pages(pages, folder)
    for path in paths:
        print_message(f"{path}: stale" if check else f"{path}: written")
    raise typer.Exit(1 if check and paths else 0)


@app.command()
def inspect(
    recordings: RecordingsArgument,
    frame: Annotated[int | None, typer.Option(help="Frame to export; the last one by default.")] = None,
    export: Annotated[Path | None, typer.Option(help="File for the mesh of one frame (.vtp, ...).")] = None,
    csv: Annotated[Path | None, typer.Option(help="File for the scalars (CSV).")] = None,
) -> None:
    """Print the content of recordings without a viewer, or compare two of them."""
    from springbench.harness.report.recording_inspection import inspect_recordings

    inspect_recordings(recordings, frame=frame, export=export, csv=csv, console=get_output_console())


@app.command()
def view(recordings: RecordingsArgument) -> None:
    """Open recordings in the Rerun viewer."""
    from springbench.harness.report.recording_inspection import view_recordings

    view_recordings(recordings)


def main() -> None:
    """Run the command that the arguments name."""
    # Typer builds the parsers of all registered commands, which takes a tenth of the time of `list`.
    one = copy(app)
    named = [
        command
        for command in app.registered_commands
        if command.callback and (command.name or command.callback.__name__.replace("_", "-")) in sys.argv[1:2]
    ]
    one.registered_commands = named or app.registered_commands
    one(prog_name="springbench")
