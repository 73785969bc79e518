"""The map of what effects add to an iteration: all solvers on one page, and what is unknown is left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from springbench.harness.experiments.ablation.ablation_schema import ABLATION_SCHEMA
from springbench.harness.report.ablation_summary import read_ablation
from springbench.harness.report.figures.figure_drawing import find_layout_faults
from springbench.harness.report.figures.figure_layout import MILLIMETRES_PER_INCH, visible_texts
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.solvers.registry import SOLVERS

from tests import synthetic_results as made
from tests.figure_images import compose_kind

PRICES = {"bending": (1.7, 1.6, 1.9), "wind": (1.05, 0.98, 1.1), "gas": (2.4, 2.3, 2.5), "all": (1.2, 1.1, 1.3)}
"""Of each effect, with the interval."""


def write_overheads(folder: Path, solvers: list[str], refused: str, codes: dict[str, str]) -> Path:
    """Each effect's price by each solver; one refuses bending; codes: of solvers of other code."""
    rows: list[dict[str, Any]] = []
    for solver in solvers:
        same = made.SHARED_COLUMNS | {
            "scene": "cloth",
            "size": 33,
            "vertices": 1089,
            "kind": "overhead",
            "solver": solver,
        }
        for name, (price, low, high) in PRICES.items():
            values: dict[str, Any] = {
                "name": name,
                "overhead_ratio": price,
                "overhead_ratio_low": low,
                "overhead_ratio_high": high,
            }
            if (solver, name) == (refused, "bending"):
                values = {"name": name, "status": "unsupported"}
            rows.append(same | values | {"source_fingerprint": codes.get(solver)})
    made.write_result_rows(folder / "ablation" / "cloth.parquet", rows, ABLATION_SCHEMA)
    return folder


def test_the_most_expensive_effect_is_first_all_last_and_a_ratio_within_round_off_of_one_is_no_overhead(
    tmp_path: Path,
) -> None:
    figure, (grid,) = compose_kind(
        "prices", write_overheads(tmp_path, ["numba", "dense"], "dense", {"dense": "before"}), FigureOptions()
    )
    values = {(cell.row, cell.column): (cell.outcome, cell.value_text, cell.is_stale) for cell in grid.cells}
    assert list(dict.fromkeys(cell.row for cell in grid.cells)) == ["gas", "bending", "wind", "all"]
    assert values["gas", "numba"] == ("2 to 3", "2.40", False)
    assert values["wind", "numba"] == ("not distinguishable from 1", "1.05", False)
    assert values["bending", "dense"] == ("unsupported", "–", True)
    said = " ".join(text.get_text() for text in visible_texts(figure))
    assert "Dot: measured by other code than today's." in said
    assert sum(line.get_marker() == "o" for line in figure.axes[0].lines) == 4


def test_results_of_other_code_alone_are_reported_in_words_without_dots(tmp_path: Path) -> None:
    codes: dict[str, str] = {"numba": "before", "dense": "before"}
    figure, _ = compose_kind("prices", write_overheads(tmp_path, list(codes), "", codes), FigureOptions())
    said = " ".join(text.get_text() for text in visible_texts(figure))
    assert "Dot" not in said
    assert "Measured by other code than today's." in said
    assert not figure.axes[0].lines


@pytest.mark.parametrize("width", [85.0, 220.0])
def test_all_solvers_fit_a_page(tmp_path: Path, width: float) -> None:
    figure, (grid,) = compose_kind(
        "prices", write_overheads(tmp_path, list(SOLVERS), "dense", {}), FigureOptions(width_mm=width)
    )
    across, up = figure.get_size_inches() * MILLIMETRES_PER_INCH
    assert up < 1.2 * across
    assert find_layout_faults(figure) == []
    assert {cell.column for cell in grid.cells} == set(SOLVERS)
    assert len(figure.axes[0].texts) == (len(grid.cells) if width > 100 else 0), "figures, where they fit"


def test_a_solver_of_two_settings_has_a_column_for_each(tmp_path: Path) -> None:
    folder = write_overheads(tmp_path, ["newton", "numba"], "", {})
    table = read_ablation(folder / "ablation" / "cloth.parquet")
    graded = [
        row | {"parameters": '{"indefinite_strategy": "shift-schedule"}', "overhead_ratio": 9.0} for row in table[:4]
    ]
    made.write_result_rows(folder / "ablation" / "other.parquet", graded, ABLATION_SCHEMA)
    figure, (grid,) = compose_kind("prices", folder, FigureOptions())
    assert {cell.column for cell in grid.cells} == {"newton", "newton, indefinite_strategy shift-schedule", "numba"}
    assert find_layout_faults(figure) == []
