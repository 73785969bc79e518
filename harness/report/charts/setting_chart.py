"""Chart of the convergence of settings: a map of the error over substeps and iterations."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from math import isfinite
from textwrap import wrap

from springbench.harness.report.charts.chart_description import ChartDescription
from springbench.harness.report.charts.figure_panels import CellMap, CellOutcome, MapCell
from springbench.harness.results.setting_verdict import ERROR_LEVELS, ConvergenceStudy, SettingResult, StepSetting

_ERROR_BOUNDS = (1e-4, 1e-3, 3e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.3, 1.0, 10.0)
"""Bounds of the classes: relative errors, with the levels of the verdict among them."""
_ERROR_COLOURS = (
    *("#4575b4", "#74add1", "#9ecae1", "#c6e3ef", "#e6f5f9", "#fffbd0"),
    *("#fee9a0", "#fdcb7d", "#f79a5f", "#e36a4d", "#c8402f"),
)
_UNKNOWN = CellOutcome("no error", "#ececea")
_REASON_LETTERS = 16
"""Maximum number of characters in a line of a reason."""


def build_setting_chart(study: ConvergenceStudy, title: str, facts: Sequence[str]) -> ChartDescription:
    """Build the map of a study's errors.

    The given settings, and the cheapest one within each error, are marked.

    Args:
        study: settings with their errors.
        title: title of the chart.
        facts: phrases about the study.
    """
    marks = _list_marks(study)
    results = sorted(study.results, key=lambda result: (result.setting.iterations, result.setting.substeps))
    drawn = CellMap(
        group=("settings",),
        name=("map",),
        subject="",
        title="In each cell: error, and processor time of a frame",
        cells=[_build_cell(result, marks.get(result.setting, ()), study) for result in results],
        outcomes=[*_list_classes(), _UNKNOWN],
        notes=["; ".join(facts) + ".", *study.describe_verdict()],
        row_label="iterations of a substep" if any(result.setting.iterations for result in results) else "",
        column_label="substeps of a frame",
    )
    return ChartDescription(title=title, note="", maps=[drawn])


def _list_marks(study: ConvergenceStudy) -> dict[StepSetting, list[str]]:
    """Return the marks of the given settings, and of the cheapest one within each error."""
    marks: dict[StepSetting, list[str]] = {setting: ["given"] for setting in study.given_settings}
    for level in sorted({*ERROR_LEVELS, study.error_requested}):
        if best := study.find_cheapest(level):
            marks.setdefault(best.setting, []).append(f"cheapest to {100 * level:.3g} %")
    return marks


def _build_cell(result: SettingResult, marks: Sequence[str], study: ConvergenceStudy) -> MapCell:
    is_known = isfinite(result.error)
    outcome = _list_classes()[bisect_right(_ERROR_BOUNDS, result.error)] if is_known else _UNKNOWN
    lines = [_format_error(result.error)] if is_known else _shorten_reason(result.reason)
    lines += [f"{1e3 * result.frame_seconds:.3g} ms"] if isfinite(result.frame_seconds) else []
    return MapCell(
        row=str(result.setting.iterations or ""),  # a method without iterations has one row
        column=str(result.setting.substeps),
        outcome=outcome.label,
        color=outcome.color,
        value_text="\n".join([*lines, *marks]),
        reason=result.reason,
        is_framed=result.setting in study.given_settings,
    )


def _list_classes() -> list[CellOutcome]:
    percents = [f"{100 * bound:g}" for bound in _ERROR_BOUNDS]
    between = [f"{low} to {high} %" for low, high in pairwise(percents)]
    labels = [f"below {percents[0]} %", *between, f"above {percents[-1]} %"]
    return [CellOutcome(label, color) for label, color in zip(labels, _ERROR_COLOURS, strict=True)]


def _format_error(error: float) -> str:
    return f"{100 * error:.2g} %" if error < 0.995 else f"{100 * error:.0f} %"


def _shorten_reason(reason: str) -> list[str]:
    return wrap(reason.split(":")[0] or "the finest", _REASON_LETTERS, max_lines=2, placeholder="…")
