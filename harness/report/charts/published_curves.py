"""Published curves behind one's own, in grey.

A published curve is drawn if its solver, parameters, scene and size are those of an own curve. For convergence the step
must be the same too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

from springbench.harness.report.accuracy.accuracy_data import AccuracyData
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.charts.chart_description import ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.plot_style import SeriesStyle
from springbench.harness.report.provenance_words import PROVENANCE_COLUMNS, describe_provenance
from springbench.harness.report.timing_table import RunTimes, read_run_times
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.published_set import (
    PUBLISHED_FOLDER,
    STUDY_FILE,
    PublishedStudy,
    list_studies,
    open_study_folder,
)

PUBLISHED_LABEL = "published"
COMPARED_CHARTS = ("convergence", "times", "work")
"""Charts whose series belong to one scene, size and solver."""

_PUBLISHED_STYLE = SeriesStyle("#9a9fa6", "None")
_PUBLISHED_NOTE = "Published curves are grey: the same solver, on the machine of the published set."


def read_published_data(own: AccuracyData, published: Path = PUBLISHED_FOLDER) -> list[AccuracyData]:
    """Read the published data on own scenes and sizes; none outside a checkout.

    Args:
        own: data of one's own accuracy measurement.
        published: folder of the published set.
    """
    if not any(published.glob(f"*/{STUDY_FILE}")):
        return []
    meshes = {(one.scene, one.size) for one in (*own.problems, *own.work_points)}
    found: list[AccuracyData] = []
    for study in list_studies(published):
        path = study.find_table("accuracy")
        if path and meshes & _list_meshes(path, path.stat().st_mtime_ns):
            found.append(_select_meshes(_read_study(study.folder, path.stat().st_mtime_ns), meshes))
    return found


@cache
def _list_meshes(path: Path, modified_at: int) -> frozenset[tuple[str, int]]:
    """List the scenes and sizes of a table; `modified_at` makes the cache follow the file."""
    import duckdb

    meshes = duckdb.execute("SELECT DISTINCT scene, size FROM read_parquet(?)", [str(path)]).fetchall()
    return frozenset((str(scene), int(size)) for scene, size in meshes)


@cache
def _read_study(folder: Path, modified_at: int) -> AccuracyData:
    with open_study_folder(PublishedStudy(folder, {})) as results:
        return read_accuracy(results)


def read_published_runs(
    own: Sequence[RunTimes], published: Path = PUBLISHED_FOLDER
) -> list[tuple[list[RunTimes], str]]:
    """Read the published runs on the scenes and sizes of one's own.

    Args:
        own: runs of one's own sweep.
        published: folder of the published set; outside a checkout nothing is found.

    Returns:
        For each study, its runs and their provenance in words.
    """
    if not any(published.glob(f"*/{STUDY_FILE}")):
        return []
    meshes = {(run.scene, run.size) for run in own}
    found: list[tuple[list[RunTimes], str]] = []
    for study in list_studies(published):
        path = study.find_table("rows")
        if study.is_timed and path and meshes & _list_meshes(path, path.stat().st_mtime_ns):
            runs, words = _read_study_runs(study.folder, path.stat().st_mtime_ns)
            found.append(([run for run in runs if (run.scene, run.size) in meshes], words))
    return found


@cache
def _read_study_runs(folder: Path, modified_at: int) -> tuple[list[RunTimes], str]:
    with open_study_folder(PublishedStudy(folder, {})) as results:
        table = parquet_rows.read_rows(row_store.list_units(results / "rows"))
    return read_run_times(table), describe_provenance(table.select(PROVENANCE_COLUMNS).to_pylist())


def _select_meshes(table: AccuracyData, meshes: set[tuple[str, int]]) -> AccuracyData:
    problems = tuple(one for one in table.problems if (one.scene, one.size) in meshes)
    curves = tuple(one for one in table.curves if (one.problem.scene, one.problem.size) in meshes)
    works = tuple(one for one in table.work_points if (one.scene, one.size) in meshes)
    return replace(table, problems=problems, curves=curves, work_points=works)


def add_published_curves(chart: ChartDescription, published: Iterable[ChartDescription]) -> ChartDescription:
    """Add the published series of the same frame and identity behind each series.

    Args:
        chart: chart of one's own results.
        published: the same chart, built of each published study.
    """
    known = {
        (frame.sheet, frame.group, frame.name, one.identity): (one, other.machine_words)
        for other in published
        for frame in other.frames
        for one in frame.series
    }

    # A curve of one point needs a marker to be seen.
    has_lone = any(_count_points(one) == 1 for one, _ in known.values())
    style = _PUBLISHED_STYLE._replace(marker="o") if has_lone else _PUBLISHED_STYLE

    def add_behind(frame: ChartFrame) -> ChartFrame:
        pairs = [
            (one, known[key])
            for one in frame.series
            if one.identity and (key := (frame.sheet, frame.group, frame.name, one.identity)) in known
        ]
        if not pairs:
            return frame
        grey = [_build_grey_series(one, *found, style) for one, found in pairs]
        return replace(frame, series=[*grey, *frame.series], notes=[*frame.notes, _PUBLISHED_NOTE])

    return replace(chart, frames=[*map(add_behind, chart.frames)])


def _count_points(series: ChartSeries) -> int:
    return len(next(iter(series.columns.values())))


def _build_grey_series(own: ChartSeries, published: ChartSeries, machine_words: str, style: SeriesStyle) -> ChartSeries:
    return replace(
        published,
        label=PUBLISHED_LABEL,
        behind=own.label,
        setting=", ".join(filter(None, (own.label, own.setting))),
        style=style,
        description=f"{own.label}, published: {published.description}",
        stale=False,
        status="ok",
        callouts={},
        identity=(),
        links={"provenance": [{"commit": None, "cpu": machine_words}] * _count_points(published)},
    )
