"""Reports on the rows of `springbench accuracy`: pictures, findings and a table."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from harness.report.accuracy.convergence import draw_convergence
from harness.report.accuracy.findings import failures, findings, write_findings, write_summary
from harness.report.accuracy.growth import draw_growth
from harness.report.accuracy.measured import without_short
from harness.report.accuracy.paper import draw_paper
from harness.report.accuracy.pictures import draw_meshes
from harness.report.accuracy.profiles import draw_profiles
from harness.report.accuracy.reading import read
from harness.report.accuracy.time_plot import draw_times
from harness.report.accuracy.work_plot import draw_work
from harness.report.references import write_bibtex


def draw(folder: Path, files: Iterable[Path] | None = None) -> list[Path]:
    """Draw the report on the rows under `folder`/accuracy to `folder`/report, and return the files.

    Args:
        folder: results of one config.
        files: files of rows to include; None for all.
    Raises:
        InputError: if there are no rows.
    """
    everything = read(folder, files)
    table, out = without_short(everything), folder / "report"
    out.mkdir(parents=True, exist_ok=True)
    title, failed, chapters = f"What accuracy costs: {folder.name}", failures(everything), findings(everything)
    pictures = [
        *draw_convergence(table, out / "convergence"),
        *draw_times(table, out / "times"),
        *draw_work(table, out / "work"),
        *draw_profiles(table, out / "profiles"),
        *draw_growth(table, out / "growth"),
        *draw_paper(everything, out / "liu2013"),
        *draw_meshes(table, folder, out / "meshes").values(),
    ]
    words, numbers = out / "findings.md", out / "summary.json"
    write_findings(words, title, chapters, failed)
    write_summary(numbers, everything)
    books = write_bibtex(out / "references.bib", [each.reference for each in (*table.curves, *table.works)])
    return [*pictures, words, numbers, books]
