"""Chart of the reproduction of Liu et al. 2013 for the results page.

It compares own errors with those of figures 2 and 3.
"""

from __future__ import annotations

from typing import Any

from harness.report.accuracy.measured import AccuracyData, describe_stale_results
from harness.report.accuracy.paper import compare_with_paper, select_own_curves
from harness.report.site.marks import axis_choice, plotly_style
from harness.report.site.script import round_numbers
from harness.report.style import DASHED_LINE, MUTED_COLOUR, SeriesStyle

_SERIES_STYLES = {"ours": SeriesStyle("#0072b2", "o"), "Liu et al. 2013": SeriesStyle(MUTED_COLOUR, "D", DASHED_LINE)}
_CHART_NOTE = (
    "Relative error (g − g*)/(g0 − g*) after iterations of local-global: ours, and as the paper's figures show it."
)


def build_liu2013_chart(table: AccuracyData) -> dict[str, Any]:
    """Build the chart; it has no items if no row belongs to the reproduction."""
    found = compare_with_paper(table)
    items = [
        {
            "label": label,
            "what": curve,
            "curve": curve,
            "parameters": "{}",
            "iterations": [one.iterations for one in mine],
            "error": round_numbers(getattr(one, side) for one in mine),
            "ratio": round_numbers(one.error_ratio for one in mine),
            "frames": [one.frames for one in mine],
        }
        for curve in dict.fromkeys(one.curve for one in found)
        for mine in [[one for one in found if one.curve == curve]]
        for label, side in zip(_SERIES_STYLES, ("ours", "theirs"), strict=True)
    ]
    return {
        "title": "The paper reproduced",
        "note": " ".join([_CHART_NOTE, *describe_stale_results(select_own_curves(table), table.newest_fingerprint)]),
        "filters": ["curve"],
        "x": [axis_choice("iterations", "iterations")],
        "y": [axis_choice("error", "relative error")],
        "hover": [
            *(["iterations", "iterations"], ["error", "relative error"]),
            *(["ratio", "ours over theirs"], ["frames", "our frames"]),
        ],
        "marks": {name: plotly_style(mark) for name, mark in _SERIES_STYLES.items()},
        "items": items,
    }
