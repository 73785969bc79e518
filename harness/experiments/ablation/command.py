"""Command `springbench ablate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness.base.commands import Again, Changed, InThisProcess, Results
from harness.base.console import err, narrow, out, say

SOLVER, TOLERANCE = "hybrid", 1e-4
"""Default solver, which supports all effects, and its tolerance.

It converges far enough that the solver's own error does not hide the change from an effect.
"""

PRICED = 1e-6
"""Default tolerance of --all-solvers: it includes iterations far from the minimum and close to it."""

ROUNDS = 5
"""Default number of times that each step is timed."""


def ablate(
    given: typer.Context,
    scene: Annotated[Path, typer.Argument(help="A scene (YAML), or an assignment's scene (JSON).")],
    results: Results = Path("results"),
    solver: Annotated[str | None, typer.Option(help=f"{SOLVER}, to {TOLERANCE:g}, if left out.")] = None,
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default if left out.")] = None,
    pairs: Annotated[bool, typer.Option("--pairs", help="Leave out each pair of effects too.")] = False,
    all_solvers: Annotated[
        bool, typer.Option("--all-solvers", help="What each effect alone adds to an iteration, by every solver.")
    ] = False,
    again: Again = False,
    changed: Changed = False,
    here: InThisProcess = False,
) -> None:
    """Measure the cost and the influence of each effect, and suggest missing ones."""
    from harness.base.claim import claimed
    from harness.base.progress import display
    from harness.config.load import load_any
    from harness.experiments.ablation.unit import run_ablation
    from harness.report.ablation import ablation_table, read, sentences
    from harness.report.ablation_plot import draw_ablation
    from harness.report.site import keep

    if all_solvers:
        _prices(given, scene, results, solver, size, pairs, again, changed, here)
        return
    usual = {"rounds": ROUNDS, "threads": 1} | ({} if solver else {"tolerance": TOLERANCE})
    sweep = load_any(scene, solvers=[solver or SOLVER], sizes=[size] if size else [], **usual | given.obj)
    folder = claimed(results / sweep.name, scene)
    how = {"pairs": pairs, "again": again, "changed": changed, "isolated": not here}
    path = run_ablation(sweep, folder, display(err()), say, **how)
    rows, picture = read(path), folder / "pictures" / f"ablation-{path.stem}.png"
    if rows[0]["status"] != "ok":  # of the whole scene, with which all others are compared
        say(f"{sweep.name}: {rows[0]['status']}: {rows[0]['reason']}")
        raise typer.Exit(1)
    out().print(narrow(ablation_table(rows)))
    for line in sentences(rows):
        say(line)
    picture.parent.mkdir(parents=True, exist_ok=True)
    draw_ablation(rows, picture)
    say(f"rows are in {path}, the picture is {picture}")
    keep(results, folder, say)


def _prices(
    given: typer.Context,
    scene: Path,
    results: Path,
    solver: str | None,
    size: int | None,
    pairs: bool,
    again: bool,
    changed: bool,
    here: bool,
) -> None:
    """Run `--all-solvers`."""
    from harness.base.claim import claimed
    from harness.base.errors import InputError
    from harness.base.progress import display
    from harness.config.load import load_any
    from harness.experiments.ablation.price_unit import price_all
    from harness.report.ablation import price_table, read
    from harness.report.site import keep
    from solvers.registry import SOLVERS, load

    if solver is not None or pairs:
        raise InputError("--all-solvers: takes neither --solver nor --pairs; leave them out, or do without it")
    minimising = [name for name, target in SOLVERS.items() if load(target).minimises]
    usual = {"rounds": ROUNDS, "threads": 1, "tolerance": PRICED}
    sweep = load_any(scene, solvers=minimising, sizes=[size] if size else [], **usual | given.obj)
    folder = claimed(results / sweep.name, scene)
    paths = price_all(sweep, folder, display(err()), say, again=again, changed=changed, isolated=not here)
    out().print(narrow(price_table([row for path in paths for row in read(path)])))
    say(f"rows are in {paths[0].parent}")
    keep(results, folder, say)
