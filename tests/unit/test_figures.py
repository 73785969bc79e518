"""Figures for print: their content, that nothing of them is small, cut or covered, and that they look as they did."""

from __future__ import annotations

import csv
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image
from springbench.harness.cli.main import app
from springbench.harness.config.sweep_config import REPORT_TABLE
from springbench.harness.report.change_detection import MIN_RESULTS
from springbench.harness.report.charts.figure_panels import AxisScale, CurvePlot, CurveSeries
from springbench.harness.report.figures import figure_kinds
from springbench.harness.report.figures.figure_drawing import find_layout_faults
from springbench.harness.report.figures.figure_files import write_figure
from springbench.harness.report.figures.figure_layout import (
    MILLIMETRES_PER_INCH,
    compose_figure,
    sort_by_end_value,
    visible_texts,
)
from springbench.harness.report.figures.figure_options import MIN_FONT_SIZE, FigureOptions
from springbench.harness.report.figures.panel_drawing import marker_style
from springbench.harness.report.plot_style import SeriesStyle
from typer.testing import CliRunner

from tests import synthetic_results as made
from tests.figure_images import (
    EXPECTED_FOLDER,
    FIGURE_SOURCES,
    MESH_FIGURE_KINDS,
    MIN_SIMILARITY,
    compose_kind,
    least_similarity,
    render_figure,
    tile_figures,
)

EXPECTED_SHEET = EXPECTED_FOLDER / "figures.png"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder of results for each kind."""
    folder = tmp_path_factory.mktemp("results")
    written = {
        make: make(folder / make.__name__) for make in dict.fromkeys(make for _, make in FIGURE_SOURCES.values())
    }
    return {kind: written[make] for kind, (_, make) in FIGURE_SOURCES.items()}


@pytest.fixture(scope="module")
def figures(results: dict[str, Path]) -> dict[str, Figure]:
    """One figure of each kind, 85 mm wide."""
    return {kind: compose_kind(kind, results[kind], FigureOptions())[0] for kind in FIGURE_SOURCES}


def test_all_kinds_are_on_a_sheet() -> None:
    assert {*FIGURE_SOURCES, *MESH_FIGURE_KINDS} == {*figure_kinds.FIGURE_KINDS}


def test_the_sheet_of_all_figures_looks_as_it_did(figures: dict[str, Figure], tmp_path: Path) -> None:
    now = tile_figures(list(figures.values()), (2460, 1080))
    now.save(tmp_path / "figures.png")
    then = Image.open(EXPECTED_SHEET)
    hint = f"compare {tmp_path / 'figures.png'} with {EXPECTED_SHEET}; if it is better, replace the latter"
    assert now.size == then.size, hint
    assert least_similarity(now, then) > MIN_SIMILARITY, hint


def test_a_curve_of_another_style_is_detected(figures: dict[str, Figure]) -> None:
    line = figures["timing"].axes[0].lines[0]
    look, now = (line.get_linestyle(), line.get_color()), render_figure(figures["timing"])
    line.set(linestyle=":", color="#d55e00")
    other = render_figure(figures["timing"])
    line.set(linestyle=look[0], color=look[1])
    assert least_similarity(now, other) < MIN_SIMILARITY


@pytest.mark.parametrize("kind", FIGURE_SOURCES)
def test_no_type_of_a_figure_is_small_cut_or_covered(figures: dict[str, Figure], kind: str) -> None:
    figure = figures[kind]
    assert find_layout_faults(figure) == []
    assert len(visible_texts(figure)) > 5
    assert figure.get_size_inches()[0] * MILLIMETRES_PER_INCH == pytest.approx(85.0)


@pytest.mark.long
@pytest.mark.parametrize(("width", "size"), [(60.0, 6.0), (180.0, 10.0)])
def test_no_type_is_small_cut_or_covered_at_other_widths(results: dict[str, Path], width: float, size: float) -> None:
    for kind in ("timing", "ablation"):
        figure, _ = compose_kind(kind, results[kind], FigureOptions(width_mm=width, font_size=size))
        assert find_layout_faults(figure) == []
        assert min(float(text.get_fontsize()) for text in visible_texts(figure)) >= MIN_FONT_SIZE


def test_faults_are_found() -> None:
    figure = Figure((3.0, 2.0))
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.3, 0.3, 0.4, 0.4))
    ax.plot([0, 1], [0, 1], label="a")
    figure.text(0.9, 0.9, "beyond the edge")
    figure.text(0.1, 0.9, "tiny", fontsize=5.0)
    figure.text(0.1, 0.5, "one name")
    figure.text(0.12, 0.5, "another")
    figure.legend(loc="center")
    faults = "\n".join(find_layout_faults(figure))
    for said in ("'beyond the edge' is cut", "'tiny' is of 5.0 points", "'one name' meets 'another'", "lies over data"):
        assert said in faults


def test_the_legend_has_the_order_of_the_curves(results: dict[str, Path]) -> None:
    requested = FigureOptions(selectors=(("net", "10", "gap", "time"), ("net", "10", "previous", "gap", "iterations")))
    figure, _ = compose_kind("convergence", results["convergence"], requested)
    (legend,) = figure.legends
    lines = {str(line.get_label()): line for line in figure.axes[0].lines}
    names = [text.get_text() for text in legend.get_texts() if text.get_text() in lines]
    ends = [float(np.asarray(lines[name].get_ydata())[-1]) for name in names]
    assert len(ends) == 5
    assert ends == sorted(ends, reverse=True)


def test_names_at_the_ends_of_curves_have_their_order_and_need_no_legend(figures: dict[str, Figure]) -> None:
    figure = figures["timing"]
    assert not figure.legends
    names = sorted(figure.axes[0].texts, key=lambda text: -text.get_position()[1])
    series = [one.label for one in sort_by_end_value(composed_timing(figure))]
    assert [name.get_text() for name in names] == series


def composed_timing(figure: Figure) -> list[CurveSeries]:
    lines = [line for line in figure.axes[0].lines if not str(line.get_label()).startswith("_")]
    return [
        CurveSeries(
            str(one.get_label()),
            SeriesStyle("k", "o"),
            np.asarray(one.get_xdata(), float),
            np.asarray(one.get_ydata(), float),
        )
        for one in lines
    ]


def test_one_size_has_a_row_for_each_solver_the_fastest_first(tmp_path: Path) -> None:
    folder = made.write_sweep_results(tmp_path, sizes=(8,))
    figure, _ = compose_kind("timing", folder, FigureOptions(selectors=(("geometry-flat", "step"),)))
    ax = figure.axes[0]
    assert [label.get_text() for label in ax.get_yticklabels()] == list(made.SOLVER_NAMES)
    assert find_layout_faults(figure) == []


def test_the_command_writes_each_format_the_data_and_a_script_that_draws_them(
    results: dict[str, Path], tmp_path: Path
) -> None:
    words = ["figure", "timing", str(results["timing"]), "--width", "8.5cm", "--panels", "step", "-o", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    stem = tmp_path / "timing-step"
    pdf, svg = stem.with_suffix(".pdf").read_bytes(), stem.with_suffix(".svg").read_text()
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+)", pdf)
    assert box
    assert float(box[1]) == pytest.approx(85.0 / MILLIMETRES_PER_INCH * 72.0, abs=0.1)
    assert b"/FontFile2" in pdf or b"/FontFile" in pdf
    assert "<text" not in svg.partition("</metadata>")[2], "letters are paths, which need no font"
    with Image.open(stem.with_suffix(".png")) as image:
        assert image.width == round(85.0 / MILLIMETRES_PER_INCH * 300.0) or image.width == int(
            85.0 / MILLIMETRES_PER_INCH * 300.0
        )
    assert "A processor" in svg, "whose data it is stays in the file"
    rows = list(csv.DictReader(line for line in stem.with_suffix(".csv").read_text().splitlines() if line[0] != "#"))
    assert {row["series"] for row in rows} == set(made.SOLVER_NAMES)
    with matplotlib.rc_context():
        done = subprocess.run([sys.executable, stem.with_suffix(".py")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert stem.with_name("timing-step-again.pdf").stat().st_size > 3000
    assert len(stem.with_suffix(".py").read_text().splitlines()) < 110


def test_a_script_draws_each_curve_with_its_style(tmp_path: Path) -> None:
    x = np.array([1.0, 2.0, 3.0])
    series = [
        CurveSeries("front", SeriesStyle("#b9b6af", "None"), x, x, is_stepped=True),
        CurveSeries("solver", SeriesStyle("#0072b2", "o"), x, x + 1.0, setting="tolerance 0.1"),
        CurveSeries("solver", SeriesStyle("#0072b2", "o"), x, x + 2.0, setting="tolerance 0.01"),
        CurveSeries("paper", SeriesStyle("#d55e00", "s"), x, x + 3.0, is_connected=False),
    ]
    scales = AxisScale("wall time", "linear"), AxisScale("error", "linear")
    panels = [CurvePlot(("net",), ("work",), "net", "", *scales, series)]
    options = FigureOptions(formats=("pdf",))
    write_figure(compose_figure(panels, "Work", options), panels, tmp_path / "work", "Work", options)
    with matplotlib.rc_context():
        ax = runpy.run_path(str(tmp_path / "work.py"))["figure"].axes[0]
    drawn = [line for line in ax.lines if len(line.get_xdata())]
    assert [line.get_drawstyle() for line in drawn] == ["steps-post", "default", "default", "default"]
    assert [line.get_linestyle() for line in drawn] == ["-", "-", "-", "None"]
    assert [line.get_ydata()[0] for line in drawn] == [1.0, 2.0, 3.0, 4.0]
    assert sum(isinstance(one, PathCollection) for one in ax.collections) == 3, "all but the step have marks"


def test_without_a_title_its_words_and_the_origin_are_left_to_the_caption(results: dict[str, Path]) -> None:
    figure, _ = compose_kind("timing", results["timing"], FigureOptions(has_title=False, is_transparent=True))
    said = "\n".join(text.get_text() for text in visible_texts(figure))
    assert "Time a step" not in said
    assert "A processor" not in said
    assert np.asarray(FigureCanvasAgg(figure).figure.get_facecolor())[3] == 0.0


def test_a_gate_s_level_has_a_gap_where_it_changed(results: dict[str, Path]) -> None:
    figure, (panel,) = compose_kind("history", results["history"], FigureOptions())
    assert panel.subject == "test_step[cloth]", "the one that changed most"
    stored, level, slower = panel.series
    assert len(stored.x) == 30
    known = np.isfinite(level.y)
    assert known.tolist() == [True, True, False] * 2
    assert level.y[3] / level.y[0] == pytest.approx(1.05, rel=0.01)
    assert (slower.x.tolist(), slower.y.tolist()) == ([18.0], [level.y[3]])
    said = " ".join(text.get_text() for text in visible_texts(figure))
    assert re.search(r"Changed by \+[456]\.\d % at 00000", said)
    assert not figure_kinds.find_figure_kind("history").list_panels(results["timing"], lambda _: ())


def test_a_report_from_outside_is_a_kind_if_it_has_panels(
    results: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def report(rows: Any, folder: Path) -> list[Path]:
        return []

    def panels(rows: Any) -> list[CurvePlot]:
        x = np.arange(3.0)
        series = [CurveSeries("mine", SeriesStyle("#123456", "o"), x, x + 1.0)]
        scales = AxisScale("frame", "linear"), AxisScale("rows of " + str(len(rows)), "linear")
        return [CurvePlot(("mine",), ("rows",), "all", "", *scales, series)]

    monkeypatch.setattr(report, "panels", panels, raising=False)
    monkeypatch.setattr(type(REPORT_TABLE), "_installed_entry_points", lambda _: {"mine": None})
    monkeypatch.setattr(type(REPORT_TABLE), "__getitem__", lambda self, name: "tests:mine")
    monkeypatch.setattr(figure_kinds, "load_target", lambda _: report)
    found = figure_kinds.find_figure_kind("mine")
    (entry,) = found.list_panels(results["timing"], lambda _: ())
    assert entry.name_parts == ("mine", "rows")
    assert isinstance(compose_figure([entry.build_panel()], found.title, FigureOptions()).axes[0].lines[0], Line2D)
    monkeypatch.setattr(report, "panels", lambda rows: 1 / 0)
    with pytest.raises(figure_kinds.RunFailed, match="the report mine failed: ZeroDivisionError"):
        found.list_panels(results["timing"], lambda _: ())


def test_the_figure_of_benchmarks_states_how_many_results_it_needs() -> None:
    assert figure_kinds.FIGURE_KINDS["history"].required_rows.startswith(f"{MIN_RESULTS} stored results")


def test_a_hollow_mark_has_its_own_colour() -> None:
    filled, hollow = marker_style(SeriesStyle("#0072b2", "o")), marker_style(SeriesStyle("#0072b2", "o"), is_stale=True)
    assert (filled["mfc"], hollow["mfc"], hollow["mec"]) == ("#0072b2", "white", "#0072b2")
