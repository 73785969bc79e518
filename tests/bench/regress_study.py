"""Measure the error rates of `springbench regress` on this machine, and the slowdowns that it detects.

    python -m tests.bench.regress_study record SAMPLES CONFIG    record blocks of two processes of the same code
    python -m tests.bench.regress_study replay SAMPLES...        compute rates of verdicts of replayed tests
    python -m tests.bench.regress_study live RESULTS CONFIG      run real tests of the same code

`tests.bench.replay_study` defines blocks and replays, and `tests.bench.live_study` real tests. A verdict `fail` is
wrong without a slowdown; a verdict `pass` is wrong for a slowdown above the limit.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import pyarrow as pa
import typer
from rich.table import Table
from springbench.harness.cli.shared_options import ErrorReportingGroup
from springbench.harness.console import get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError
from springbench.harness.experiments.regression import git_worktrees
from springbench.harness.experiments.regression.confidence_sequence import SequentialTest
from springbench.harness.experiments.regression.revision_comparison import (
    ComparisonOptions,
    WorkRequest,
    build_config_requests,
)
from springbench.harness.experiments.regression.revision_process import GitRevision
from springbench.harness.results import parquet_rows
from springbench.harness.results.published_set import TABLE_FILES

from tests.bench.live_study import run_live_study, summarise_live_study
from tests.bench.replay_study import (
    OTHER_COMPARISONS,
    RECORD_SCHEMA,
    RecordedBlocks,
    read_recorded_blocks,
    record_blocks,
    replay_comparison,
    replay_tests,
)
from tests.bench.scripted_study import describe_provenance, publish_tables

app = typer.Typer(
    cls=ErrorReportingGroup,
    help="Study the error rates of regression tests.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

SLOWDOWN_CASES = ((1.0, 1.03), (1.1, 1.03), (1.05, 1.03), (1.02, 1.01))
"""Pairs of a slowdown and the largest ratio that the test accepts; 1 is no slowdown."""

StudyConfig = Annotated[Path, typer.Argument(help="A scene or a sweep, whose runs are compared with themselves.")]
BackgroundLoad = Annotated[str, typer.Option(help="Background load: nothing, busy or bursty.")]
MeshSizes = Annotated[list[int] | None, typer.Option("--size", help="For a scene: mesh sizes; repeatable.")]
SolverNames = Annotated[list[str] | None, typer.Option("--solver", help="For a scene: solvers; repeatable.")]
InjectedSlowdown = Annotated[float, typer.Option(help="Extra work of one side, as a fraction of its iterations.")]


def build_requests(
    config: Path, sizes: list[int] | None, solvers: list[str] | None
) -> tuple[Path, Sequence[WorkRequest]]:
    """Return the checkout, and a request for each of the config's runs; raise InputError."""
    checkout = git_worktrees.find_checkout(Path.cwd())
    sides = GitRevision("one side", checkout), GitRevision("the other side", checkout)
    return checkout, build_config_requests(sides, config, {"solvers": solvers or [], "sizes": sizes or []})


@app.command()
def record(
    samples: Annotated[Path, typer.Argument(help="File of the blocks (.parquet); earlier blocks in it remain.")],
    config: StudyConfig,
    background_load: BackgroundLoad = "nothing",
    duration: Annotated[float, typer.Option(help="Time of all runs together, which alternate [s].")] = 1800.0,
    process_pairs: Annotated[int, typer.Option(help="Process pairs of each run.")] = 10,
    sizes: MeshSizes = None,
    solvers: SolverNames = None,
    injected_slowdown: InjectedSlowdown = 0.0,
) -> None:
    """Record the times of two processes of this checkout in interleaved blocks."""
    checkout, requests = build_requests(config, sizes, solvers)
    record_blocks(
        samples,
        checkout,
        requests,
        background_load,
        duration=duration,
        num_process_pairs=process_pairs,
        injected_slowdown=injected_slowdown,
    )
    print_message(f"blocks are in {samples}")


@app.command()
def live(
    output: Annotated[Path, typer.Argument(help="File of the verdicts (.parquet); earlier ones in it remain.")],
    config: StudyConfig,
    repeats: Annotated[int, typer.Option(help="Tests of each run.")] = 100,
    background_load: BackgroundLoad = "nothing",
    max_ratio: Annotated[float, typer.Option(help="Ratio of times that counts as slower.")] = 1.03,
    budget: Annotated[float, typer.Option(help="Seconds of a test.")] = 240.0,
    sizes: MeshSizes = None,
    solvers: SolverNames = None,
    injected_slowdown: InjectedSlowdown = 0.0,
) -> None:
    """Run real tests with restarted processes, and count their verdicts."""
    checkout, requests = build_requests(config, sizes, solvers)
    run_live_study(
        output,
        checkout,
        requests,
        background_load,
        ComparisonOptions(budget, max_ratio),
        num_repeats=repeats,
        injected_slowdown=injected_slowdown,
        print_message=print_message,
    )
    columns = (
        "background load",
        "load average",
        "slowdown",
        "limit",
        "tests",
        "fail",
        "pass",
        "inconclusive",
        "median s",
    )
    for gate, rows in groupby(sorted(summarise_live_study(output), key=itemgetter(0)), key=itemgetter(0)):
        table = Table(*columns, title=gate)
        for _, *cells in rows:
            table.add_row(*cells)
        get_output_console().print(split_wide_table(table))


@app.command()
def replay(
    samples: Annotated[list[Path], typer.Argument(help="Recorded blocks (.parquet).")],
    replays: Annotated[int, typer.Option(help="Replayed tests of each kind.")] = 10_000,
    budget: Annotated[float, typer.Option(help="Seconds of a test; at least 300 for slowdowns of 2 %.")] = 240.0,
    publish: Annotated[Path | None, typer.Option(help="Folder of a published study for blocks and rates.")] = None,
) -> None:
    """Print the rates of the verdicts of replayed tests, compared with other benchmark tools."""
    if missing := [str(path) for path in samples if not path.is_file()]:
        raise InputError(f"{', '.join(missing)}: no such file; `record` writes one")
    rates: list[dict[str, Any]] = []
    for (gate, condition), blocks in read_recorded_blocks(samples).items():
        load = median(start.load_average for start in blocks)
        own = [
            {"benchmark": gate, "background_load": condition, "load_average": load}
            | compute_rates(blocks, slowdown, max_ratio, max(budget, 300.0) if max_ratio < 1.02 else budget, replays)
            for slowdown, max_ratio in SLOWDOWN_CASES
        ]
        get_output_console().print(split_wide_table(build_rate_table(own)))
        rates += own
    if publish:
        publish_rates(publish, samples, rates)


def compute_rates(
    blocks: Sequence[RecordedBlocks], slowdown: float, max_ratio: float, seconds: float, replays: int
) -> dict[str, Any]:
    """Compute the rates of the verdicts for one slowdown, here and by other tools."""
    found = replay_tests(blocks, slowdown, SequentialTest(max_ratio), seconds, replays)
    others = {
        name: replay_comparison(rule, blocks, slowdown, seconds / 2, replays // 10)
        for name, rule in OTHER_COMPARISONS.items()
    }
    return {"slowdown": slowdown - 1, "max_slowdown": max_ratio - 1, "num_replays": replays, **asdict(found), **others}


def build_rate_table(rates: Sequence[dict[str, Any]]) -> Table:
    """Build the printed table of one benchmark under one background load."""
    first = rates[0]
    title = (
        f"{first['benchmark']}\nbackground load: {first['background_load']}; load average {first['load_average']:.1f}"
    )
    table = Table("slower", "limit", "fail", "pass", "inconclusive", "median s", *OTHER_COMPARISONS, title=title)
    for row in rates:
        verdicts = [f"{row[name]:.2%}" for name in ("fail_rate", "pass_rate", "inconclusive_rate")]
        cells = [f"{row['slowdown']:.0%}", f"{row['max_slowdown']:.0%}", *verdicts, f"{row['median_seconds']:.1f}"]
        table.add_row(*cells, *(f"{row[name]:.1%}" for name in OTHER_COMPARISONS))
    return table


def rename_tools(row: dict[str, Any]) -> dict[str, Any]:
    """Rename the columns of other tools to identifiers of SQL: asv_continuous_1_05 and so on."""
    return {re.sub(r"\W+", "_", name).strip("_"): value for name, value in row.items()}


def publish_rates(folder: Path, samples: Sequence[Path], rates: Sequence[dict[str, Any]]) -> None:
    """Write blocks and rates as a study of the published set; the date is that of the replay."""
    tables = {
        "blocks": parquet_rows.read_rows(samples, RECORD_SCHEMA),
        "rates": pa.Table.from_pylist([rename_tools(row) for row in rates]),
    }
    moments = [describe_provenance() | {"load_average": row["load_average"]} for row in rates]
    command = f"python -m tests.bench.regress_study replay {folder / TABLE_FILES['blocks']}"
    publish_tables(folder, Path("configs/scenes/hanging-cloth.yaml"), command, tables, moments)


if __name__ == "__main__":
    app()
