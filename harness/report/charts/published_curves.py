"""Published curves behind one's own, in grey.

They are drawn where the published set has the same solver, with its parameters, on the same scene and size. For
convergence the step is the same too.
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
    """Read the published data on the scenes and sizes of one's own; none outside a checkout.

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
    """List the scenes and sizes of a table, which are read once for each state of the file."""
    import duckdb

    meshes = duckdb.execute("SELECT DISTINCT scene, size FROM read_parquet(?)", [str(path)]).fetchall()
    return frozenset((str(scene), int(size)) for scene, size in meshes)


@cache
def _read_study(folder: Path, modified_at: int) -> AccuracyData:
    with open_study_folder(PublishedStudy(folder, {})) as results:
        return read_accuracy(results)


def _select_meshes(table: AccuracyData, meshes: set[tuple[str, int]]) -> AccuracyData:
    problems = tuple(one for one in table.problems if (one.scene, one.size) in meshes)
    curves = tuple(one for one in table.curves if (one.problem.scene, one.problem.size) in meshes)
    works = tuple(one for one in table.work_points if (one.scene, one.size) in meshes)
    return replace(table, problems=problems, curves=curves, work_points=works)


def add_published_curves(chart: ChartDescription, published: Iterable[ChartDescription]) -> ChartDescription:
    """Add the published series of the same frame, label and setting behind each series.

    Args:
        chart: chart of one's own results.
        published: the same chart, built of each published study.
    """

    def identify(frame: ChartFrame, one: ChartSeries) -> tuple[object, ...]:
        return frame.sheet, frame.group, frame.name, one.label, one.setting, one.links.get("parameters")

    known = {identify(frame, one): one for other in published for frame in other.frames for one in frame.series}

    def find(frame: ChartFrame) -> Sequence[ChartSeries]:
        own = (identify(frame, one) for one in frame.series if one.links)
        return [known[key] for key in own if key in known]

    return replace(chart, frames=[_add_behind(frame, find(frame)) for frame in chart.frames])


def _add_behind(frame: ChartFrame, published: Sequence[ChartSeries]) -> ChartFrame:
    if not published:
        return frame
    grey = [
        replace(
            one,
            label=PUBLISHED_LABEL,
            style=_PUBLISHED_STYLE,
            description=f"{one.label}, published: {one.description}",
            stale=False,
            status="ok",
            callouts={},
            links={},
        )
        for one in published
    ]
    return replace(frame, series=[*grey, *frame.series], notes=[*frame.notes, _PUBLISHED_NOTE])
