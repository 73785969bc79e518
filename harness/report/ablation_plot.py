# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Plot of an ablation: cost of effects against the displacement without them.

The x-axis shows the cost of each effect, the y-axis the largest displacement without it. Effects below the error lines
change less than the error that the scene has in any case.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from springbench.harness.execution import machine_info
from springbench.harness.report.ablation_summary import ResultRow, largest_known_error, select_kind
from springbench.harness.report.number_format import format_quantity
from springbench.harness.report.page_layout import add_axes, draw_header, draw_text, new_page, save_page, tick_formatter
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    MUTED_COLOUR,
    PAGE_RC,
    RULE_COLOUR,
    TEXT_COLOUR,
    WARNING_COLOUR,
    indexed_style,
)
from springbench.harness.report.provenance_words import describe_machine_and_commit

_ERROR_LABELS = {"solver": "error of the solver", "time-step": "error of the time step"}
_MIN_DISPLACEMENT = 1e-6
"""Displacements below this value [mean rest lengths] are drawn at it."""
_LABEL_GAP = 18
"""Vertical distance between two names [pixels]."""


def draw_ablation_plot(rows: Sequence[ResultRow], path: Path) -> None:
    """Draw the plot of an ablation as a PNG file.

    Args:
        rows: all rows of the ablation.
        path: target file.
    """
    (whole,) = select_kind(rows, "full-scene")
    points = [row for row in select_kind(rows, "ablated") if row["status"] == "ok"]
    with matplotlib.rc_context(PAGE_RC):
        page = new_page()
        facts = [
            f"{whole['solver']}, {format_quantity(1e3 * whole['seconds'])} CPU ms a step",
            f"{whole['vertices']} vertices",
            f"{whole['frames']} steps of {format_quantity(1e3 * whole['time_step'])} ms, {whole['rounds']} rounds",
        ]
        draw_header(page, f"{whole['scene']}: what its effects cost and change", facts)
        ax = add_axes(page, 130, 138, 1380, 630)
        _draw_error_lines(ax, rows, points)
        older = whole["source_fingerprint"] not in (None, machine_info.hash_sources())
        _draw_effects(ax, points, whole["seconds"], is_stale=older)
        gone = [row["name"] for row in select_kind(rows, "ablated") if row["status"] != "ok"]
        called = [row["name"] for row in select_kind(rows, "suggestion")]
        below = [f"impossible without {', '.join(gone)}"] if gone else []
        below += ["hollow: measured by other code than today's"] if older else []
        below += describe_machine_and_commit([whole])
        below += [f"not listed, but called for by the motion: {', '.join(called)}"] if called else []
        draw_text(page, 130, 866, "   ·   ".join(below), size=10.5, color=WARNING_COLOUR if called else MUTED_COLOUR)
        save_page(page, path)


def _draw_error_lines(ax: Axes, rows: Sequence[ResultRow], points: Sequence[ResultRow]) -> None:
    """Draw the error lines and shade the region below both errors.

    The limits of the y-axis contain all errors and points.
    """
    known = [row for row in select_kind(rows, "error") if row["status"] == "ok"]
    values = [max(row["displacement_max"], _MIN_DISPLACEMENT) for row in (*known, *points)]
    low, high = min(values, default=1e-3) / 4.0, max(values, default=1.0) * 4.0
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    ax.yaxis.set_major_formatter(tick_formatter("{:g}".format))
    words: Any = {"loc": "left", "fontsize": 12, "color": TEXT_COLOUR}
    ax.set_title("largest displacement where it is left out [mean rest lengths]", pad=12, **words)
    ax.set_xlabel("cost [% of a step, with the 95 % interval]", labelpad=8, **words)
    ax.tick_params(labelsize=12, length=4)
    ax.grid(axis="y", which="major")
    error, _ = largest_known_error(rows)
    if np.isfinite(error):
        ax.axhspan(low, max(error, low), color=RULE_COLOUR, alpha=0.45, linewidth=0)
    for row in known:
        y = max(row["displacement_max"], _MIN_DISPLACEMENT)
        ax.axhline(y, color=MUTED_COLOUR, linewidth=1.0, linestyle=(0, (5, 3)))
        place: Any = {"xycoords": ("axes fraction", "data"), "xytext": (-4, 3), "textcoords": "offset points"}
        ax.annotate(_ERROR_LABELS[row["name"]], (1.0, y), ha="right", fontsize=11.5, color=MUTED_COLOUR, **place)


def _draw_effects(ax: Axes, points: Sequence[ResultRow], full_run: float, *, is_stale: bool) -> None:
    """Draw one point per effect with its interval and its name.

    Names that would overlap are moved apart. `full_run` is the time of a step with all effects [s]; markers are hollow
    if `is_stale`, that is, if other code than the current version measured them.
    """
    taken: list[tuple[float, float]] = []
    face: Any = {"mfc": BACKGROUND_COLOUR, "mew": 1.8} if is_stale else {}
    for i, row in enumerate(sorted(points, key=lambda row: -row["displacement_max"])):
        look, y = indexed_style(i), max(row["displacement_max"], _MIN_DISPLACEMENT)
        x, low, high = (
            100.0 * row[key] / full_run for key in ("added_seconds", "added_seconds_low", "added_seconds_high")
        )
        ax.plot([low, high], [y, y], color=look.color, linewidth=1.6, alpha=0.6, solid_capstyle="butt")
        ax.plot([x], [y], marker=look.marker, color=look.color, markersize=9, linestyle="none", **face)
        taken.append((x, y))
    ax.axvline(0.0, color=MUTED_COLOUR, linewidth=0.8)
    ax.margins(x=0.12)
    ax.figure.canvas.draw()
    used: list[tuple[float, float]] = []
    for (x, y), row in zip(taken, sorted(points, key=lambda row: -row["displacement_max"]), strict=True):
        across, up = ax.transData.transform((x, y))
        lift = 9.0
        while any(abs(across - a) < 150 and abs(up + lift - b) < _LABEL_GAP for a, b in used):
            lift += _LABEL_GAP
        used.append((across, up + lift))
        ax.annotate(row["name"], (x, y), (9, lift * 0.72), textcoords="offset points", fontsize=12, color=TEXT_COLOUR)
