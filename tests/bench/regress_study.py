"""The command `springbench regress-study`: record blocks, replay the tests over them, and run real tests."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated

import typer
from springbench.harness.console import get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError

if TYPE_CHECKING:
    from springbench.harness.experiments.regression.revision_comparison import WorkRequest

regress_study = typer.Typer(help="How often gates are wrong, and what they find.", no_args_is_help=True)

SLOWDOWN_CASES = ((1.0, 1.03), (1.1, 1.03), (1.05, 1.03), (1.02, 1.01))
"""Slowdowns, the first of none, and the limits of the tests that should detect them."""


StudyConfigArgument = Annotated[Path, typer.Argument(help="A scene or a sweep, whose runs take turns with themselves.")]
BackgroundLoad = Annotated[str, typer.Option(help="What is to run beside it: nothing, busy, bursty.")]
MeshSizes = Annotated[list[int] | None, typer.Option("--size", help="For a scene: mesh sizes; repeatable.")]
SolverNames = Annotated[list[str] | None, typer.Option("--solver", help="For a scene: solvers; repeatable.")]
InjectedSlowdown = Annotated[float, typer.Option(help="Extra work of one of the two, as a part of its iterations.")]


def _build_requests(
    config: Path, sizes: list[int] | None, solvers: list[str] | None
) -> tuple[Path, Sequence[WorkRequest]]:
    """Return the checkout, and a request for each of the config's runs; raise InputError."""
    from springbench.harness.experiments.regression import git_worktrees
    from springbench.harness.experiments.regression.revision_comparison import build_config_requests
    from springbench.harness.experiments.regression.revision_process import GitRevision

    checkout = git_worktrees.find_checkout(Path.cwd())
    sides = GitRevision("the one", checkout), GitRevision("the other", checkout)
    return checkout, build_config_requests(sides, config, {"solvers": solvers or [], "sizes": sizes or []})


@regress_study.command()
def record(
    samples: Annotated[Path, typer.Argument(help="Where to store the turns (.parquet); those there are kept.")],
    config: StudyConfigArgument,
    condition: BackgroundLoad = "nothing",
    seconds: Annotated[float, typer.Option(help="For all runs together, which take turns.")] = 1800.0,
    starts: Annotated[int, typer.Option(help="Pairs of processes for each run.")] = 10,
    sizes: MeshSizes = None,
    solvers: SolverNames = None,
    planted: InjectedSlowdown = 0.0,
) -> None:
    """Record the times of two processes of this checkout in interleaved blocks."""
    from springbench.harness.experiments.regression.replay_study import record_blocks as record_turns

    checkout, requests = _build_requests(config, sizes, solvers)
    record_turns(
        samples, checkout, requests, condition, duration=seconds, num_process_pairs=starts, injected_slowdown=planted
    )
    print_message(f"turns are in {samples}")


@regress_study.command()
def live(
    output: Annotated[Path, typer.Argument(help="Where the answers are stored (.parquet); those there are kept.")],
    config: StudyConfigArgument,
    gates: Annotated[int, typer.Option(help="How many gates are held of each run.")] = 100,
    condition: BackgroundLoad = "nothing",
    limit: Annotated[float, typer.Option(help="The ratio of times from which on something counts as slower.")] = 1.03,
    budget: Annotated[float, typer.Option(help="Seconds of a gate.")] = 240.0,
    sizes: MeshSizes = None,
    solvers: SolverNames = None,
    planted: InjectedSlowdown = 0.0,
) -> None:
    """Run real tests with restarted processes, and print how many passed, failed and were inconclusive."""
    from rich.table import Table
    from springbench.harness.experiments.regression.live_study import run_live_study, summarise_live_study
    from springbench.harness.experiments.regression.revision_comparison import ComparisonOptions

    checkout, requests = _build_requests(config, sizes, solvers)
    run_live_study(
        output,
        checkout,
        requests,
        condition,
        ComparisonOptions(budget, limit),
        num_repeats=gates,
        injected_slowdown=planted,
        print_message=print_message,
    )
    told = "beside it", "load", "planted", "limit", "gates", "fails", "holds", "cannot tell", "median s"
    for gate, rows in groupby(sorted(summarise_live_study(output), key=itemgetter(0)), key=itemgetter(0)):
        table = Table(*told, title=gate)
        for _, *cells in rows:
            table.add_row(*cells)
        get_output_console().print(split_wide_table(table))


@regress_study.command()
def replay(
    samples: Annotated[list[Path], typer.Argument(help="Recorded turns (.parquet).")],
    replays: Annotated[int, typer.Option(help="Comparisons of each kind.")] = 10_000,
    budget: Annotated[float, typer.Option(help="Seconds of a gate; 300 for slowdowns of 2 %.")] = 240.0,
) -> None:
    """Print the rates of the verdicts of replayed tests, compared with other benchmark tools."""
    from rich.table import Table
    from springbench.harness.experiments.regression import replay_study as of
    from springbench.harness.experiments.regression.confidence_sequence import SequentialTest

    if missing := [str(path) for path in samples if not path.is_file()]:
        raise InputError(f"{', '.join(missing)}: no such file; `springbench regress-study record` makes one")
    told = "slower", "limit", "fails", "holds", "cannot tell", "median s", *of.OTHER_COMPARISONS
    for (gate, condition), starts in of.read_recorded_blocks(samples).items():
        load = f"{median(start.load_average for start in starts):.1f}"
        table = Table(*told, title=f"{gate}\nbeside it: {condition}; load {load}")
        for slower, limit in SLOWDOWN_CASES:
            room = max(budget, 300.0) if limit < 1.02 else budget
            found = of.replay_tests(starts, slower, SequentialTest(limit), room, replays)
            others = [
                of.replay_comparison(rule, starts, slower, room / 2, replays // 10)
                for rule in of.OTHER_COMPARISONS.values()
            ]
            parts = [f"{part:.2%}" for part in (found.fail_rate, found.pass_rate, found.inconclusive_rate)]
            cells = [f"{slower - 1:.0%}", f"{limit - 1:.0%}", *parts, f"{found.median_seconds:.1f}"]
            table.add_row(*cells, *(f"{part:.1%}" for part in others))
        get_output_console().print(split_wide_table(table))
