"""Charts as plain data: the content of a description, and that figures, sheets and the page draw the same."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image
from springbench.harness.execution.machine_info import hash_sources
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.report.ablation_summary import read_ablations
from springbench.harness.report.accuracy.accuracy_data import AccuracyData
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy_report import draw_accuracy_report
from springbench.harness.report.charts.ablation_charts import build_overhead_chart
from springbench.harness.report.charts.accuracy_charts import build_convergence_chart
from springbench.harness.report.charts.chart_description import (
    ChartAxis,
    ChartDescription,
    ChartFrame,
    ChartSeries,
    select_curve_plots,
)
from springbench.harness.report.charts.chart_table import CHART_NAMES, build_accuracy_chart, build_compared_chart
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CellOutcome,
    MapCell,
    MarkedValue,
    ShadedBand,
    describe_stale_cells,
    merge_cell_maps,
)
from springbench.harness.report.charts.published_curves import PUBLISHED_LABEL, add_published_curves
from springbench.harness.report.charts.recommendation_chart import (
    CandidatePoint,
    RecommendationLimits,
    build_recommendation_chart,
)
from springbench.harness.report.charts.timing_chart import build_timing_chart
from springbench.harness.report.figures.chart_sheets import draw_chart_sheets
from springbench.harness.report.figures.figure_layout import compose_figure
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.plot_style import PAGE_WIDTH, TEXT_COLOUR, SeriesStyle, assign_solver_styles
from springbench.harness.report.provenance_words import is_stale
from springbench.harness.report.site.chart_json import serialise_chart
from springbench.harness.report.timing_table import read_run_times
from springbench.harness.report.varying_settings import find_varying_keys
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.published_set import STUDY_FILE, TABLE_FILES

from tests import synthetic_accuracy_rows as made
from tests import synthetic_results

STYLE = SeriesStyle("#123456", "o")


def test_settings_vary_where_one_is_stated_and_another_has_the_default() -> None:
    assert find_varying_keys([]) == find_varying_keys([{"a": 1}]) == set()
    assert find_varying_keys([{"a": 1, "b": [2]}, {"a": 1, "b": [3], "c": None}]) == {"b"}
    assert find_varying_keys([{}, {"precision": "float32"}]) == {"precision"}


@pytest.mark.parametrize(
    ("fingerprint", "newest", "stale"),
    [
        ("0123", None, True),
        (hash_sources(), None, False),
        (None, None, False),
        ("", "0123", False),
        ("0123", "0123", False),
        ("0123", "", True),
    ],
)
def test_a_row_is_stale_if_its_code_is_known_and_differs(
    fingerprint: str | None, newest: str | None, stale: bool
) -> None:
    assert is_stale(fingerprint, newest) == stale


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> AccuracyData:
    """Three sizes of a scene, one step in another minimum, a doubtful step with failures, simulations."""
    rows = []
    for size in (6, 12, 24):
        rows += made.build_snapshot_rows("net", size, "early", minima_count=2)
        for solver in ("numba", "newton"):
            index = int(size == 12 and solver == "newton")
            rows += made.build_curve_rows("net", size, "early", solver, minimum_index=index)
    rows += made.build_snapshot_rows("net", 6, "peak", certified=False)
    rows += made.build_curve_rows("net", 6, "peak", "lbfgs", status="time-limit", reason="the limit of 5 s was reached")
    rows.append(made.build_failure_row("net", 6, "peak", "dense", "unsupported", "supports springs </script> alone"))
    rows += [*made.build_work_rows("net", 6), *made.build_liu2013_rows()]
    return read_accuracy(made.write_accuracy_rows(tmp_path_factory.mktemp("charts"), rows))


def find_frame(chart: ChartDescription, subject: str) -> ChartFrame:
    return next(frame for frame in chart.frames if frame.subject.startswith(subject))


def test_uncertain_references_early_ends_and_other_minima_are_stated(table: AccuracyData) -> None:
    chart = build_accuracy_chart("convergence", table)
    doubtful, other, sure = (find_frame(chart, words) for words in ("net 6, peak", "net 12", "net 24"))
    said = " ".join(doubtful.notes)
    assert "Reference not certified: the lowest known minimum is not certified." in said
    assert "× Ended early (time-limit): lbfgs." in said
    assert "(unsupported): dense" in said
    assert {series.label: series.status for series in doubtful.series}["lbfgs"] == "time-limit"
    assert "In minimum 1, higher than the lowest known; vertex errors refer to it: newton." in other.notes
    labels = {series.label: [*series.callouts.values()] for series in other.series}
    assert labels == {"numba": [], "newton": ["minimum 1"]}
    assert not any("certified" in note or "minimum" in note for note in sure.notes)


def test_an_early_end_is_a_cross_and_a_callout_a_ring_with_words(table: AccuracyData) -> None:
    chart = build_accuracy_chart("convergence", table)
    (plot,) = (one for one in select_curve_plots(chart) if one.group[2] == "peak" and one.name == ("gap", "time"))
    figure = compose_figure([plot], "", FigureOptions())
    crosses = [line for line in figure.axes[0].lines if line.get_marker() == "x"]
    assert {line.get_color() for line in crosses} == {assign_solver_styles()["lbfgs"].color}
    plots = [one for one in select_curve_plots(chart) if one.group[1] == "12" and one.name[1] == "iterations"]
    shown = {one.name[0]: [words for curve in one.series for words in curve.callouts.values()] for one in plots}
    assert shown == {"gap": ["minimum 1"], "largest": [], "stationarity": [], "metres": []}
    figure = compose_figure(plots[:1], "", FigureOptions())
    (ring,) = (line for line in figure.axes[0].lines if line.get_markerfacecolor() == "none")
    assert ring.get_markeredgecolor() == TEXT_COLOUR
    assert "minimum 1" in [text.get_text() for text in figure.axes[0].texts]


def test_the_default_and_methods_that_do_not_minimise_are_marked(table: AccuracyData) -> None:
    chart = build_accuracy_chart("work", table)
    callouts = [words for frame in chart.frames for series in frame.series for words in series.callouts.values()]
    assert callouts == ["the default"]
    labels = {series.label for frame in chart.frames for series in frame.series}
    assert labels == {"best of all", "numba", "hybrid", "xpbd †"}


def test_growth_states_the_fitted_power(table: AccuracyData) -> None:
    (frame,) = build_accuracy_chart("growth", table).frames
    assert [series.label for series in frame.series] == ["numba n^1.00", "newton"], "two sizes give no power"
    assert "Not reached by newton at 144 vertices." in frame.notes


def test_the_paper_s_newton_is_drawn_by_time_alone(table: AccuracyData) -> None:
    chart = build_accuracy_chart("liu2013", table)
    plots = {one.name: one for one in select_curve_plots(chart, [chart.frames[0]])}
    assert [*plots] == [("iterations",), ("time",)]
    names = [[series.label for series in plots[name].series] for name in plots]
    assert ["their Newton" in labels for labels in names] == [False, True]
    assert all(labels[:2] == ["ours", "Liu et al. 2013"] for labels in names)


@pytest.mark.parametrize("name", CHART_NAMES)
def test_the_page_draws_the_numbers_of_the_figures(table: AccuracyData, name: str) -> None:
    chart = build_accuracy_chart(name, table)
    page = json.loads(json.dumps(serialise_chart(chart), allow_nan=False))
    assert len(page["items"]) == sum(len(frame.series) for frame in chart.frames)
    axes = {axis["column"]: axis for axis in (*page["x"], *page["y"])}
    assert all(len({len(item[column]) for column in axes}) == 1 for item in page["items"]), "a column is missing"
    for frame in chart.frames:
        for plot in select_curve_plots(chart, [frame]):
            for up in chart.y:
                if up.name and up.name not in plot.name:
                    continue
                for curve in plot.series:
                    values = [
                        item[up.column]
                        for item in page["items"]
                        if item["label"] == curve.label and item[chart.subject_key] == frame.subject
                    ]
                    drawn = [None if np.isnan(y) else float(f"{y:.5g}") for y in curve.y]
                    assert drawn in values, (curve.label, up.column)
    assert all(axis["title"] for axis in axes.values())


def test_a_band_and_notes_belong_to_their_frame_on_the_page(table: AccuracyData) -> None:
    chart = build_accuracy_chart("convergence", table)
    page = serialise_chart(chart)
    at = chart.frames.index(find_frame(chart, "net 6, peak"))
    assert {item["frame"] for item in page["items"] if item["label"] in ("lbfgs", "dense")} == {at}
    assert any("not certified" in note for note in page["frames"][at]["notes"])
    shaded = [frame["bands"] for frame in page["frames"] if frame["bands"]]
    assert all(set(bands) == {"gap"} for bands in shaded)


def test_a_map_on_the_page_has_the_cells_of_the_figure(tmp_path: Path) -> None:
    rows = read_ablations(synthetic_results.write_ablation_results(tmp_path), "overhead")["cloth"]
    chart = build_overhead_chart(rows)
    (shown,), (drawn,) = serialise_chart(chart)["maps"], chart.maps
    assert [cell[:2] for cell in shown["cells"]] == [[cell.row, cell.column] for cell in drawn.cells]
    classes = [shown["outcomes"][cell[2]] for cell in shown["cells"]]
    assert [(one["label"], one["color"]) for one in classes] == [(cell.outcome, cell.color) for cell in drawn.cells]
    assert [cell[3] for cell in shown["cells"]] == [row["value_text"] for row in drawn.csv_rows()]


def test_names_on_the_page_are_those_of_their_frame(tmp_path: Path) -> None:
    rows = read_ablations(synthetic_results.write_ablation_results(tmp_path), "overhead")["cloth"]
    page = serialise_chart(build_overhead_chart(rows))
    assert page["items"][0]["effect"] == [*reversed(synthetic_results.EFFECT_NAMES)], "the most expensive first"
    assert page["frames"][0]["place_names"] == {"effect": page["items"][0]["effect"]}


def test_maps_with_the_same_columns_become_one() -> None:
    def build_map(title: str, column: str, is_stale: bool) -> CellMap:
        cells = [MapCell("row", column, "good", "#123456", "1", is_stale)]
        notes = ["read it so", *describe_stale_cells(cells)]
        return CellMap(("map",), (title,), "", title, cells, [CellOutcome("good", "#123456")], notes)

    merged = merge_cell_maps([build_map("a", "x", True), build_map("b", "x", False), build_map("c", "y", False)])
    assert [one.row_names for one in merged] == [["a: row", "b: row"], ["row"]]
    assert merged[0].notes == ["read it so", "Dot: measured by other code than today's."]
    assert merged[0].name == ("a", "b")


def test_a_marked_value_of_x_is_an_upright_line() -> None:
    chart = build_small_chart((10.0, 20.0))
    bands, lines = {"n": [ShadedBand(0.0, 12.0, "small")]}, {"n": [MarkedValue(30.0, "m")]}
    frame = replace(chart.frames[0], bands=bands, lines=lines)
    (plot,) = select_curve_plots(replace(chart, frames=[frame]))
    ax = compose_figure([plot], "", FigureOptions()).axes[0]
    assert [30.0, 30.0] in [np.asarray(line.get_xdata()).tolist() for line in ax.lines]
    assert ax.get_xlim()[1] > 30.0
    assert serialise_chart(replace(chart, frames=[frame]))["frames"][0]["lines"] == {"n": [[30.0, "m"]]}


@pytest.mark.parametrize(
    ("limits", "best", "marked"),
    [
        (RecommendationLimits(0.05), "fine", {"error": [(0.05, "requested: 5 %")], "seconds": []}),
        (RecommendationLimits(None, 0.3), "finer", {"error": [], "seconds": [(0.3, "budget: 300 ms")]}),
    ],
    ids=["error", "budget"],
)
def test_the_cheapest_or_the_most_accurate_candidate_is_recommended(
    limits: RecommendationLimits, best: str, marked: dict
) -> None:
    points = [
        CandidatePoint("newton", 50.0, 0.01, "unstable"),
        CandidatePoint("newton", 0.1, 0.1, "coarse"),
        CandidatePoint("hybrid", 0.02, 0.2, "fine"),
        CandidatePoint("newton", 0.01, 0.3, "finer"),
    ]
    (frame,) = build_recommendation_chart("Ways", ["a fact"], points, limits).frames
    words = {series.columns["candidate"][k]: text for series in frame.series for k, text in series.callouts.items()}
    assert words[best] == "recommended"
    assert "unstable" not in words
    assert frame.lines == marked
    assert frame.notes[0] == "a fact; 1 unstable setting not shown."
    assert frame.notes[1].startswith(f"Recommended: {best}: an error of")
    assert ("1.5 times as long" in " ".join(frame.notes)) == (limits.error is not None)


def build_small_chart(sizes: tuple[float, ...]) -> ChartDescription:
    """Two solvers whose times have intervals, at these sizes."""
    series = [
        ChartSeries(
            label,
            STYLE,
            {
                "n": sizes,
                "t": [cost * n for n in sizes],
                "t_low": [0.9 * cost * n for n in sizes],
                "t_high": [1.1 * cost * n for n in sizes],
            },
        )
        for label, cost in (("slow", 2.0), ("fast", 1.0))
    ]
    frame = ChartFrame(("net",), ("step",), "net", "", series, lines={}, x_label="")
    scales = AxisScale("vertices", "sizes"), AxisScale("wall time", "log", "time")
    return ChartDescription("Time", "", [frame], (ChartAxis("n", scales[0]),), (ChartAxis("t", scales[1]),), "scene")


def test_several_sizes_are_curves_with_their_intervals() -> None:
    (plot,) = select_curve_plots(build_small_chart((10.0, 20.0)))
    assert (plot.x.division, plot.y.division) == ("sizes", "log")
    assert plot.series[0].lower is not None
    assert plot.series[0].lower.tolist() == [18.0, 36.0]
    assert not plot.series[0].is_horizontal


def test_one_size_has_a_row_for_each_series_the_least_first() -> None:
    (plot,) = select_curve_plots(build_small_chart((10.0,)))
    assert (plot.x.label, plot.y.place_names) == ("wall time", ("fast", "slow"))
    assert [(series.label, series.x.tolist(), series.y.tolist()) for series in plot.series] == [
        ("fast", [10.0], [0.0]),
        ("slow", [20.0], [1.0]),
    ]
    assert all(series.is_horizontal and not series.is_connected for series in plot.series)


def test_panels_with_one_quantity_have_the_same_limits(table: AccuracyData) -> None:
    chart = build_convergence_chart(table)
    plots = [one for one in select_curve_plots(chart) if one.name == ("gap", "iterations") and "early" in one.group]
    figure = compose_figure(plots[:2], "", FigureOptions(width_mm=180.0))
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()


def test_every_sheet_is_there_in_both_formats_and_nothing_half_written(tmp_path: Path) -> None:
    files = draw_accuracy_report(made.write_accuracy_rows(tmp_path, [*made.build_work_rows("net", 6)]))
    pictures = [path for path in files if path.suffix == ".png"]
    stems = [path.relative_to(tmp_path / "report").with_suffix("").as_posix() for path in pictures]
    assert stems == ["work/net-6", "winners"]
    assert [path.with_suffix(".svg") for path in pictures] == [path for path in files if path.suffix == ".svg"]
    assert not list(tmp_path.rglob(".*")), "no partial file is left"
    for path in pictures:
        with Image.open(path) as image:
            assert image.width == PAGE_WIDTH
            assert np.asarray(image.convert("L")).std() > 3, "an empty page has no variance"
        assert "<svg" in path.with_suffix(".svg").read_text()[:1000]


def write_published_study(folder: Path, rows: list[dict]) -> Path:
    """Write a published set of one study with these rows; returns its folder."""
    home = folder / "published" / "study"
    home.mkdir(parents=True)
    rows = [row | {row_store.FILE_COLUMN: "0"} for row in rows]
    schema = ACCURACY_SCHEMA.append(pa.field(row_store.FILE_COLUMN, pa.string()))
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), home / TABLE_FILES["accuracy"])
    facts = {"config": "x.yaml", "is_timed": True, "runs": 1, "duration_seconds": 1.0, "command": "x"}
    (home / STUDY_FILE).write_text(json.dumps(facts | {"machines": [{}], "files": {}}))
    return home.parent


def test_published_curves_are_grey_behind_those_of_the_same_step_and_solver(tmp_path: Path) -> None:
    def build_rows(*solvers: str, slower: float = 1.0) -> list[dict]:
        rows = []
        for size in (6, 12):
            rows += made.build_snapshot_rows("net", size, "early")
            for solver in solvers if size == 6 else ("newton",):
                rows += made.build_curve_rows("net", size, "early", solver)
        rows += made.build_work_rows("net", 6, ("hybrid",))
        return [row | {"seconds": [slower * t for t in row["seconds"]]} if row.get("seconds") else row for row in rows]

    own = read_accuracy(made.write_accuracy_rows(tmp_path, build_rows("numba", "newton")))
    published = write_published_study(tmp_path, build_rows("numba", "lbfgs", slower=3.0))
    small, large = build_compared_chart("convergence", own, published=published).frames
    assert [series.label for series in small.series] == [PUBLISHED_LABEL, "numba", "newton"]
    grey, mine = small.series[:2]
    assert grey.description.startswith("numba, published")
    assert np.allclose(grey.columns["seconds"], 3.0 * np.asarray(mine.columns["seconds"]))
    assert any("grey" in note for note in small.notes)
    assert [series.label for series in large.series] == [PUBLISHED_LABEL, "newton"]
    for name in ("times", "work"):
        frame = build_compared_chart(name, own, published=published).frames[0]
        assert frame.series[0].label == PUBLISHED_LABEL, "it is drawn first"
    assert not any(
        series.label == PUBLISHED_LABEL
        for name in CHART_NAMES
        for frame in build_compared_chart(name, own, published=tmp_path / "none").frames
        for series in frame.series
    )


def test_the_same_chart_gives_the_same_vectors(tmp_path: Path) -> None:
    once, again = (draw_chart_sheets(build_small_chart((1.0, 2.0)), tmp_path / name)[1] for name in ("once", "again"))
    assert once.read_bytes() == again.read_bytes()


def test_published_times_are_in_the_row_of_their_solver(tmp_path: Path) -> None:
    folder = synthetic_results.write_sweep_results(tmp_path, sizes=(8,))
    runs = read_run_times(parquet_rows.read_rows(row_store.list_units(folder / "rows")))
    slower = build_timing_chart([run._replace(step=10.0 * (run.step or 0.0)) for run in runs], machine_words="theirs")
    chart = add_published_curves(build_timing_chart(runs), [slower])
    plot = next(plot for plot in select_curve_plots(chart) if plot.name == ("step",))
    places = {series.setting or series.label: float(series.y[0]) for series in plot.series}
    assert [series.label for series in plot.series[:2]] == [PUBLISHED_LABEL, plot.y.place_names[0]]
    assert len(plot.y.place_names) == len(plot.series) / 2 == len(places)
    assert plot.series[0].style.marker == "o", "a single point has a marker"
    assert plot.series[0].x == pytest.approx(10.0 * plot.series[1].x)
    page = serialise_chart(chart)
    grey = next(item for item in page["items"] if item["label"] == PUBLISHED_LABEL)
    assert grey["provenance"] == [{"commit": None, "cpu": "theirs"}]
    other = build_timing_chart([run._replace(parameters_json='{"omega": 2}') for run in runs])
    compared = add_published_curves(build_timing_chart(runs), [other])
    assert all(series.label != PUBLISHED_LABEL for frame in compared.frames for series in frame.series)


def test_times_on_the_page_have_units_and_sizes_their_numbers() -> None:
    page = serialise_chart(build_small_chart((10.0, 20.0)))
    assert page["y"][0]["axis"] == {"type": "log", "tickformat": "$~s"}, "the page's currency is the second"
    assert page["y"][0]["format"] == "time"
    assert page["x"][0]["axis"]["tickmode"] == "array"
