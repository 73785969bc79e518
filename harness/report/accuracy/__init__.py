"""What the rows of `springbench accuracy` say: pictures, findings, a table and one interactive page."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

from harness.report.accuracy.convergence import draw_convergence
from harness.report.accuracy.findings import failures, findings, write_findings, write_summary
from harness.report.accuracy.growth import draw_growth
from harness.report.accuracy.interactive import write_page
from harness.report.accuracy.measured import without_short
from harness.report.accuracy.paper import draw_paper
from harness.report.accuracy.pictures import draw_meshes
from harness.report.accuracy.profiles import draw_profiles
from harness.report.accuracy.reading import read
from harness.report.accuracy.time_plot import draw_times
from harness.report.accuracy.work_plot import draw_work
from harness.report.references import write_bibtex


def draw(folder: Path, files: Iterable[Path] | None = None) -> list[Path]:
    """Draw all that the rows under `folder`/accuracy say to `folder`/report; returns the files, the page last.

    folder: of one config's results; files: those of its rows that count, all if left out. Raises InputError where
    there are no rows.
    """
    everything = read(folder, files)
    table, out = without_short(everything), folder / "report"
    out.mkdir(parents=True, exist_ok=True)
    title, failed, chapters = f"What accuracy costs: {folder.name}", failures(everything), findings(everything)
    meshes = draw_meshes(table, folder, out / "meshes")
    pictures = [
        *draw_convergence(table, out / "convergence"),
        *draw_times(table, out / "times"),
        *draw_work(table, out / "work"),
        *draw_profiles(table, out / "profiles"),
        *draw_growth(table, out / "growth"),
        *draw_paper(everything, out / "liu2013"),
        *meshes.values(),
    ]
    page, words, numbers = out / "report.html", out / "findings.md", out / "summary.json"
    write_findings(words, title, chapters, failed)
    write_summary(numbers, everything)
    write_page(
        page,
        title,
        table,
        pictures={digest: path.relative_to(out).as_posix() for digest, path in meshes.items()},
        findings=list(chain.from_iterable(chapters.values())),
        failures=failed,
    )
    books = write_bibtex(out / "references.bib", [each.reference for each in (*table.curves, *table.works)])
    return [*pictures, words, numbers, books, page]
