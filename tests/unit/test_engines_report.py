"""Outside engines beside ours: what is compared, and what the table of ratios says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from harness.report.accuracy.engines import OURS, fronts, settings, standings, table
from harness.report.accuracy.findings import findings
from harness.report.accuracy.measured import WorkPoint
from harness.report.accuracy.reading import read
from harness.report.figures.of_engines import engines
from harness.report.figures.panel import Plot
from harness.report.site.engines import chart
from tests import accuracy_rows as made
from tests import figure_results


@pytest.fixture
def works(tmp_path: Path) -> list[WorkPoint]:
    return list(read(figure_results.engines(tmp_path)).works)


def test_a_ratio_is_of_the_best_settings_that_end_within_the_error(works: list[WorkPoint]) -> None:
    found = {(one.mesh, one.error): one for one in standings(works)}
    # Errors of 1/steps, 1/steps^2 and 1/steps^4 for 1, 2 and 30 times 0.1 ms a step.
    assert found["net 9", 1e-1].ratio("mujoco") == pytest.approx(30.0)
    assert found["net 9", 1e-1].best[OURS].label == "hybrid"
    assert found["net 9", 1e-2].best[OURS].label == "velocity-verlet"
    assert found["net 9", 1e-2].ratio("mujoco") == pytest.approx(3.75), "10 steps of 3 ms against 40 of .2"
    assert found["net 9", 1e-1].ratio("pypbd") == pytest.approx(5.0)
    assert found["net 9", 1e-3].ratio("pypbd") is None, "its error is 1/160 at the least"
    assert found["net 9", 1e-6].ratio("mujoco") is None, "ours do not get there"


def test_and_the_table_says_who_refuses_who_is_alone_and_who_does_not_get_there(works: list[WorkPoint]) -> None:
    head, _, *rows = table(works)
    assert [cell.strip() for cell in head.split("|")[3:5]] == ["mujoco", "pypbd"]
    cells = {tuple(c.strip() for c in row.split("|")[1:3]): [c.strip() for c in row.split("|")[3:5]] for row in rows}
    assert cells["net 9", "1e-1"] == ["30", "5"]
    assert cells["net 9", "1e-3"][1] == "–"
    assert cells["stiff 9", "1e-1"] == ["30", "refused"]
    assert cells["net 9", "1e-6"] == ["alone", "–"]
    assert any("net 9 to 1e-2, mujoco: " in told for told in settings(works))
    assert all(OURS not in told for told in settings(works))


def test_a_front_holds_what_no_other_setting_of_the_program_beats(works: list[WorkPoint]) -> None:
    best = fronts([work for work in works if work.mesh == "net 9"])
    assert list(best) == [OURS, "mujoco", "pypbd"]
    assert [work.label for work in best[OURS]] == ["hybrid", "velocity-verlet", "velocity-verlet", "velocity-verlet"]


def test_each_mesh_has_a_panel_where_engines_and_ours_were_tried(tmp_path: Path) -> None:
    panels = [entry.make() for entry in engines(figure_results.engines(tmp_path))]
    assert [(one.of, one.name) for one in panels] == [(("engines",), ("net", "9")), (("engines",), ("stiff", "9"))]
    drawn = panels[1]
    assert isinstance(drawn, Plot)
    assert [series.label for series in drawn.series] == [OURS, "mujoco"], "pypbd refuses it"


def test_the_page_has_a_line_for_each_program_on_each_mesh(tmp_path: Path) -> None:
    items = chart(read(figure_results.engines(tmp_path)))["items"]
    assert {(item["scene"], item["label"]) for item in items} == {
        *(("net 9", OURS), ("net 9", "mujoco"), ("net 9", "pypbd")),
        *(("stiff 9", OURS), ("stiff 9", "mujoco")),
    }
    assert all(len(item["setting"]) == len(item["seconds"]) for item in items)


def test_and_nothing_is_told_where_no_engine_was_tried(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = list(made.work("net", 10))
    told = findings(read(made.write(tmp_path, rows)))
    assert not [title for title in told if "engine" in title]
    assert not engines(tmp_path)
    assert not chart(read(tmp_path))["items"]
