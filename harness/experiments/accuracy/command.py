"""Command `springbench recommend`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness.base.commands import Results
from harness.base.console import err, narrow, out, say


def recommend(
    scene: Annotated[Path, typer.Argument(help="A scene (YAML), or an assignment's scene (JSON).")],
    error: Annotated[float, typer.Option(help="The error wanted, relative to the displacement from the start.")],
    size: Annotated[int | None, typer.Option(help="Mesh size; the scene's default if left out.")] = None,
    horizon: Annotated[
        float | None,
        typer.Option(
            help="After how many simulated seconds the error counts; if left out 1, or less where the motion cannot be "
            "predicted for so long."
        ),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Wall seconds that a simulation may take.")] = 5.0,
    budget: Annotated[float, typer.Option(help="Wall seconds that all simulations together may take.")] = 60.0,
    results: Results = Path("results"),
) -> None:
    """Find and check the cheapest integrator, time step, tolerance and solver for an error."""
    from rich.table import Table

    from harness.base.progress import display
    from harness.experiments.accuracy.recommend import recommend as find
    from harness.report.accuracy.runners_up import RunnerUp, draw_ways

    found = find(
        scene,
        error,
        size=size,
        horizon=horizon,
        time_limit=time_limit,
        budget=budget,
        results=results,
        display=display(err()),
        say=say,
    )
    integrated = found.checked.truth == "integrated"
    table = Table("", "error" if integrated else f"error ({found.checked.truth})", "wall s per simulated s", "way")
    for name, way in (("predicted", found.best), ("measured", found.checked)):
        table.add_row(name, f"{way.error:.3g}", f"{way.cost:.4g}", str(way))
    out().print(narrow(table))
    say(found.verdict)
    points = [RunnerUp(way.spec.solver.name, way.error, way.cost, str(way)) for way in found.ways]
    title = f"Ways to an error of {100 * error:g} %: {scene.stem} {found.best.spec.case.size or ''}".rstrip()
    folder = results / f"recommend-{scene.stem}" / "pictures"
    horizon = found.best.spec.horizon
    name = f"ways-{scene.stem}-{found.best.spec.case.size}-{error:g}-{horizon:g}".replace(".", "_")
    facts = [f"{horizon:g} s simulated", "time stepping and solver together"]
    facts += [] if integrated else [f"by a {found.checked.truth} reference"]
    picture, *_ = draw_ways(folder / name, title, facts, points, error)
    say(f"the runners-up are in {picture}")
    if command := found.best.command(scene):
        say(f"to run it:\n  {command}")
