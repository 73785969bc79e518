"""The command `springbench history`: performance changes over the stored results of commits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness.base.console import narrow, out, say
from harness.base.errors import InputError, Mistake

PLACES = (Path("results/bench"), Path(".benchmarks"))
"""Default folders of stored results: those of this project, and those of pytest-benchmark."""


def history(
    places: Annotated[
        list[Path] | None,
        typer.Argument(help="Folders and files of pytest-benchmark; results/bench and .benchmarks if left out."),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="The picture (.png, .svg or .pdf).")] = Path(
        "results/history.png"
    ),
) -> None:
    """Find performance changes in stored results by commit. Exit code 3: too few results."""
    from harness.report.history import FEWEST, history_table, stored_files
    from harness.report.history import history as tell
    from harness.report.history_plot import draw_history
    from harness.report.site import keep
    from harness.report.site.folders import stored

    if output.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(Mistake("wanted a name that ends in .png, .svg or .pdf", output, key="--output"))
    files = stored_files(places or [place for place in PLACES if place.exists()])
    hint = "`pytest tests/bench --benchmark-only` stores one, at each commit that you run it at"
    if not files:
        where = ", ".join(map(str, places or PLACES))
        raise InputError(f"history: no stored results in {where}; {hint}")
    found = tell(files)
    out().print(narrow(history_table(found)))
    if not any(len(series.points) >= FEWEST for series in found):
        most = max((len(series.points) for series in found), default=0)
        say(f"too little to tell changes from noise: at most {most} results of a gate, wanted {FEWEST}; {hint}")
        raise typer.Exit(3)
    output.parent.mkdir(parents=True, exist_ok=True)
    drawn = draw_history(found, output)
    say(f"the picture of {drawn} gates is {output}")
    for place in places or PLACES:
        if stored(place) and (place.parent / "index.html").is_file():
            keep(place.parent, place, say)
