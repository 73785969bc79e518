# pyright: reportUnknownMemberType=false
"""Checks of a figure for text that is too small, cut off, or overlapping."""

from __future__ import annotations

from itertools import combinations

from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from springbench.harness.report.figures.axis_scales import measure_overlap
from springbench.harness.report.figures.figure_layout import visible_texts
from springbench.harness.report.figures.figure_options import MIN_FONT_SIZE

_OVERLAP_SLACK = 0.75
"""Allowed overlap of text boxes [points], because they are larger than the ink."""


def find_layout_faults(figure: Figure) -> list[str]:
    """Find all layout faults and describe them; empty if the figure is correct."""
    slack = _OVERLAP_SLACK * figure.dpi / 72.0
    seen = visible_texts(figure)
    small = [(text.get_text(), float(text.get_fontsize())) for text in seen]
    found = [f"{words!r} is of {size:.1f} points" for words, size in small if size < MIN_FONT_SIZE]
    # The method of Text itself: that of annotations includes their arrows.
    boxes = [(text.get_text(), Text.get_window_extent(text)) for text in seen]
    page = figure.bbox
    for words, box in boxes:
        out = max(page.x0 - box.x0, box.x1 - page.x1, page.y0 - box.y0, box.y1 - page.y1)
        if out > slack:
            found.append(f"{words!r} is cut")
    met = (f"{a!r} meets {b!r}" for (a, one), (b, other) in combinations(boxes, 2) if _boxes_overlap(one, other, slack))
    found += met
    for legend in figure.legends:
        over = legend.get_window_extent()
        found += ["the legend lies over data" for ax in figure.axes if _boxes_overlap(over, ax.bbox, slack)]
    return found


def _boxes_overlap(one: Bbox, other: Bbox, slack: float) -> bool:
    return min(measure_overlap(one, other)) > slack
