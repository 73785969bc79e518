"""Sheets of sweeps: of verified runs, and of runs on a device."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from springbench.harness.errors import InputError
from springbench.harness.report.charts.device_chart import build_device_chart
from springbench.harness.report.charts.hard_case_chart import build_hard_case_chart
from springbench.harness.report.device_speedup import read_device_runs, summarise_runs
from springbench.harness.report.figures.chart_sheets import draw_chart_sheets
from springbench.harness.report.provenance_words import describe_provenance
from springbench.harness.report.robustness import MAP_NOTE, VerifiedRun, build_map_headline, read_verified_runs
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.folder_ownership import find_config


def draw_device_sheets(results: Path) -> Iterator[tuple[Path | None, list[str]]]:
    """Draw `pictures/devices.png` and `.svg` for each sweep that requested a device.

    Args:
        results: folder of results, or the folder of one sweep.

    Yields:
        The PNG file, or None if no run on a device reached its residual; and sentences on the sweep's rows.
    """
    for rows in row_store.find_row_folders(results, "rows"):
        folder = rows.parent
        try:
            found = read_device_runs(
                parquet_rows.read_rows(row_store.list_units(rows), on_invalid=lambda mistake: None)
            )
        except InputError:
            continue  # the page reports damaged rows
        if sentences := summarise_runs(found, find_config(folder)):
            paths = draw_chart_sheets(build_device_chart(found), folder / "pictures" / "devices")
            yield next(iter(paths), None), sentences


def draw_hard_case_sheets(
    results: Path, find_stale: Callable[[Path], Collection[str]]
) -> Iterator[tuple[Path, list[VerifiedRun]]]:
    """Draw `pictures/robustness.png` and `.svg` for each sweep with verified runs in a folder.

    Args:
        results: folder of results, or the folder of one sweep.
        find_stale: returns the ids of the runs in a sweep's folder that were executed by other code than the current
            version.

    Yields:
        Each PNG file and its runs.
    """
    for rows in row_store.find_row_folders(results, "rows"):
        folder = rows.parent
        with suppress(InputError):
            cells = read_verified_runs(folder)
            provenance = describe_provenance([{"cpu": cell.cpu, "commit": cell.commit} for cell in cells])
            chart = build_hard_case_chart(cells, find_stale(folder), provenance)
            frames = [replace(frame, notes=[*frame.notes, MAP_NOTE]) for frame in chart.frames]
            chart = replace(chart, title=build_map_headline(cells, folder.resolve().name), frames=frames)
            picture, *_ = draw_chart_sheets(chart, folder / "pictures" / "robustness")
            yield picture, cells
