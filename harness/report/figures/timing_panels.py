"""Panels of sweeps and of speed reports: times against size."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.charts.chart_description import select_curve_plots
from springbench.harness.report.charts.figure_panels import AxisScale, CurvePlot, CurveSeries
from springbench.harness.report.charts.speed_chart import build_speed_chart
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle, assign_label_styles
from springbench.harness.report.provenance_words import PROVENANCE_COLUMNS, describe_provenance
from springbench.harness.report.speed import speed_figures
from springbench.harness.report.timing_table import RunTimes, label_runs, read_run_times
from springbench.harness.results import parquet_rows, row_store

StaleFinder = Callable[[pa.Table], Collection[str]]
"""Returns the ids of those runs in a table of rows that other code than the current version measured."""

_VERTEX_SCALE = AxisScale("vertices", "sizes", "plain")
_REQUIRED_COLUMNS = ("run_id", "scene", "size", "solver", "phase", "status")


def read_sweep_rows(folder: Path) -> pa.Table:
    """Read the rows of a sweep.

    Raises:
        InputError: if there are none, or if they belong to a speed report.
    """
    units = row_store.list_units(folder / "rows")
    if not units:
        raise InputError(InputMistake("holds no rows of runs; wanted those of `springbench run CONFIG`", folder))
    table = parquet_rows.read_rows(units, required_columns=_REQUIRED_COLUMNS)
    if speed_figures.has_machine_limits(table):
        raise InputError(InputMistake("holds rows of `springbench roofline`; ask for the kind speed", folder))
    return table


def timing_panels(folder: Path, find_stale: StaleFinder) -> list[PanelEntry]:
    """Build panels of step and preparation times, for each scene.

    Args:
        folder: folder of a sweep's results.
        find_stale: returns the ids of stale runs in a table of rows.
    """
    table = read_sweep_rows(folder)
    found, other = read_run_times(table), find_stale(table)
    names = label_runs(found)
    marked = assign_label_styles((names[run.run_id], run.solver) for run in found)
    provenance = describe_provenance(table.select(PROVENANCE_COLUMNS).to_pylist())
    plots: list[CurvePlot] = []
    for scene in dict.fromkeys(run.scene for run in found):
        here = [run for run in found if run.scene == scene]
        ok = [run for run in here if run.status == "ok" and run.vertices]
        failed = [f"{names[r.run_id]} {r.size or ''}: {r.status}" for r in here if r.status != "ok"]
        notes = [f"Failed: {'; '.join(failed)}."] if failed else []
        for key, title, fields in _TIMED_PHASES:
            timed = [run for run in ok if getattr(run, fields[0]) is not None]
            if timed:
                series, scales = _build_size_series(timed, names, marked, fields, other)
                hollow = [STALE_NOTE] if any(run.run_id in other for run in timed) else []
                plots.append(
                    CurvePlot(
                        *((scene,), (key,), _subject_with_size(scene, timed), title, *scales, series),
                        notes=[*(_SPREAD_NOTES[len(fields)]), *hollow, *notes],
                        machine_words=provenance,
                    )
                )
    return entries_from_panels(plots)


_TIMED_PHASES = (
    ("step", "a step", ("step", "lower", "upper")),
    ("prepare", "preparing, warm", ("warm",)),
    ("cold", "preparing, cold", ("cold",)),
)
_SPREAD_NOTES = {3: ["Median and quartiles of all steps."], 1: []}


def _subject_with_size(scene: str, timed: Sequence[RunTimes]) -> str:
    sizes = {run.vertices for run in timed}
    return f"{scene}, {sizes.pop()} vertices" if len(sizes) == 1 else scene


def _build_size_series(
    timed: Sequence[RunTimes],
    names: dict[str, str],
    styles: dict[str, SeriesStyle],
    fields: Sequence[str],
    other: Collection[str],
) -> tuple[list[CurveSeries], tuple[AxisScale, AxisScale]]:
    """Build curves of time against the number of vertices.

    For a single size there is one row per solver instead, the fastest first.
    """
    each: dict[str, list[RunTimes]] = {}
    for run in sorted(timed, key=lambda run: run.vertices or 0):
        each.setdefault(names[run.run_id], []).append(run)
    lone = len({run.vertices for run in timed}) == 1
    if lone:
        each = dict(sorted(each.items(), key=lambda pair: getattr(pair[1][0], fields[0])))
    series: list[CurveSeries] = []
    for k, (label, members) in enumerate(each.items()):
        n = np.full(len(members), float(k)) if lone else np.array([run.vertices for run in members], float)
        values = [1e-3 * np.array([getattr(run, field) for run in members], float) for field in fields]
        low, high = values[1:] or (None, None)
        hollow = np.array([run.run_id in other for run in members])
        x, y = (values[0], n) if lone else (n, values[0])
        series.append(CurveSeries(label, styles[label], x, y, low, high, lone, hollow, is_connected=not lone))
    time = AxisScale("wall time", "log", "time")
    return series, (time, AxisScale("", "names", place_names=tuple(each))) if lone else (_VERTEX_SCALE, time)


def speed_panels(folder: Path) -> list[PanelEntry]:
    """Build the panels of a speed report."""
    units = row_store.list_units(folder / "rows")
    table = parquet_rows.read_rows(units, required_columns=_REQUIRED_COLUMNS) if units else None
    if table is None or not speed_figures.has_machine_limits(table):
        raise InputError(
            InputMistake("holds no speed report; wanted the rows of `springbench roofline CONFIG`", folder)
        )
    return entries_from_panels(select_curve_plots(build_speed_chart(speed_figures.compute_speed_figures(table))))
