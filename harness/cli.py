"""Command line: `springbench run`, `speed`, `accuracy`, `recommend`, `list`, `query`, `schema`, `inspect` and more.

Exit codes: 0 success, 1 a failed run or a performance regression, 2 a mistake of the user, 3 an inconclusive regression
test, 130 stopped by Ctrl-C.
"""

from __future__ import annotations

import json
import os
import sys
from copy import copy
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from harness.base.commands import Again, Changed, Check, Commands, Error, Horizon, InThisProcess, Peers, Results, Rows
from harness.base.console import err, narrow, out
from harness.base.console import say as _say
from harness.base.errors import InputError, Mistake
from harness.config.command_line import taking
from harness.experiments.ablation.command import ablate
from harness.experiments.accuracy.command import recommend
from harness.experiments.archive.command import compact, merge, publish, verify
from harness.experiments.asked.goals_command import goals
from harness.experiments.figure import figure
from harness.experiments.gallery import gallery
from harness.experiments.gates.command import gate
from harness.experiments.gates.history_command import history
from harness.experiments.gates.study_command import study
from harness.experiments.listing import list_command
from harness.experiments.repeat import repeat
from harness.experiments.show import show
from harness.experiments.speed.command import speed

if TYPE_CHECKING:
    import pyarrow as pa

    from harness.config.load import Sweep

app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

Config = Annotated[Path, typer.Argument(help="A sweep or a scene (YAML), or an assignment's scene (JSON).")]
Recordings = Annotated[list[Path], typer.Argument(help="Recordings (.rrd), or folders of them.")]


def _print_version(asked: bool) -> None:
    if asked:
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


@app.command(cls=taking())
def run(
    given: typer.Context,
    config: Config,
    results: Results = Path("results"),
    solver: Annotated[
        list[str] | None, typer.Option(help="For a scene: solvers, the recommended one if left out; repeatable.")
    ] = None,
    size: Annotated[list[int] | None, typer.Option(help="For a scene: mesh sizes; repeatable.")] = None,
    error: Error = None,
    horizon: Horizon = None,
    check: Check = False,
    peers: Peers = False,
    positions: Annotated[
        Path | None, typer.Option(help="Store the positions after every step (float64, .npz) of one run.")
    ] = None,
    again: Again = False,
    changed: Changed = False,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="How many processes do runs; one is timed at a time.")
    ] = None,
    on: Annotated[
        str | None, typer.Option(help="Do runs by Dask: a scheduler's address, local:N, or a batch system's file.")
    ] = None,
    here: InThisProcess = False,
) -> None:
    """Run what is missing of a sweep, or of the one scene in a file."""
    from harness.base.claim import claimed
    from harness.base.progress import display
    from harness.config.load import load_any
    from harness.experiments.sweep import run_sweep

    _check_positions(positions)
    of_error = {"horizon": horizon, "check": check, "peers": peers}
    if error is not None:
        from harness.experiments.asked.command import run_to_error

        others = {"solver": solver, "on": on, "workers": workers, **given.obj}
        wanted: dict[str, Any] = {"sizes": size or (), "positions": positions, "again": again, "others": others}
        raise typer.Exit(0 if run_to_error(config, error, results, _say, **of_error, **wanted) else 1)
    if unfit := next((key for key, value in of_error.items() if value), None):
        raise InputError(Mistake("is of a run with --error; leave it out", key=f"--{unfit}"))
    sweep = load_any(config, solvers=solver or (), sizes=size or (), **given.obj)
    folder = claimed(results / sweep.name, config)
    how: dict[str, Any] = {"again": again, "changed": changed, "positions": positions, "isolated": not here}
    how |= {"at_once": workers, "on": on, "meanwhile": _load_what_tells}
    table = run_sweep(sweep.name, sweep.runs(), folder, display(err()), _say, **how)
    raise typer.Exit(1 if _told(sweep, table, config, results, folder) else 0)


def _load_what_tells() -> None:
    """Import the modules of `_told`, which takes as long as drawing a picture."""
    from harness.base.machine_lock import beside

    with beside(lambda said: None):
        import_module("harness.report.learned")
        import_module("harness.report.site")


def _told(sweep: Sweep, table: pa.Table, config: Path, results: Path, folder: Path) -> list[str]:
    """Report the results of a sweep, and return its failures.

    It prints the summary and draws the reports. The failures are one line for each failed run.
    """
    from harness.experiments.plan import of_other_code
    from harness.experiments.sweep import failures
    from harness.report.learned import closing
    from harness.report.named import draw_reports
    from harness.report.site import keep
    from harness.report.timing_table import summary_table

    out().print(summary_table(table, of_other_code(sweep.runs(), table)))
    _say(f"rows, recordings and pictures are in {folder}")
    for path in draw_reports(sweep.reports, table, folder, sweep.options.time_limit):
        _say(f"reported in {path}")
    keep(results, folder, _say, quiet=True)
    failed = failures(table)
    for line in (*failed, *closing(table, config, results, folder)):
        _say(line)
    return failed


@app.command()
def accuracy(
    config: Annotated[Path, typer.Argument(help="An accuracy config (YAML).")],
    results: Results = Path("results"),
    again: Again = False,
    changed: Changed = False,
    here: InThisProcess = False,
) -> None:
    """Measure work and precision: convergence on single steps, and errors of whole simulations."""
    from harness.base.claim import claimed
    from harness.base.progress import display
    from harness.config.accuracy_load import load_accuracy
    from harness.experiments.accuracy.studies import failures, run_accuracy
    from harness.report.accuracy import draw
    from harness.report.site import keep

    asked = load_accuracy(config)
    folder = claimed(results / asked.name, config)
    files = run_accuracy(asked, folder, display(err()), _say, again=again, changed=changed, isolated=not here)
    drawn = draw(folder, files)
    _say(f"rows are in {folder / 'accuracy'}; {len(drawn)} pictures and tables tell of them")
    keep(results, folder, _say)
    failed = failures(files)
    for line in failed:
        _say(line)
    raise typer.Exit(1 if failed else 0)


@app.command()
def report(
    results: Annotated[Path, typer.Argument(help="A folder of results, or that of one sweep.")] = Path("results"),
    viewer: Annotated[
        bool, typer.Option("--viewer/--without-viewer", help="Put Rerun's viewer into the page, 19 MB.")
    ] = True,
) -> None:
    """Write the page of all results, `index.html`, and maps of solvers x cases.

    The maps show the verified runs. Runs on a device also get a picture of the time that the device saves.
    """
    from harness.experiments.older import older_of
    from harness.report.devices_plot import draw_devices
    from harness.report.robustness import summary
    from harness.report.robustness_map import draw_maps
    from harness.report.site import update

    for picture, words in draw_devices(results):
        for line in words:
            _say(line)
        if picture:
            _say(f"what a device saves is drawn in {picture}")
    page = update(results, recorded=True, viewer=viewer, say=_say)
    for picture, cells in draw_maps(results, older_of):
        out().print(narrow(summary(cells)))
        _say(f"the map is {picture}")
    _say(f"the page is {page}; a browser opens it, and needs no network for it")


app.command(cls=taking("frames", "iterations", "tolerance", "rounds"))(ablate)
app.command("list")(list_command)
app.command()(speed)
app.command()(recommend)
app.command()(repeat)
app.command()(goals)
app.command()(compact)
app.command()(merge)
app.command()(publish)
app.command()(verify)
app.command()(figure)
app.command()(gallery)
app.command()(show)
app.command()(gate)
app.command()(history)
app.add_typer(study, name="gate-study")


@app.command()
def query(
    sql: Annotated[str, typer.Argument(help="A query over the tables `rows`, `accuracy`, `ablation`.")],
    results: Rows = Path("results"),
    csv: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
    seconds: Annotated[float, typer.Option(help="Processor time that the answer may take.")] = 15.0,
) -> None:
    """Run an SQL query over the rows of all sweeps."""
    from harness.report.machines import COMPARE
    from harness.report.query import PRINTED, SHOWN, answer

    found = answer(sql, results, most=PRINTED if csv else SHOWN, seconds=seconds)
    if found.more:
        more = "" if csv else "; --csv prints more"
        _say(f"only the first {len(found.values):,} rows of the answer are shown{more}")
    if csv:
        found.write_csv(sys.stdout)
    else:
        out().print(found.table())
        out().print(f"columns machine and node: {COMPARE}")


@app.command()
def schema() -> None:
    """Print the JSON Schema of scenes and sweeps."""
    from harness.config.schema import schema as config_schema

    print(json.dumps(config_schema(), indent=2))


@app.command()
def inspect(
    recordings: Recordings,
    frame: Annotated[int | None, typer.Option(help="The frame to export; the last one if left out.")] = None,
    export: Annotated[Path | None, typer.Option(help="Write one frame's mesh to this file (.vtp, ...).")] = None,
    csv: Annotated[Path | None, typer.Option(help="Write the scalars to this file.")] = None,
) -> None:
    """Print the content of recordings without a viewer, or compare two of them."""
    from harness.report.inspect import inspect as inspect_recordings

    inspect_recordings(recordings, frame=frame, export=export, csv=csv, console=out())


@app.command()
def view(recordings: Recordings) -> None:
    """Open recordings in the Rerun viewer."""
    from harness.report.inspect import view as view_recordings

    view_recordings(recordings)


def _check_positions(path: Path | None) -> None:
    if path and (path.suffix != ".npz" or not path.parent.is_dir() or (path.exists() and not path.is_file())):
        raise InputError(f"--positions: came {path}; wanted a file that ends in .npz, in a folder that exists")


def main() -> None:
    """Run the command that the arguments name."""
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # it would look for some in every installed package
    # Typer builds the parsers of all registered commands, which takes a tenth of the time of `list`.
    one = copy(app)
    asked = [c for c in app.registered_commands if c.callback and (c.name or c.callback.__name__) in sys.argv[1:2]]
    one.registered_commands = asked or app.registered_commands
    one(prog_name="springbench")
