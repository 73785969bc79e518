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

from harness.base import machine
from harness.report.ablation import Row, known_error, of_kind
from harness.report.origin import machine_and_commit
from harness.report.page import axes, header, new_page, quantity, save, text, ticks
from harness.report.style import INK, MUTED, PAGE, RC, RULE, WARNING, numbered

_ERRORS = {"solver": "error of the solver", "time-step": "error of the time step"}
_NOTHING = 1e-6
"""Displacements below this value [mean rest lengths] are drawn at it."""
_APART = 18
"""Vertical distance between two names [pixels]."""


def draw_ablation(rows: Sequence[Row], path: Path) -> None:
    """Draw the plot of an ablation as a PNG file.

    Args:
        rows: all rows of the ablation.
        path: target file.
    """
    (whole,) = of_kind(rows, "whole")
    points = [row for row in of_kind(rows, "without") if row["status"] == "ok"]
    with matplotlib.rc_context(RC):
        page = new_page()
        facts = [
            f"{whole['solver']}, {quantity(1e3 * whole['seconds'])} CPU ms a step",
            f"{whole['vertices']} vertices",
            f"{whole['frames']} steps of {quantity(1e3 * whole['time_step'])} ms, {whole['rounds']} rounds",
        ]
        header(page, f"{whole['scene']}: what its effects cost and change", facts)
        ax = axes(page, 130, 138, 1380, 630)
        _errors(ax, rows, points)
        older = whole["code"] not in (None, machine.code_hash())
        _effects(ax, points, whole["seconds"], hollow=older)
        gone = [row["name"] for row in of_kind(rows, "without") if row["status"] != "ok"]
        called = [row["name"] for row in of_kind(rows, "suggestion")]
        below = [f"impossible without {', '.join(gone)}"] if gone else []
        below += ["hollow: measured by other code than today's"] if older else []
        below += machine_and_commit([whole])
        below += [f"not listed, but called for by the motion: {', '.join(called)}"] if called else []
        text(page, 130, 866, "   ·   ".join(below), size=10.5, color=WARNING if called else MUTED)
        save(page, path)


def _errors(ax: Axes, rows: Sequence[Row], points: Sequence[Row]) -> None:
    """Draw the error lines and shade the region below both errors.

    The limits of the y-axis contain all errors and points.
    """
    known = [row for row in of_kind(rows, "error") if row["status"] == "ok"]
    values = [max(row["largest"], _NOTHING) for row in (*known, *points)]
    low, high = min(values, default=1e-3) / 4.0, max(values, default=1.0) * 4.0
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    ax.yaxis.set_major_formatter(ticks("{:g}".format))
    words: Any = {"loc": "left", "fontsize": 12, "color": INK}
    ax.set_title("largest displacement where it is left out [mean rest lengths]", pad=12, **words)
    ax.set_xlabel("cost [% of a step, with the 95 % interval]", labelpad=8, **words)
    ax.tick_params(labelsize=12, length=4)
    ax.grid(axis="y", which="major")
    error, _ = known_error(rows)
    if np.isfinite(error):
        ax.axhspan(low, max(error, low), color=RULE, alpha=0.45, linewidth=0)
    for row in known:
        y = max(row["largest"], _NOTHING)
        ax.axhline(y, color=MUTED, linewidth=1.0, linestyle=(0, (5, 3)))
        place: Any = {"xycoords": ("axes fraction", "data"), "xytext": (-4, 3), "textcoords": "offset points"}
        ax.annotate(_ERRORS[row["name"]], (1.0, y), ha="right", fontsize=11.5, color=MUTED, **place)


def _effects(ax: Axes, points: Sequence[Row], whole: float, *, hollow: bool) -> None:
    """Draw one point per effect with its interval and its name.

    Names that would overlap are moved apart. `whole` is the time of a step with all effects [s]; markers are hollow
    if `hollow`, that is, if other code than the current version measured them.
    """
    taken: list[tuple[float, float]] = []
    face: Any = {"mfc": PAGE, "mew": 1.8} if hollow else {}
    for i, row in enumerate(sorted(points, key=lambda row: -row["largest"])):
        look, y = numbered(i), max(row["largest"], _NOTHING)
        x, low, high = (100.0 * row[key] / whole for key in ("cost", "cost_low", "cost_high"))
        ax.plot([low, high], [y, y], color=look.color, linewidth=1.6, alpha=0.6, solid_capstyle="butt")
        ax.plot([x], [y], marker=look.marker, color=look.color, markersize=9, linestyle="none", **face)
        taken.append((x, y))
    ax.axvline(0.0, color=MUTED, linewidth=0.8)
    ax.margins(x=0.12)
    ax.figure.canvas.draw()
    used: list[tuple[float, float]] = []
    for (x, y), row in zip(taken, sorted(points, key=lambda row: -row["largest"]), strict=True):
        across, up = ax.transData.transform((x, y))
        lift = 9.0
        while any(abs(across - a) < 150 and abs(up + lift - b) < _APART for a, b in used):
            lift += _APART
        used.append((across, up + lift))
        ax.annotate(row["name"], (x, y), (9, lift * 0.72), textcoords="offset points", fontsize=12, color=INK)
