"""Production of a figure: selection of its panels, and drawing, in another process if possible."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.early_worker import run_in_early_worker
from springbench.harness.execution.progress_events import ignore_progress
from springbench.harness.report.charts.figure_panels import FigurePanel, MeshPicture
from springbench.harness.report.figures import panel_selection
from springbench.harness.report.figures.figure_kinds import FIGURE_KINDS, FigureKind, StaleFinder
from springbench.harness.report.figures.figure_options import FigureOptions

if TYPE_CHECKING:
    from springbench.harness.execution.worker_process import ProgressCallback


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
    parts = [part for selector in options.selectors for part in selector]
    stem = folder / "-".join(dict.fromkeys([name, *parts]))
    draw = partial(_draw_figure, panels, stem, kind.title, options)
    is_plain = name in FIGURE_KINDS and not any(isinstance(panel, MeshPicture) for panel in panels)
    paths, size_mm = run_in_early_worker(draw, ignore_progress) if is_plain else draw(ignore_progress)
    rest = [one for one in entries if one not in picked]
    example = ":".join(rest[0].name_parts) if rest else ""
    shown = [":".join(one.name_parts) for one in picked]
    return FigureResult(paths, shown, size_mm, len(rest), example)


def _draw_figure(
    panels: Sequence[FigurePanel], stem: Path, title: str, options: FigureOptions, tick: ProgressCallback
) -> tuple[list[Path], tuple[float, float]]:
    from springbench.harness.report.figures.figure_drawing import draw_figure  # with Matplotlib

    return draw_figure(panels, stem, title, options)
