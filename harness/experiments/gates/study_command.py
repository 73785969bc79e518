"""`springbench gate-study`: record turns, and replay the gates' rule over what was recorded."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Annotated

import typer

from harness.base.console import out, say
from harness.base.errors import InputError

study = typer.Typer(help="How often gates are wrong, and what they find.", no_args_is_help=True)

CASES = ((1.0, 1.03), (1.1, 1.03), (1.05, 1.03), (1.02, 1.01))
"""Slowdowns, the first of none, and the limits of the gates that are to see them."""


@study.command()
def record(
    samples: Annotated[Path, typer.Argument(help="Where to store the turns (.parquet).")],
    config: Annotated[Path, typer.Argument(help="A scene or a sweep, whose runs take turns with themselves.")],
    condition: Annotated[str, typer.Option(help="What is to run beside it: nothing, busy, bursty.")] = "nothing",
    seconds: Annotated[float, typer.Option(help="For each run.")] = 1800.0,
    starts: Annotated[int, typer.Option(help="Pairs of processes for each run.")] = 10,
    size: Annotated[list[int] | None, typer.Option(help="For a scene: mesh sizes; repeatable.")] = None,
    solver: Annotated[list[str] | None, typer.Option(help="For a scene: solvers; repeatable.")] = None,
    planted: Annotated[float, typer.Option(help="Extra work of one of the two, as a part of its iterations.")] = 0.0,
) -> None:
    """Let two processes of this checkout take turns, and store every time."""
    from harness.experiments.gates import revisions
    from harness.experiments.gates.against import requests_of_config
    from harness.experiments.gates.pair import Side
    from harness.experiments.gates.study import record as record_turns

    checkout = revisions.root(Path.cwd())
    sides = Side("the one", checkout), Side("the other", checkout)
    requests = requests_of_config(sides, config, {"solvers": solver or [], "sizes": size or []})
    record_turns(samples, checkout, requests, condition, seconds=seconds, starts=starts, planted=planted)
    say(f"turns are in {samples}")


@study.command()
def replay(
    samples: Annotated[list[Path], typer.Argument(help="Recorded turns (.parquet).")],
    replays: Annotated[int, typer.Option(help="Comparisons of each kind.")] = 10_000,
    budget: Annotated[float, typer.Option(help="Seconds of a gate; 300 for slowdowns of 2 %.")] = 120.0,
) -> None:
    """Print how often gates would have failed, held and not known, beside what others would have said."""
    from rich.table import Table

    from harness.experiments.gates import study as of
    from harness.experiments.gates.sequential import Rule

    if missing := [str(path) for path in samples if not path.is_file()]:
        raise InputError(f"{', '.join(missing)}: no such file; `springbench gate-study record` makes one")
    table = Table(
        "gate", "beside it", "load", "slower", "limit", "fails", "holds", "cannot tell", "median s", *of.OTHERS
    )
    for (gate, condition), starts in of.read(samples).items():
        for slower, limit in CASES:
            room = max(budget, 300.0) if limit < 1.02 else budget
            found = of.replay(starts, slower, Rule(limit), room, replays)
            others = [of.replay_other(rule, starts, slower, room / 2, replays // 10) for rule in of.OTHERS.values()]
            parts = [f"{part:.2%}" for part in (found.fails, found.holds, found.undecided)]
            load = f"{median(start.load for start in starts):.1f}"
            cells = [gate, condition, load, f"{slower - 1:.0%}", f"{limit - 1:.0%}", *parts, f"{found.seconds:.1f}"]
            table.add_row(*cells, *(f"{part:.1%}" for part in others))
    out().print(table)
