"""Command `springbench figure`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness.base.console import say
from harness.base.errors import InputError, Mistake


def figure(
    kind: Annotated[str, typer.Argument(help="What to draw: convergence, times, timing, hard, run and others.")],
    results: Annotated[Path, typer.Argument(help="The results of a config, such as results/accuracy.")],
    width: Annotated[str, typer.Option(help="The figure's width: 85mm, 8.5cm, 3.35in, 241pt.")] = "85mm",
    formats: Annotated[str, typer.Option("--format", help="Any of pdf, svg, png.")] = "pdf,svg,png",
    size: Annotated[
        float, typer.Option("--font-size", help="Points; ticks have one less, and never less than 6.")
    ] = 8.0,
    panels: Annotated[str, typer.Option(help="Parts of panels' names: gap:time, or two by a comma.")] = "",
    without_title: Annotated[
        bool, typer.Option("--without-title", help="Leave title and origin to the caption; the files keep them.")
    ] = False,
    transparent: Annotated[bool, typer.Option("--transparent", help="Draw no background.")] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="The folder; RESULTS/figures if left out.")
    ] = None,
) -> None:
    """Draw a figure for print, with its data as CSV and a script."""
    from harness.report.figures.asked import asked
    from harness.report.figures.kinds import kind as find

    wanted = asked(width, formats, size, panels, titled=not without_title, transparent=transparent)
    found = find(kind)
    if not results.is_dir():
        raise InputError(Mistake(f"is no folder; wanted one with {found.wanted}", results))

    from harness.experiments.older import older_runs
    from harness.report.figures.make import make

    folder = output or results / "figures"
    made = make(kind, found, results, lambda table: older_runs(results, table), folder, wanted)
    across, up = made.millimetres
    say(f"{across:g} mm x {up:.0f} mm: {', '.join(made.panels)}")
    if made.others:
        say(f"there are {made.others} more panels; name others by --panels: {made.example}")
    say(f"drawn in {', '.join(path.name for path in made.paths)}, in {folder}")
