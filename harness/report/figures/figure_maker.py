"""Production of a figure: selection of its panels, composition, checks and output."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.figures import figure_files, panel_selection
from springbench.harness.report.figures.figure_kinds import FigureKind
from springbench.harness.report.figures.figure_layout import compose_figure
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.figures.layout_checks import find_layout_faults
from springbench.harness.report.figures.timing_panels import StaleFinder

_MAX_LISTED = 3
"""Maximum number of faults that a message lists."""


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
