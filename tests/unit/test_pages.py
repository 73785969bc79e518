"""Pages are made from the published set: equal data give equal bytes, and anything stale is found."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib.patches import Rectangle
from matplotlib.text import Annotation
from springbench.harness.cli.main import app
from springbench.harness.experiments.archive import study_publication
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CellOutcome,
    CurvePlot,
    CurveSeries,
    FigurePanel,
    MapCell,
    ShadedBand,
)
from springbench.harness.report.figures.figure_layout import compose_figure
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.pages.page_charts import ChartPoint, PageChartOptions, build_page_panel
from springbench.harness.report.pages.page_files import check_pages, write_pages
from springbench.harness.report.pages.page_templates import digest_panels
from springbench.harness.report.pages.published_queries import PublishedQueries
from springbench.harness.report.plot_style import SeriesStyle
from springbench.harness.results.parquet_rows import write_rows
from springbench.harness.results.published_set import read_study
from typer.testing import CliRunner

from tests.bench.scripted_study import add_provenance, describe_provenance, publish_rows
from tests.contracts.hostile import scene
from tests.synthetic_accuracy_rows import build_work_rows, write_accuracy_rows
from tests.synthetic_run_rows import build_dummy_rows, write_dummy_runs

CONFIGS = Path(__file__).resolve().parents[2] / "configs"

TEMPLATE = """# Runs

{{ value("SELECT count(DISTINCT run_id) FROM dummy") }} runs, of which {{ (0.25) | percent }} are slow.

{{ table("SELECT solver, sum(num_iterations) AS iterations FROM dummy GROUP BY ALL ORDER BY ALL") }}

{{ bars("iterations", "All take 50",
"SELECT solver AS series, avg(num_iterations) AS y FROM dummy GROUP BY ALL ORDER BY 1", "Iterations by solver") }}

{{ provenance("dummy") }}
"""

SWEEP = "scenes: [cloth.yaml]\nsizes: [4]\nsolvers: [sparse, dense]\n"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout with one published study and one template."""
    write_dummy_runs(tmp_path / "runs", 10)
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "cloth.yaml").write_text(scene())
    (tmp_path / "configs" / "dummy.yaml").write_text(SWEEP)
    publish_dummy_study(tmp_path)
    (tmp_path / "results" / "findings").mkdir()
    (tmp_path / "results" / "findings" / "runs.md.j2").write_text(TEMPLATE)
    return tmp_path


def publish_dummy_study(root: Path) -> None:
    config, published = root / "configs" / "dummy.yaml", root / "results" / "published"
    arguments = ["publish-study", str(root / "runs"), "--config", str(config), "--published", str(published)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output


def test_a_study_states_what_made_it(checkout: Path) -> None:
    study = read_study(checkout / "results" / "published" / "dummy")
    assert study.config_path == (checkout / "configs" / "dummy.yaml").resolve()
    assert study.metadata["command"] == "springbench run configs/dummy.yaml"
    assert study.metadata["runs"] == 10
    assert study.metadata["machines"][0]["cpu"] == "a processor"
    assert study.metadata["versions"] == {"numpy": "2.4"}
    table = study.read_table("rows")
    assert table.num_rows == 20
    assert "positions_digest" not in table.column_names


def test_a_study_gains_the_runs_of_its_parts(checkout: Path) -> None:
    study = checkout / "results" / "published" / "dummy"
    write_dummy_runs(checkout / "more", 3, first_number=10)
    arguments = ["publish-study", str(study), str(checkout / "more"), "--config", str(checkout / "configs/dummy.yaml")]
    for _ in range(2):  # a run that is published already is published once
        result = CliRunner().invoke(app, [*arguments, "--published", str(study.parent)])
        assert result.exit_code == 0, result.output
        assert read_study(study).metadata["runs"] == 13
        assert read_study(study).read_table("rows").num_rows == 26


def test_a_study_of_outcomes_has_no_times(checkout: Path) -> None:
    study = checkout / "results" / "published" / "dummy"
    arguments = ["publish-study", str(checkout / "runs"), "--config", str(checkout / "configs/dummy.yaml")]
    columns = list[set[str]]()
    for options in ([], ["--omit-times"]):
        result = CliRunner().invoke(app, [*arguments, *options, "--published", str(study.parent)])
        assert result.exit_code == 0, result.output
        columns.append(set(read_study(study).read_table("rows").column_names))
    assert not read_study(study).is_timed
    assert "seconds" in columns[0] - columns[1]
    assert "num_iterations" in columns[1]


def test_a_newer_part_without_software_replaces_no_runs(checkout: Path) -> None:
    newer = checkout / "newer" / "rows"
    newer.mkdir(parents=True)
    for number in range(5):
        rows = [row | {"started_at": "2026-01-02T00:00:00+00:00"} for row in build_dummy_rows(number)]
        rows = [row | {"status": "unsupported"} if row["solver"] == "numba" else row for row in rows]
        write_rows(newer / f"{number}.parquet", rows)
    parts = [checkout / "results" / "published" / "dummy", newer.parent]
    study = study_publication.write_study(
        parts, checkout / "configs" / "dummy.yaml", checkout / "results" / "published", lambda line: None
    )
    found = {row["run_id"]: row["started_at"][:10] for row in study.read_table("rows").to_pylist()}
    assert found == {f"{n:012x}": "2026-01-02" if n < 5 and n != 1 else "2026-01-01" for n in range(10)}


def test_units_of_a_newer_part_replace_those_of_the_same_file(tmp_path: Path) -> None:
    for part, error, date in (("older", 0.2, "2026-01-01"), ("newer", 0.1, "2026-01-02")):
        rows = [row | {"error": error, "started_at": date} for row in build_work_rows("net", 10)]
        write_accuracy_rows(tmp_path / part, rows)
    more = [row | {"started_at": "2026-01-02"} for row in build_work_rows("net", 24)]
    write_accuracy_rows(tmp_path / "newer", more)  # a file that the older part has not
    study = study_publication.write_study(
        [tmp_path / "older", tmp_path / "newer"], CONFIGS / "engines.yaml", tmp_path / "published", lambda line: None
    )
    units = study.read_table("accuracy").to_pylist()
    assert {(row["size"], row["error"]) for row in units if row["size"] == 10} == {(10, 0.1)}
    assert len(units) == len(rows) + len(more)


def test_rows_of_a_script_are_a_study_with_what_made_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = SimpleNamespace(__spec__=SimpleNamespace(name="tests.bench.ratios"))
    monkeypatch.setitem(sys.modules, "__main__", script)
    monkeypatch.setattr(sys, "argv", ["ratios.py", "--sizes", "8", "--publish", "results/published/ratios", "--all"])
    begin = describe_provenance()
    rows = [{"solver": "newton", "ratio": 1.5}, {"solver": "vbd", "ratio": None, "reason": "not there"}]
    publish_rows(tmp_path / "ratios", CONFIGS / "speed.yaml", rows, begin)
    study = read_study(tmp_path / "ratios")
    assert study.metadata["command"] == "python -m tests.bench.ratios --sizes 8 --all"
    assert len(study.metadata["load_average"]) == len(study.metadata["started"]) == 2
    found = PublishedQueries(tmp_path).query_records("SELECT solver, ratio, reason FROM ratios ORDER BY solver")
    assert found == [rows[0] | {"reason": None}, rows[1]]


def test_a_study_that_is_too_large_leaves_the_published_one_as_it_is(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study = checkout / "results" / "published" / "dummy"
    before = {path: path.read_bytes() for path in study.parent.rglob("*") if path.is_file()}
    monkeypatch.setattr(study_publication, "MAX_PUBLISHED_BYTES", 100)
    config = str(checkout / "configs" / "dummy.yaml")
    arguments = ["publish-study", str(checkout / "runs"), "--config", config, "--published", str(study.parent)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2, result.output
    assert "publish fewer runs" in " ".join(result.output.split())
    assert {path: path.read_bytes() for path in study.parent.rglob("*") if path.is_file()} == before


def test_an_interrupted_publication_removes_no_published_table(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study = checkout / "results" / "published" / "dummy"
    before = {path.name: path.read_bytes() for path in study.glob("*.parquet")}

    def interrupt(source: Path, target: Path) -> None:
        if target.parent == study:
            raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        study_publication.write_study(
            [checkout / "runs"], checkout / "configs" / "dummy.yaml", study.parent, lambda line: None
        )
    assert {path.name: path.read_bytes() for path in study.glob("*.parquet")} == before


def test_equal_data_give_equal_bytes(checkout: Path) -> None:
    page, picture = (checkout / "results" / "findings" / name for name in ("runs.md", "pictures/iterations.png"))
    assert set(write_pages(checkout)) == {page, picture}
    text, pixels = page.read_bytes(), picture.read_bytes()
    assert "10 runs, of which 25 % are slow." in page.read_text()
    assert "| hybrid | 200 |" in page.read_text()
    assert "`springbench run configs/dummy.yaml`, 10 of 2 runs, a processor, 2 cores, 2026-01-01" in page.read_text()
    assert check_pages(checkout, draws_pictures=True) == []
    assert write_pages(checkout) == []
    page.unlink()
    picture.unlink()
    write_pages(checkout)
    assert (page.read_bytes(), picture.read_bytes()) == (text, pixels)


def test_a_changed_figure_in_the_data_makes_page_and_picture_stale(checkout: Path) -> None:
    write_pages(checkout)
    write_dummy_runs(checkout / "runs", 3, frames=3, first_number=10)
    publish_dummy_study(checkout)
    assert [line.rpartition("/")[2].split()[0] for line in check_pages(checkout)] == ["runs.md"]
    (checkout / "results" / "findings" / "runs.md.j2").write_text(TEMPLATE.replace("avg(", "sum("))
    assert "iterations.png shows other data than the published set has" in " ".join(check_pages(checkout))
    result = CliRunner().invoke(app, ["pages", str(checkout), "--check"])
    assert result.exit_code == 1


def test_a_replaced_picture_is_stale(checkout: Path) -> None:
    write_pages(checkout)
    picture = checkout / "results" / "findings" / "pictures" / "iterations.png"
    picture.write_bytes(picture.read_bytes() + b" ")
    assert check_pages(checkout) == [f"{picture} is not the file that `springbench pages` wrote"]


def test_a_table_that_was_edited_is_refused(checkout: Path) -> None:
    path = checkout / "results" / "published" / "dummy" / "runs.parquet"
    pq.write_table(pq.read_table(path).slice(1), path)
    result = CliRunner().invoke(app, ["pages", str(checkout)])
    assert result.exit_code == 2
    assert "differs from its checksum" in result.output


def test_a_picture_of_a_page_without_pictures_is_of_no_page(checkout: Path) -> None:
    write_pages(checkout)
    (checkout / "results" / "findings" / "runs.md.j2").write_text("# Runs\n")
    picture = checkout / "results" / "findings" / "pictures" / "iterations.png"
    assert f"{picture} is a picture of no page" in check_pages(checkout)
    write_pages(checkout)
    assert not picture.exists()


@pytest.mark.parametrize(
    ("template", "message"),
    [
        ("{{ value('SELECT count(*) FROM nothing') }}", "nothing"),
        ("{{ value('SELECT size FROM dummy') }}", "gives 20 rows of 1 columns: select one column"),
        ("{{ table('SELECT size FROM dummy WHERE false') }}", "table() expected rows"),
        ("{{ provenance('dumy') }}", "unknown study 'dumy'; expected one of dummy; did you mean 'dummy'?"),
        ("{{ figure('a', 'A', 'work', 'x', 'a') }}", "unknown study 'x'; expected one of dummy"),
        ("{{ unknown }}", "'unknown' is undefined"),
        ("text\n{% if %}", "runs.md.j2:2: "),
    ],
)
def test_a_mistake_in_a_template_is_named(checkout: Path, template: str, message: str) -> None:
    (checkout / "results" / "findings" / "runs.md.j2").write_text(template)
    result = CliRunner().invoke(app, ["pages", str(checkout)])
    assert result.exit_code == 2
    assert "runs.md.j2" in result.output
    assert message in " ".join(result.output.split())


CURVE = CurveSeries("newton", SeriesStyle("#0072b2", "o"), np.array([1.0, np.nan]), np.array([2.0, 3.0]))
PLOT = CurvePlot(("page",), ("curves",), "", "", AxisScale("size"), AxisScale("time"), [CURVE])
CELL = MapCell("contact", "newton", "80 % and more", "#1f7a55", "83")
MAP = CellMap(("page",), ("shares",), "", "", [CELL], [CellOutcome("80 % and more", "#1f7a55")])


@pytest.mark.parametrize(
    ("shown", "changed"),
    [
        (MAP, replace(MAP, cells=[CELL._replace(mark="!")])),
        (MAP, replace(MAP, cells=[CELL._replace(is_framed=True)])),
        (MAP, replace(MAP, column_label="solver")),
        (PLOT, replace(PLOT, bands=[ShadedBand(0.0, 1.0, "round-off")])),
        (PLOT, replace(PLOT, machine_words="a processor")),
        (PLOT, replace(PLOT, series=[replace(CURVE, callouts={0: "the default"})])),
        (PLOT, replace(PLOT, series=[replace(CURVE, x=np.array([1.5, np.nan]))])),
    ],
)
def test_the_digest_of_a_picture_covers_whatever_it_shows(shown: FigurePanel, changed: FigurePanel) -> None:
    assert digest_panels([shown], "", 100.0) == digest_panels([replace(shown)], "", 100.0)
    assert digest_panels([shown], "", 100.0) != digest_panels([changed], "", 100.0)


def test_a_line_has_a_gap_where_a_value_is_missing() -> None:
    points = [ChartPoint("a", float(x), y) for x, y in enumerate((1.0, None, 3.0, None))]
    panel = build_page_panel("curves", "lines", points, PageChartOptions())
    assert isinstance(panel, CurvePlot)
    assert np.isnan(panel.series[0].y).tolist() == [False, True, False, True]
    ax = compose_figure([panel], "", FigureOptions()).axes[0]
    assert [text.xy for text in ax.texts if isinstance(text, Annotation)] == [(2.0, 3.0)], "the label is at a value"


def test_bars_begin_at_no_difference_and_state_their_values() -> None:
    points = [ChartPoint("fast", 0.0, 0.5), ChartPoint("slow", 0.0, 4.0, 3.0, 6.0), ChartPoint("none", 0.0, None)]
    options = PageChartOptions(x_label="ratio", x_scale="log", highlights=["slow"], limit=(2.0, "twice"))
    ax = compose_figure([build_page_panel("ratios", "bars", points, options)], "", FigureOptions()).axes[0]
    fast, slow = (patch for patch in ax.patches if isinstance(patch, Rectangle))
    assert (fast.get_x(), fast.get_width()) == (1.0, -0.5), "a ratio of 1 is no bar"
    assert slow.get_width() == 3.0
    assert fast.get_facecolor() != slow.get_facecolor()
    assert [text.get_text() for text in ax.texts] == ["twice", "0.5", "4"]


def test_lines_that_a_chart_is_not_about_are_grey_and_share_a_label() -> None:
    points = [ChartPoint(name, x, x + k) for k, name in enumerate("abc") for x in (1.0, 2.0)]
    panel = build_page_panel("curves", "lines", points, PageChartOptions(highlights=["b"]))
    assert isinstance(panel, CurvePlot)
    assert [(one.label, one.setting) for one in panel.series] == [("others", "a"), ("others", "c"), ("b", "b")]


def test_a_heat_map_states_shares_in_percent() -> None:
    points = [ChartPoint("newton", "contact", 0.834), ChartPoint("xpbd", "contact", None)]
    panel = build_page_panel("shares", "heatmap", points, PageChartOptions())
    assert isinstance(panel, CellMap)
    assert [(cell.value_text, cell.outcome) for cell in panel.cells] == [("83", "80 % and more"), ("", "none")]


def test_a_study_with_earlier_rows_states_the_machines_and_commits_of_all():
    earlier = {"commits": ["a"], "machines": [{"cpu": "x"}], "started": ["1", "3"], "load_average": [1.0], "runs": 4}
    new = {"commits": ["b", "a"], "machines": [{"cpu": "y"}], "started": ["2", "5"], "load_average": [], "runs": 6}
    assert add_provenance(earlier, new) == {
        "commits": ["a", "b"],
        "machines": [{"cpu": "x"}, {"cpu": "y"}],
        "started": ["1", "5"],
        "load_average": [1.0, 1.0],
        "runs": 6,
    }
