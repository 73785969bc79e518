"""Command `springbench speed`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from harness.base.commands import Again, Changed, InThisProcess, Results
from harness.base.console import err, narrow, out, say
from harness.base.errors import InputError, Mistake


def speed(
    config: Annotated[Path, typer.Argument(help="A sweep (YAML).")],
    results: Results = Path("results"),
    budget: Annotated[float, typer.Option(help="Seconds that a candidate may take at a size.")] = 210.0,
    again: Again = False,
    changed: Changed = False,
    here: InThisProcess = False,
) -> None:
    """Time a sweep's solvers interleaved, with a C++ baseline and roofline microbenchmarks."""
    from harness.base.claim import claimed
    from harness.base.progress import display
    from harness.config.load import load_sweep, require_stated
    from harness.config.options import AUTO
    from harness.experiments.speed.comparison import run_speed
    from harness.report.site import keep
    from harness.report.speed.figures import figures
    from harness.report.speed.pictures import draw
    from harness.report.speed.speed_table import remarks, speed_table

    if not 0.0 < budget < math.inf:
        raise InputError(Mistake(f"came {budget:g}; wanted a number of seconds above 0", key="--budget"))
    sweep = load_sweep(config)
    require_stated(sweep.runs())
    if any(run.tolerance == AUTO for run in sweep.runs()):
        raise InputError(Mistake("needs the steps before; give a number, or null", config, key="tolerance"))
    folder = claimed(results / sweep.name, config)
    how = {"again": again, "changed": changed, "isolated": not here}
    found = figures(run_speed(sweep, folder, display(err()), say, budget=budget, **how))
    out().print(narrow(speed_table(found), beside=2))
    for line in remarks(found):
        say(line)
    draw(found, folder / "pictures")
    say(f"rows and pictures are in {folder}")
    keep(results, folder, say)
    raise typer.Exit(1 if any(f.status in ("failed", "diverged") for f in found) else 0)
