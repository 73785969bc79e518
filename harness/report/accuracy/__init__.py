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
from springbench.harness.report.accuracy.convergence_plot import draw_convergence
from springbench.harness.report.accuracy.liu2013_comparison import draw_liu2013
from springbench.harness.report.accuracy.performance_profiles import draw_profiles
from springbench.harness.report.accuracy.size_scaling import draw_scalings
from springbench.harness.report.accuracy.snapshot_pictures import draw_snapshot_meshes
from springbench.harness.report.accuracy.time_to_accuracy_plot import draw_times_to_accuracy
from springbench.harness.report.accuracy.work_precision_plot import draw_work_precision
from springbench.harness.report.citations import write_bibtex


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
    pictures = [
        *draw_convergence(table, out / "convergence"),
        *draw_times_to_accuracy(table, out / "times"),
        *draw_work_precision(table, out / "work"),
        *draw_profiles(table, out / "profiles"),
        *draw_scalings(table, out / "growth"),
        *draw_liu2013(everything, out / "liu2013"),
        *draw_snapshot_meshes(table, folder, out / "meshes").values(),
    ]
    words, numbers = out / "findings.md", out / "summary.json"
    write_findings(words, title, chapters, failed)
    write_summary(numbers, everything)
    books = write_bibtex(out / "references.bib", [each.citation for each in (*table.curves, *table.work_points)])
    return [*pictures, words, numbers, books]
