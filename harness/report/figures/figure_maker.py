# pyright: reportUnknownMemberType=false
"""Production of a figure: selection of its panels, composition, checks and output."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.figures import figure_files, panel_selection
from springbench.harness.report.figures.axis_scales import measure_overlap
from springbench.harness.report.figures.figure_kinds import FigureKind, StaleFinder
from springbench.harness.report.figures.figure_layout import compose_figure, visible_texts
from springbench.harness.report.figures.figure_options import MIN_FONT_SIZE, FigureOptions

_MAX_LISTED = 3
"""Maximum number of faults that a message lists."""
_OVERLAP_SLACK = 0.75
"""Allowed overlap of text boxes [points], because they are larger than the ink."""


class FigureResult(NamedTuple):
    """A figure that was written.

    Attributes:
        paths: files.
        panel_names: names of its panels.
        size_mm: width and height [mm].
        other_panel_count: number of further panels in the results.
        other_panel_example: name of one of them.
    """

    paths: list[Path]
    panel_names: list[str]
    size_mm: tuple[float, float]
    other_panel_count: int
    other_panel_example: str


def make_figure(
    name: str, kind: FigureKind, results: Path, find_stale: StaleFinder, folder: Path, options: FigureOptions
) -> FigureResult:
    """Write the figure of a kind to files.

    Args:
        name: name of the kind.
        kind: kind of figure.
        results: folder of the results.
        find_stale: returns the ids of the runs in a table that other code made.
        folder: folder that the files are written to.
        options: options of the figure.

    Raises:
        InputError: if the results contain nothing of the kind, if no panel matches a selector, if curves and maps are
            selected together, or if the text does not fit the width.
    """
    entries = kind.list_panels(results, find_stale)
    if not entries:
        raise InputError(InputMistake(f"contains nothing to draw as {name}; expected {kind.required_rows}", results))
    usual = [one for one in kind.default_panels if any(set(one) <= set(known.name_parts) for known in entries)]
    picked = panel_selection.select_entries(entries, options.selectors or usual)
    panels = kind.prepare_panels(picked)
    if len({type(panel) for panel in panels}) > 1:
        parts = ", ".join(":".join(one.name_parts) for one in picked)
        why = f"got {parts}, of which some are curves and some are maps; expected one of both: their data differ"
        raise InputError(InputMistake(f"{why}; draw the others as a figure of their own", key="--panels"))
    figure = compose_figure(panels, kind.title, options)
    wrong = find_layout_faults(figure)
    if wrong:
        more = f" and {len(wrong) - _MAX_LISTED} more" if len(wrong) > _MAX_LISTED else ""
        why = (
            f"got {options.width_mm:g} mm for type of {options.font_size:g} points, in "
            f"which {'; '.join(wrong[:_MAX_LISTED])}{more}"
        )
        raise InputError(InputMistake(f"{why}; expected a wider figure, smaller type or fewer panels", key="--width"))
    parts = [part for selector in options.selectors for part in selector]
    stem = folder / "-".join(dict.fromkeys([name, *parts]))
    paths = figure_files.write_figure(figure, panels, stem, kind.title, options)
    rest = [one for one in entries if one not in picked]
    example = ":".join(rest[0].name_parts) if rest else ""
    shown = [":".join(one.name_parts) for one in picked]
    return FigureResult(paths, shown, figure_files.figure_size_mm(figure), len(rest), example)


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
