"""The command `springbench regress-history`: performance changes over the stored results of commits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from springbench.harness.console import get_output_console, print_message, split_wide_table
from springbench.harness.errors import InputError, InputMistake

DEFAULT_FOLDERS = (Path("results/bench"), Path(".benchmarks"))
"""Default folders of stored results: those of this project, and those of pytest-benchmark."""


def regress_history(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(help="Folders and files of pytest-benchmark; results/bench and .benchmarks if left out."),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="The picture (.png, .svg or .pdf).")] = Path(
        "results/history.png"
    ),
) -> None:
    """Find performance changes in stored results by commit. Exit code 3: too few results."""
    from springbench.harness.report.benchmark_history_plot import draw_history
    from springbench.harness.report.change_detection import MIN_RESULTS, build_history_table, find_stored_files
    from springbench.harness.report.change_detection import read_histories as tell
    from springbench.harness.report.site import refresh_results_page
    from springbench.harness.report.site.sweep_folders import find_benchmark_files

    if output.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise InputError(InputMistake("wanted a name that ends in .png, .svg or .pdf", output, key="--output"))
    files = find_stored_files(folders or [place for place in DEFAULT_FOLDERS if place.exists()])
    hint = "`pytest tests/bench --benchmark-only` stores one, at each commit that you run it at"
    if not files:
        where = ", ".join(map(str, folders or DEFAULT_FOLDERS))
        raise InputError(f"regress-history: no stored results in {where}; {hint}")
    found = tell(files)
    get_output_console().print(split_wide_table(build_history_table(found)))
    if not any(len(series.points) >= MIN_RESULTS for series in found):
        most = max((len(series.points) for series in found), default=0)
        print_message(
            f"too little to tell changes from noise: at most {most} results of a gate, wanted {MIN_RESULTS}; {hint}"
        )
        raise typer.Exit(3)
    output.parent.mkdir(parents=True, exist_ok=True)
    drawn = draw_history(found, output)
    print_message(f"the picture of {drawn} gates is {output}")
    for place in folders or DEFAULT_FOLDERS:
        if find_benchmark_files(place) and (place.parent / "index.html").is_file():
            refresh_results_page(place.parent, place, print_message)
