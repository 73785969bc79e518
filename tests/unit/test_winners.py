"""The map of winners: families, prices of errors, and what its cells say."""

from __future__ import annotations

from math import inf
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.report.accuracy.accuracy_findings import summarise_findings
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.winner_map import NO_WINNER, WinnerCell, build_winner_cells, method_family
from springbench.harness.report.charts.figure_panels import CellMap, CurvePlot
from springbench.harness.report.charts.winner_chart import build_winner_chart
from springbench.harness.report.figures.figure_kinds import FIGURE_KINDS
from springbench.harness.report.site.accuracy_charts import build_page_charts

from tests import synthetic_accuracy_rows as made
from tests import synthetic_results


def row(solver: str, integrator: str, error: float, cpu: float, **other: Any) -> dict[str, Any]:
    """A simulation of half a second of a mesh of 81 vertices, k/m = 900 /s^2."""
    values = {
        "integrator": integrator,
        "error": error,
        "cpu_seconds": cpu,
        "seconds_per_simulated_second": 9.9,
        "seconds": [9.9],
    }
    values |= {"t_end": 0.5, "time_step": 0.01, "max_iterations": 50, "stiffness_ratio": 0.09, "vertices": 81}
    return (
        made.build_shared_columns("net", 9, solver=solver, parameters="{}", kind="work")
        | {"is_minimiser": True}
        | values
        | other
    )


ROWS = (
    row("numba", "implicit-euler", 0.05, 0.1),
    row("newton", "midpoint", 2e-3, 0.4),
    row("newton", "midpoint", 2e-5, 4.0),
    row("rodas", "substepping", 5e-4, 0.3, is_minimiser=False, family="linearly implicit"),
    row("newton", "sdirk-4", 1e-9, 0.01, status="uncertified"),
)


@pytest.fixture
def winner_cells(tmp_path: Path) -> dict[float, WinnerCell]:
    return {
        cell.error: cell
        for cell in build_winner_cells(read_accuracy(made.write_accuracy_rows(tmp_path, ROWS)).work_points)
    }


def test_the_cheapest_by_processor_time_within_the_error_wins(winner_cells):
    assert [winner_cells[10.0**-k].cheapest_family for k in range(1, 6)] == [
        "implicit, order 1",
        "linearly implicit",
        "linearly implicit",
        "implicit, order 2",
        NO_WINNER,
    ]
    assert winner_cells[0.1].cheapest_by_family["implicit, order 2"].cpu_seconds_per_simulated_second == 0.8, (
        "seconds a simulated second, the cheaper of the two"
    )


def test_the_map_has_a_winner_for_each_error_that_is_reached(tmp_path: Path):
    (drawn,) = build_winner_chart(read_accuracy(made.write_accuracy_rows(tmp_path, ROWS))).maps
    order = ("implicit, order 1", "linearly implicit", "linearly implicit", "implicit, order 2")
    won = [(cell.row, cell.outcome) for cell in drawn.cells if cell.outcome != NO_WINNER]
    assert won == [(f"1e-{k}", name) for k, name in enumerate(order, 1)]
    assert drawn.title == "81 vertices"
    assert "numba" in drawn.cells[0].reason
    assert drawn.cells[0].reason.endswith("next: linearly implicit, 3 times as much")
    assert not build_winner_chart(read_accuracy(made.write_accuracy_rows(tmp_path / "one", ROWS[:1]))).maps, (
        "one family alone wins nothing"
    )


def test_a_cell_states_the_lead_of_its_winner(winner_cells):
    assert winner_cells[0.1].lead_ratio == pytest.approx(3.0)
    assert winner_cells[1e-4].lead_ratio == inf
    assert not winner_cells[1e-8].cheapest_by_family, "what no reference certifies wins nothing"


def test_the_stiffness_number_is_that_of_a_frame_whatever_the_step(winner_cells):
    assert winner_cells[0.1].stiffness_number == pytest.approx(1.0)


def test_an_integrator_from_outside_is_a_family_by_its_name(tmp_path):
    (work,) = read_accuracy(made.write_accuracy_rows(tmp_path, [row("newton", "mine:METHOD", 0.1, 1.0)])).work_points
    assert method_family(work) == "mine:METHOD"


def test_each_number_of_vertices_is_a_grid_of_errors_by_stiffness(tmp_path):
    panels = build_winner_chart(read_accuracy(synthetic_results.write_winner_results(tmp_path))).maps
    assert [panel.title for panel in panels] == ["81 vertices", "289 vertices", "1\u2009089 vertices"]
    assert {len({cell.column for cell in panel.cells}) for panel in panels} == {5}
    assert {len({cell.row for cell in panel.cells}) for panel in panels} == {8}


@pytest.mark.parametrize("truth", ["integrated", "self-converged"])
def test_errors_by_a_self_converged_motion_are_marked_wherever_they_are_shown(tmp_path, truth):
    folder = made.write_accuracy_rows(tmp_path, [one | {"reference_kind": truth} for one in ROWS])
    table = read_accuracy(folder)
    panels = [
        panel
        for kind in ("work", "winners")
        for entry in FIGURE_KINDS[kind].list_panels(folder, lambda _: ())
        if isinstance(panel := entry.build_panel(), CurvePlot | CellMap)
    ]
    shown = [" ".join(panel.notes) for panel in panels]
    on_page = build_page_charts(table, folder)
    shown += [" ".join(frame["notes"]) for frame in on_page["work"]["frames"]] + [on_page["winners"]["note"]]
    shown += [" ".join(summarise_findings(table)["Work and precision"])]
    assert {"by a self-converged reference, for there is contact: net 9." in text for text in shown} == {
        truth == "self-converged"
    }
    assert len(shown) > 4
