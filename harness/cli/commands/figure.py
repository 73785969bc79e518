"""Command `springbench figure`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from springbench.harness.console import print_message, show_activity
from springbench.harness.errors import InputError, InputMistake


def figure(
    kind: Annotated[str, typer.Argument(help="Kind: convergence, times, timing, hard, run and others.")],
    results: Annotated[Path, typer.Argument(help="Results of a config, such as results/accuracy.")],
    width: Annotated[str, typer.Option(help="Width of the figure: 85mm, 8.5cm, 3.35in, 241pt.")] = "85mm",
    formats: Annotated[str, typer.Option("--format", help="Formats: any of pdf, svg, png.")] = "pdf,svg,png",
    size: Annotated[
        float, typer.Option("--font-size", help="Font size [pt]; ticks are one point smaller, at least 6.")
    ] = 8.0,
    panels: Annotated[
        str, typer.Option(help="Panels by parts of their names: gap:time, or two separated by a comma.")
    ] = "",
    without_title: Annotated[
        bool, typer.Option("--no-title", help="Omit title and provenance from the figure; the files contain them.")
    ] = False,
    transparent: Annotated[bool, typer.Option("--transparent", help="Draw no background.")] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Output folder; RESULTS/figures by default.")
    ] = None,
) -> None:
    """Draw a figure for print, with its data as CSV and a script."""
    from springbench.harness.report.figures.figure_kinds import find_figure_kind as find
    from springbench.harness.report.figures.figure_options import parse_figure_options

    options = parse_figure_options(
        width, formats, size, panels, has_title=not without_title, is_transparent=transparent
    )
    found = find(kind)
    if not results.is_dir():
        raise InputError(InputMistake(f"is no folder; expected one with {found.required_rows}", results))

    from springbench.harness.experiments.stale_results import find_stale_runs
    from springbench.harness.report.figures.figure_maker import make_figure

    show_activity("drawing")
    folder = output or results / "figures"
    made = make_figure(kind, found, results, lambda table: find_stale_runs(results, table), folder, options)
    across, up = made.size_mm
    print_message(f"{across:g} mm x {up:.0f} mm: {', '.join(made.panel_names)}")
    if made.other_panel_count:
        print_message(
            f"there are {made.other_panel_count} more panels; name others by --panels: {made.other_panel_example}"
        )
    print_message(f"drawn in {', '.join(path.name for path in made.paths)}, in {folder}")
