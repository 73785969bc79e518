"""Outside engines compared with ours: what is compared, and what the table of ratios says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from springbench.harness.report.accuracy.accuracy_data import WorkPoint
from springbench.harness.report.accuracy.accuracy_findings import summarise_findings
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.engine_comparison import (
    OWN_PROGRAM,
    compare_engines,
    describe_best_settings,
    find_pareto_fronts,
    format_markdown_table,
)
from springbench.harness.report.charts.chart_description import select_curve_plots
from springbench.harness.report.charts.engine_chart import build_engine_chart
from springbench.harness.report.site.chart_json import serialise_chart

from tests import synthetic_accuracy_rows as made
from tests import synthetic_results


@pytest.fixture
def works(tmp_path: Path) -> list[WorkPoint]:
    return list(read_accuracy(synthetic_results.write_engine_results(tmp_path)).work_points)


def test_a_ratio_is_of_the_best_settings_that_end_within_the_error(works: list[WorkPoint]) -> None:
    found = {(one.mesh, one.error): one for one in compare_engines(works)}
    # Errors of 1/steps, 1/steps^2 and 1/steps^4 for 1, 2 and 30 times 0.1 ms a step.
    assert found["net 9", 1e-1].time_ratio("mujoco") == pytest.approx(30.0)
    assert found["net 9", 1e-1].fastest_by_program[OWN_PROGRAM].label == "hybrid"
    assert found["net 9", 1e-2].fastest_by_program[OWN_PROGRAM].label == "velocity-verlet"
    assert found["net 9", 1e-2].time_ratio("mujoco") == pytest.approx(3.75), "10 steps of 3 ms against 40 of .2"
    assert found["net 9", 1e-1].time_ratio("pypbd") == pytest.approx(5.0)
    assert found["net 9", 1e-3].time_ratio("pypbd") is None, "its error is 1/160 at the least"
    assert found["net 9", 1e-6].time_ratio("mujoco") is None, "ours do not get there"


def test_the_table_names_programs_that_refuse_that_have_no_rival_and_that_miss_the_error(
    works: list[WorkPoint],
) -> None:
    head, _, *rows = format_markdown_table(works)
    assert [cell.strip() for cell in head.split("|")[3:5]] == ["mujoco", "pypbd"]
    cells = {tuple(c.strip() for c in row.split("|")[1:3]): [c.strip() for c in row.split("|")[3:5]] for row in rows}
    assert cells["net 9", "1e-1"] == ["30", "5"]
    assert cells["net 9", "1e-3"][1] == "–"
    assert cells["stiff 9", "1e-1"] == ["30", "refused"]
    assert cells["net 9", "1e-6"] == ["alone", "–"]
    assert any("net 9 to 1e-2, mujoco: " in message for message in describe_best_settings(works))
    assert all(OWN_PROGRAM not in message for message in describe_best_settings(works))


def test_a_front_contains_undominated_settings_of_the_program(works: list[WorkPoint]) -> None:
    best = find_pareto_fronts([work for work in works if work.mesh_label == "net 9"])
    assert list(best) == [OWN_PROGRAM, "mujoco", "pypbd"]
    assert [work.label for work in best[OWN_PROGRAM]] == [
        "hybrid",
        "velocity-verlet",
        "velocity-verlet",
        "velocity-verlet",
    ]


def test_each_mesh_has_a_panel_where_engines_and_own_solvers_were_tried(tmp_path: Path) -> None:
    panels = [*select_curve_plots(build_engine_chart(read_accuracy(synthetic_results.write_engine_results(tmp_path))))]
    assert [(one.group, one.name) for one in panels] == [(("engines",), ("net", "9")), (("engines",), ("stiff", "9"))]
    drawn = panels[1]
    assert [series.label for series in drawn.series] == [OWN_PROGRAM, "mujoco"], "pypbd refuses it"


def test_the_page_has_a_line_for_each_program_on_each_mesh(tmp_path: Path) -> None:
    chart = build_engine_chart(read_accuracy(synthetic_results.write_engine_results(tmp_path)))
    items = serialise_chart(chart)["items"]
    assert {(item["scene"], item["label"]) for item in items} == {
        *(("net 9", OWN_PROGRAM), ("net 9", "mujoco"), ("net 9", "pypbd")),
        *(("stiff 9", OWN_PROGRAM), ("stiff 9", "mujoco")),
    }
    assert all(len(item["setting"]) == len(item["seconds"]) for item in items)


def test_nothing_is_reported_where_no_engine_was_tried(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = list(made.build_work_rows("net", 10))
    findings = summarise_findings(read_accuracy(made.write_accuracy_rows(tmp_path, rows)))
    assert not [title for title in findings if "engine" in title]
    assert not build_engine_chart(read_accuracy(tmp_path)).frames
