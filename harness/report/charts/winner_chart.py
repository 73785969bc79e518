"""Chart of the cheapest family of methods by stiffness number and error."""

from __future__ import annotations

from springbench.harness.report.accuracy.accuracy_data import AccuracyData, describe_self_converged
from springbench.harness.report.accuracy.time_to_accuracy import format_gap
from springbench.harness.report.accuracy.winner_map import (
    NO_WINNER,
    WinnerCell,
    assign_family_styles,
    build_winner_cells,
)
from springbench.harness.report.charts.accuracy_charts import ACCURACY_COMMAND
from springbench.harness.report.charts.chart_description import ChartDescription
from springbench.harness.report.charts.figure_panels import CellMap, CellOutcome, MapCell
from springbench.harness.report.number_format import format_count, format_quantity
from springbench.harness.report.provenance_words import is_stale

_WINNER_NOTE = (
    "Columns: k dt²/m at dt = 1/30 s; rows: error of the positions at the end, relative to the distance "
    "from the start. Figures: how many times as much processor time the next family takes; · where it reaches no such "
    "error."
)
_STALE_NOTE = "Dot: measured by other code than the others."
_NO_WINNER_COLOUR = "#e9e7e2"


def build_winner_chart(table: AccuracyData, newest_fingerprint: str | None = None) -> ChartDescription:
    """Build the chart, with a map for each number of vertices.

    It has no map if only one family was measured.

    Args:
        table: data of an accuracy measurement.
        newest_fingerprint: code that measurements are compared with; None for that of the newest rows.
    """
    newest = newest_fingerprint or table.newest_fingerprint
    found = build_winner_cells(table.work_points)
    styles = assign_family_styles(found)
    colors = {name: style.color for name, style in styles.items()} | {NO_WINNER: _NO_WINNER_COLOUR}
    is_mixed = any(
        is_stale(work.source_fingerprint, newest) for cell in found for work in cell.cheapest_by_family.values()
    )
    notes = [_WINNER_NOTE, *describe_self_converged(table.work_points)]
    maps = [
        CellMap(
            group=("winners",),
            name=(str(vertices),),
            subject="",
            title=f"{format_count(vertices)} vertices",
            cells=[_build_cell(cell, colors, newest) for cell in found if cell.vertices == vertices],
            outcomes=[CellOutcome(name, color) for name, color in colors.items()],
            notes=[*notes, *([_STALE_NOTE] if is_mixed else [])],
            machine_words=", ".join(table.machine_words),
        )
        for vertices in dict.fromkeys(cell.vertices for cell in found if len(styles) > 1)
    ]
    return ChartDescription(
        title="The cheapest method family for an error",
        note=" ".join(notes),
        maps=maps,
        machine_words=", ".join(table.machine_words),
        command=ACCURACY_COMMAND,
    )


def _build_cell(cell: WinnerCell, colors: dict[str, str], newest: str) -> MapCell:
    family = cell.cheapest_family
    best = cell.cheapest_by_family.get(family)
    return MapCell(
        row=format_gap(cell.error),
        column=format_quantity(cell.stiffness_number),
        outcome=family,
        color=colors[family],
        value_text=_format_lead(cell.lead_ratio) if best else "",
        is_stale=best is not None and is_stale(best.source_fingerprint, newest),
        reason=_describe_cell(cell) if best else "",
    )


def _describe_cell(cell: WinnerCell) -> str:
    """Describe the cheapest simulation and the next family."""
    order = sorted(cell.cheapest_by_family.items(), key=lambda member: member[1].cpu_seconds_per_simulated_second)
    (_, best), *others = order
    cost = format_quantity(best.cpu_seconds_per_simulated_second)
    words = f"{cell.scene}: {best.setting_label}, {cost} processor seconds a simulated second"
    return f"{words}; next: {others[0][0]}, {cell.lead_ratio:.2g} times as much" if others else words


def _format_lead(times: float) -> str:
    return "·" if times == float("inf") else f"{times:.1f}" if times < 9.95 else f"{times:.0f}"
