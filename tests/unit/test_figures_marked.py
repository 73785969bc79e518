"""Measurements of other code are hollow in figures of every kind, and named in words."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from springbench.harness.report.charts.speed_chart import build_speed_chart
from springbench.harness.report.figures.chart_sheets import draw_chart_sheets
from springbench.harness.report.figures.figure_layout import visible_texts
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.plot_style import STALE_NOTE, assign_solver_styles
from springbench.harness.report.speed.speed_figures import compute_speed_figures as speed_figures
from springbench.harness.report.speed.speed_table import build_speed_table
from springbench.harness.results import parquet_rows as base_rows
from springbench.harness.results import row_store

from tests import synthetic_accuracy_rows
from tests import synthetic_results as made
from tests.figure_images import FIGURE_SOURCES, compose_kind


def test_results_of_other_code_are_hollow_and_reported(tmp_path: Path) -> None:
    swept = made.write_sweep_results(tmp_path)
    older = {f"geometry-flat-newton-{size}" for size in (8, 16, 32)}
    figure, (panel,) = compose_kind("timing", swept, FigureOptions(), older)
    faces = {
        one.get_markerfacecolor()
        for one in figure.axes[0].lines
        if one.get_marker() == assign_solver_styles()["newton"].marker
    }
    assert "white" in faces
    assert STALE_NOTE in "\n".join(text.get_text() for text in visible_texts(figure))
    assert {row["series"] for row in panel.csv_rows() if row["is_stale"]} == {"newton"}
    _, (grid,) = compose_kind("hard", swept, FigureOptions(), older)
    assert {cell.column for cell in grid.cells if cell.is_stale} == {"newton"}
    assert "other code" in grid.notes[0]


@pytest.mark.parametrize("kind", ["timing", "hard", "ablation", "prices", "speed", "convergence", "winners", "engines"])
def test_results_of_uncommitted_code_are_hollow_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setitem(made.SHARED_COLUMNS, "commit", f"{'0' * 40}-dirty")
    monkeypatch.setitem(synthetic_accuracy_rows.MACHINE_COLUMNS, "commit", f"{'0' * 40}-dirty")
    figure, _ = compose_kind(kind, FIGURE_SOURCES[kind][1](tmp_path), FigureOptions())
    assert "commit 0000000-dirty" in "\n".join(text.get_text() for text in visible_texts(figure))


@pytest.mark.parametrize("kind", ["convergence", "times", "work", "growth", "profiles", "liu2013"])
def test_results_of_other_code_are_hollow_in_figures_of_accuracy(tmp_path: Path, kind: str) -> None:
    rows: list[dict[str, Any]] = []
    for size in (10, 24):
        rows += synthetic_accuracy_rows.build_snapshot_rows("net", size, "early")
        for solver in ("numba", "newton"):
            rows += synthetic_accuracy_rows.build_curve_rows("net", size, "early", solver)
    rows += [
        *synthetic_accuracy_rows.build_work_rows("net", 10, ("numba", "newton")),
        *synthetic_accuracy_rows.build_liu2013_rows(),
    ]
    # The reproduction of the paper is by one solver alone.
    before = "numba" if kind == "liu2013" else "newton"
    rows = [row | {"source_fingerprint": "before" if row.get("solver") == before else None} for row in rows]
    requested = FigureOptions(selectors=(("net", "10", "gap"),)) if kind == "convergence" else FigureOptions()
    figure, panels = compose_kind(kind, synthetic_accuracy_rows.write_accuracy_rows(tmp_path, rows), requested)
    said = " ".join(text.get_text() for text in visible_texts(figure)).replace("\n", " ")
    if kind in ("profiles", "liu2013"):
        assert f"Measured by other code than today's, in whole or in part: {before}." in said
    else:
        assert STALE_NOTE in said
        older = {row["series"].split()[0] for panel in panels for row in panel.csv_rows() if row["is_stale"]}
        assert older == {"newton"}


def test_results_of_other_code_are_hollow_in_figures_of_speed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = made.write_speed_results(tmp_path / "told")
    _, (panel,) = compose_kind("speed", folder, FigureOptions())
    assert {row["series"] for row in panel.csv_rows() if row["is_stale"]} == {"numba supernodal"}
    found = speed_figures(base_rows.read_rows(row_store.list_units(folder / "rows")))
    chart = build_speed_chart(found)
    assert STALE_NOTE in chart.frames[0].notes
    assert {series.label for series in chart.frames[0].series if any(np.asarray(series.stale))} == {"numba supernodal"}
    assert [path.name for path in draw_chart_sheets(chart, tmp_path / "speed")] == ["speed.png", "speed.svg"]
    table = Console(width=400, record=True, file=io.StringIO())
    table.print(build_speed_table(found))
    marked = [line for line in table.export_text().splitlines() if "by other code" in line]
    assert len(marked) == 3
    assert all("numba supernodal (10 of 50, by other code)" in line for line in marked)
