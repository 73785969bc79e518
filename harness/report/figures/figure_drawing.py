# pyright: reportUnknownMemberType=false
"""Drawing of a figure from its panels: composition, checks of the layout, and output."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.charts.figure_panels import FigurePanel
from springbench.harness.report.figures import figure_files
from springbench.harness.report.figures.axis_scales import measure_overlap
from springbench.harness.report.figures.figure_layout import compose_figure, visible_texts
from springbench.harness.report.figures.figure_options import MIN_FONT_SIZE, FigureOptions

_MAX_LISTED = 3
"""Maximum number of faults that a message lists."""
_OVERLAP_SLACK = 0.75
"""Allowed overlap of text boxes [points], because they are larger than the ink."""


def draw_figure(
    panels: Sequence[FigurePanel], stem: Path, title: str, options: FigureOptions
) -> tuple[list[Path], tuple[float, float]]:
    """Draw a figure, and return its files and its width and height [mm].

    Args:
        panels: panels, all of one type.
        stem: path of the files without suffix.
        title: title of the figure.
        options: options of the figure.

    Raises:
        InputError: if the text does not fit the width.
        WriteError: if a file cannot be written.
    """
    figure = compose_figure(panels, title, options)
    wrong = find_layout_faults(figure)
    if wrong:
        more = f" and {len(wrong) - _MAX_LISTED} more" if len(wrong) > _MAX_LISTED else ""
        why = (
            f"got {options.width_mm:g} mm for type of {options.font_size:g} points, in "
            f"which {'; '.join(wrong[:_MAX_LISTED])}{more}"
        )
        raise InputError(InputMistake(f"{why}; expected a wider figure, smaller type or fewer panels", key="--width"))
    return figure_files.write_figure(figure, panels, stem, title, options), figure_files.figure_size_mm(figure)


def preload_figures() -> None:
    """Import what draws and writes figures."""
    figure_files.preload_formats()


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
