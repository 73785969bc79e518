"""Chart of the reproduction of Liu et al. 2013 for the results page.

It compares own errors with those of figures 2 and 3.
"""

from __future__ import annotations

from typing import Any

from harness.report.accuracy.measured import Measurements, by_other_code
from harness.report.accuracy.paper import comparisons, own
from harness.report.site.marks import axis, drawn
from harness.report.site.script import numbers
from harness.report.style import DASHED, MUTED, Mark

_MARKS = {"ours": Mark("#0072b2", "o"), "Liu et al. 2013": Mark(MUTED, "D", DASHED)}
_NOTE = "Relative error (g − g*)/(g0 − g*) after iterations of local-global: ours, and as the paper's figures show it."


def chart(table: Measurements) -> dict[str, Any]:
    """Build the chart; it has no items if no row belongs to the reproduction."""
    found = comparisons(table)
    items = [
        {
            "label": label,
            "what": curve,
            "curve": curve,
            "parameters": "{}",
            "iterations": [one.iterations for one in mine],
            "error": numbers(getattr(one, side) for one in mine),
            "ratio": numbers(one.ratio for one in mine),
            "frames": [one.frames for one in mine],
        }
        for curve in dict.fromkeys(one.curve for one in found)
        for mine in [[one for one in found if one.curve == curve]]
        for label, side in zip(_MARKS, ("ours", "theirs"), strict=True)
    ]
    return {
        "title": "The paper reproduced",
        "note": " ".join([_NOTE, *by_other_code(own(table), table.newest)]),
        "filters": ["curve"],
        "x": [axis("iterations", "iterations")],
        "y": [axis("error", "relative error")],
        "hover": [
            *(["iterations", "iterations"], ["error", "relative error"]),
            *(["ratio", "ours over theirs"], ["frames", "our frames"]),
        ],
        "marks": {name: drawn(mark) for name, mark in _MARKS.items()},
        "items": items,
    }
