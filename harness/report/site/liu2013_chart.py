"""Chart of the reproduction of Liu et al. 2013 for the results page.

It compares own errors with those of figures 2 and 3.
"""

from __future__ import annotations

from typing import Any

from springbench.harness.report.accuracy.accuracy_data import AccuracyData, describe_stale_results
from springbench.harness.report.accuracy.liu2013_comparison import compare_with_paper, select_own_curves
from springbench.harness.report.plot_style import DASHED_LINE, MUTED_COLOUR, SeriesStyle
from springbench.harness.report.site.data_scripts import round_numbers
from springbench.harness.report.site.plotly_styles import axis_choice, plotly_style

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
            "description": curve,
            "curve": curve,
            "parameters": "{}",
            "iterations": [one.iterations for one in mine],
            "error": round_numbers(getattr(one, side) for one in mine),
            "ratio": round_numbers(one.error_ratio for one in mine),
            "frames": [one.frames for one in mine],
        }
        for curve in dict.fromkeys(one.curve for one in found)
        for mine in [[one for one in found if one.curve == curve]]
        for label, side in zip(_SERIES_STYLES, ("own_error", "published_error"), strict=True)
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
        "styles": {name: plotly_style(mark) for name, mark in _SERIES_STYLES.items()},
        "items": items,
    }
