# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Heat map of the convergence of settings: error over substeps and iterations, with iso-error lines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from springbench.harness.report.accuracy.plot_sheet import (
    PANEL_BOTTOM,
    PANEL_LEFT,
    PANEL_TOP,
    add_panel,
    plot_sheet,
    sheet_paths,
)
from springbench.harness.report.page_layout import draw_text, tick_formatter
from springbench.harness.report.plot_style import MUTED_COLOUR, PAGE_HEIGHT, PAGE_WIDTH, TEXT_COLOUR
from springbench.harness.results.setting_verdict import ERROR_LEVELS, ConvergenceStudy, StepSetting

_COLOUR_BOUNDS = (1e-4, 1e-3, 3e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.3, 1.0, 10.0)
"""Bounds of the colours: relative errors, with the levels of the verdict among them."""

_UNKNOWN_COLOURS = ListedColormap(["#ffffff00", "#ececea"])
"""Colours of fields with an error, over which theirs are drawn, and of fields without."""

_MAP_WIDTH, _TEXT_LEFT, _TEXT_LETTERS = 880, 1010, 72
"""Width of the map, and left edge of the verdict next to it [pixels]; letters of a line of the verdict."""

_LINE_STYLES = ("dotted", "solid", "dashed")
"""Of the iso-error lines, from the smallest error."""


def draw_convergence_map(stem: Path, study: ConvergenceStudy, title: str, facts: Sequence[str]) -> list[Path]:
    """Draw a study's errors, with the given settings and the cheapest ones marked, and return the files.

    Args:
        stem: path of the files without suffix.
        study: settings with their errors.
        title: title of the picture.
        facts: phrases below the title.
    """
    substeps = sorted({result.setting.substeps for result in study.results})
    iterations = sorted({result.setting.iterations for result in study.results})
    by_setting = {result.setting: result for result in study.results}
    errors = np.array([[by_setting[StepSetting(s, i)].error for s in substeps] for i in iterations])
    with plot_sheet(stem, title, facts) as page:
        height = min(PANEL_BOTTOM - PANEL_TOP - 90, 160 * len(iterations))
        heading = "iterations of a substep, upwards" if len(iterations) > 1 else ""
        heading = "; ".join(filter(None, [heading, "in each field the error and the processor time of a frame"]))
        ax = add_panel(page, PANEL_LEFT + 46, PANEL_TOP + 30, _MAP_WIDTH, height, heading)
        ax.grid(visible=False)
        x, y = np.arange(len(substeps)), np.arange(len(iterations))
        norm = BoundaryNorm(_COLOUR_BOUNDS, 256, extend="both")
        shown = np.where(np.isfinite(errors), errors, np.nan)
        edges = [np.arange(count + 1) - 0.5 for count in (len(x), len(y))]  # of fields: a single row has a height, too
        ax.pcolormesh(*edges, np.isnan(shown), cmap=_UNKNOWN_COLOURS, edgecolors="white", lw=2)
        ax.pcolormesh(*edges, shown, cmap="RdYlBu_r", norm=norm, alpha=0.75, edgecolors="white", lw=2)
        lines, labels = list[Line2D](), list[str]()
        if len(x) > 1 and len(y) > 1 and np.isfinite(shown).sum() > 3:
            levels = [one for one in sorted({*ERROR_LEVELS, study.error_requested}) if np.nanmin(shown) <= one]
            logarithms = np.log10(np.maximum(np.ma.masked_invalid(shown), 1e-12))
            styles = [_LINE_STYLES[k % len(_LINE_STYLES)] for k in range(len(levels))]
            look: dict[str, Any] = {"colors": TEXT_COLOUR, "linewidths": 1.8, "alpha": 0.6}
            if levels:
                ax.contour(x, y, logarithms, np.log10(levels), linestyles=styles, **look)
            lines = [Line2D([], [], color=TEXT_COLOUR, ls=style, lw=1.8, alpha=0.6) for style in styles]
            labels = [f"an error of {100 * level:.3g} %" for level in levels]
        for j, many in enumerate(iterations):
            for i, pieces in enumerate(substeps):
                result = by_setting[StepSetting(pieces, many)]
                cost = f"\n{1e3 * result.frame_seconds:.3g} ms" if np.isfinite(result.frame_seconds) else ""
                known = np.isfinite(result.error)
                label = _format_error(result.error) if known else _shorten(result.reason)
                colour = TEXT_COLOUR if known else MUTED_COLOUR
                ax.text(i, j + 0.04, label + cost, ha="center", va="center", fontsize=8.5, color=colour)
        _mark_settings(ax, study, substeps, iterations)
        ax.set_xticks(x, [str(value) for value in substeps])
        ax.set_yticks(y if any(iterations) else [])  # a method without iterations has one row, 0
        ax.yaxis.set_major_formatter(tick_formatter(lambda k: str(iterations[int(k)])))
        ax.set_xlabel("substeps of a frame", fontsize=9, loc="left")
        y_text = PANEL_TOP + 40
        for sentence in study.describe_verdict():
            for line in wrap(sentence.replace(" %", "\u00a0%"), _TEXT_LETTERS):
                draw_text(page, _TEXT_LEFT, y_text, line, size=10.5)
                y_text += 20
            y_text += 10
        if lines:
            place = ((_TEXT_LEFT - 8) / PAGE_WIDTH, 1.0 - y_text / PAGE_HEIGHT)
            page.legend(lines, labels, loc="upper left", bbox_to_anchor=place, frameon=False, fontsize=9.5)
    return sheet_paths(stem)


def _mark_settings(ax: Any, study: ConvergenceStudy, substeps: Sequence[int], iterations: Sequence[int]) -> None:
    """Mark the given settings with a thick frame, and the cheapest one of each level below its field."""
    marks: dict[StepSetting, list[str]] = {setting: ["given"] for setting in study.given_settings}
    for level in ERROR_LEVELS:
        if best := study.find_cheapest(level):
            marks.setdefault(best.setting, []).append(f"cheapest within {100 * level:.3g} %")
    for setting, names in marks.items():
        i, j = substeps.index(setting.substeps), iterations.index(setting.iterations)
        is_given = setting in study.given_settings
        frame: dict[str, Any] = {"fill": False, "ec": TEXT_COLOUR if is_given else MUTED_COLOUR, "zorder": 5}
        ax.add_patch(_rectangle(i, j, 2.6 if is_given else 1.4, frame))
        ax.text(i, j - 0.43, "\n".join(names), ha="center", va="bottom", fontsize=8, color=TEXT_COLOUR, weight="bold")


def _rectangle(i: int, j: int, line_width: float, style: dict[str, Any]) -> Any:
    return Rectangle((i - 0.47, j - 0.47), 0.94, 0.94, lw=line_width, **style)


def _format_error(error: float) -> str:
    return f"{100 * error:.2g} %" if error < 0.995 else f"{100 * error:.0f} %"


def _shorten(reason: str) -> str:
    """Shorten a reason to two lines of a field."""
    words = reason.split(":")[0] or "the finest"
    return "\n".join(wrap(words, 16, max_lines=2, placeholder="…"))
