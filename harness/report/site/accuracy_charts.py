"""Charts of an accuracy measurement for the results page.

The page marks results that were measured by other code than the newest rows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from springbench.harness.report.accuracy.accuracy_data import AccuracyData, ConvergenceCurve, without_short_curves
from springbench.harness.report.accuracy.snapshot_pictures import find_closest_solve, snapshot_picture_path
from springbench.harness.report.charts.chart_table import CHART_NAMES, build_compared_chart
from springbench.harness.report.site.chart_json import serialise_chart


def build_page_charts(everything: AccuracyData, folder: Path) -> dict[str, dict[str, Any]]:
    """Build the charts with data in the rows, by their ids.

    Args:
        everything: data of an accuracy measurement.
        folder: folder of the sweep's results.
    """
    pictures = _find_mesh_pictures(without_short_curves(everything), folder)

    def link_source(curve: ConvergenceCurve) -> dict[str, Any]:
        path = curve.recording_path
        recording = path if path and (folder / path).is_file() else ""
        return {"mesh_picture": pictures.get(curve.problem.problem_digest), "recording_path": recording}

    newest = everything.newest_fingerprint
    charts = {name: build_compared_chart(name, everything, newest, link_source) for name in CHART_NAMES}
    made = {name: serialise_chart(chart) for name, chart in charts.items()}
    return {name: chart for name, chart in made.items() if chart["items"] or chart["maps"]}


def _find_mesh_pictures(table: AccuracyData, folder: Path) -> dict[str, dict[str, str]]:
    """Find the picture of each step's mesh, by the digest of the problem."""
    pictures: dict[str, dict[str, str]] = {}
    for problem in table.problems:
        path, best = snapshot_picture_path(problem, Path("report/meshes")), find_closest_solve(table, problem, folder)
        if best and (folder / path).is_file():
            pictures[problem.problem_digest] = {
                "path": path.as_posix(),
                "reference_label": best.label,
                "recording_path": best.recording_path,
            }
    return pictures
