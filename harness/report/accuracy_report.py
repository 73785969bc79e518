"""Reports on the rows of `springbench accuracy`: pictures, findings and a table."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from springbench.harness.report.accuracy.accuracy_data import without_short_curves
from springbench.harness.report.accuracy.accuracy_findings import (
    list_failures,
    summarise_findings,
    write_findings,
    write_summary,
)
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.snapshot_pictures import draw_snapshot_meshes
from springbench.harness.report.charts.chart_table import CHART_NAMES, build_accuracy_chart
from springbench.harness.report.citations import write_bibtex
from springbench.harness.report.figures.chart_sheets import draw_chart_sheets


def draw_accuracy_report(folder: Path, files: Iterable[Path] | None = None) -> list[Path]:
    """Draw the report on the rows under `folder`/accuracy to `folder`/report, and return the files.

    Args:
        folder: results of one config.
        files: files of rows to include; None for all.

    Raises:
        InputError: if there are no rows.
    """
    everything = read_accuracy(folder, files)
    table, out = without_short_curves(everything), folder / "report"
    out.mkdir(parents=True, exist_ok=True)
    title, failed, chapters = (
        f"What accuracy costs: {folder.name}",
        list_failures(everything),
        summarise_findings(everything),
    )
    charts = {name: build_accuracy_chart(name, everything) for name in CHART_NAMES}
    pictures = [
        *(path for name, chart in charts.items() for path in draw_chart_sheets(chart, out / name)),
        *draw_snapshot_meshes(table, folder, out / "meshes").values(),
    ]
    words, numbers = out / "findings.md", out / "summary.json"
    write_findings(words, title, chapters, failed)
    write_summary(numbers, everything)
    books = write_bibtex(out / "references.bib", [each.citation for each in (*table.curves, *table.work_points)])
    return [*pictures, words, numbers, books]
