# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Plot of a recommendation: all measured candidates, the requested error, and the runners-up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from springbench.harness.report.accuracy.plot_sheet import (
    PANEL_LEFT,
    PANEL_RIGHT,
    PANEL_TOP,
    add_panel,
    draw_legend,
    draw_notes,
    format_log_axis,
    log_limits,
    notes_top,
    sheet_marker_style,
    sheet_paths,
)
from springbench.harness.report.accuracy.plot_sheet import marker_scale as sized
from springbench.harness.report.accuracy.plot_sheet import plot_sheet as page_of
from springbench.harness.report.accuracy.time_to_accuracy import format_duration
from springbench.harness.report.number_format import format_quantity
from springbench.harness.report.plot_style import MUTED_COLOUR, RULE_COLOUR, TEXT_COLOUR, assign_solver_styles

MAX_RUNNERS_UP = 4
"""Number of runners-up that are described in words."""

MAX_SHOWN_ERROR = 10.0
"""Relative error above which a candidate is not drawn: its motion is unstable, and would compress all others."""


class CandidatePoint(NamedTuple):
    """A candidate: solver, relative error, wall seconds per simulated second, and its description."""

    solver: str
    error: float
    seconds_per_simulated_second: float
    description: str


def draw_recommendation(
    stem: Path,
    title: str,
    facts: Sequence[str],
    points: Sequence[CandidatePoint],
    error_requested: float | None,
    cost_limit: float | None = None,
) -> list[Path]:
    """Draw the candidates of a recommendation, and return the files.

    The recommended candidate is the cheapest one within the requested error, or the most accurate one within the cost.

    Args:
        stem: path of the files without suffix.
        title: title of the picture.
        facts: phrases below the title.
        points: candidates, the cheapest first.
        error_requested: relative error; None where a cost is given.
        cost_limit: wall seconds per simulated second; None where an error is given.
    """

    def is_within(point: CandidatePoint) -> bool:
        return (error_requested is None or point.error <= error_requested) and (
            cost_limit is None or point.seconds_per_simulated_second <= cost_limit
        )

    shown = [point for point in points if point.error <= MAX_SHOWN_ERROR] or list(points)
    if len(shown) < len(points):
        facts = [*facts, f"{len(points) - len(shown)} unstable settings not shown"]
    points, within = shown, list(filter(is_within, shown))
    if error_requested is None:
        within.sort(key=lambda point: point.error)
    words = [f"recommended: {_describe_candidate(within[0])}"] if within else []
    words += [
        f"{k}. runner-up: {_describe_candidate(point, within[0] if error_requested else None)}"
        for k, point in enumerate(within[1 : MAX_RUNNERS_UP + 1], 1)
    ]
    looks = assign_solver_styles(point.solver for point in points)
    with page_of(stem, title, facts) as page:
        ax = add_panel(
            page,
            PANEL_LEFT + 62,
            PANEL_TOP + 30,
            PANEL_RIGHT - PANEL_LEFT - 82,
            notes_top(words) - PANEL_TOP - 96,
            "error of the positions, relative to the way from the start",
        )
        errors, costs = zip(*((point.error, point.seconds_per_simulated_second) for point in points), strict=True)
        down = log_limits([*errors, *filter(None, [error_requested])], margin=1.8)
        along = log_limits([*costs, *filter(None, [cost_limit])], margin=1.8)
        shade: dict[str, Any] = {"color": RULE_COLOUR, "alpha": 0.45, "zorder": 0, "lw": 0}
        if error_requested is not None:
            ax.axhspan(down[0], error_requested, **shade)
        if cost_limit is not None:
            ax.axvspan(along[0], cost_limit, **shade)
        for point in points:
            look = looks[point.solver]
            style: dict[str, Any] = sheet_marker_style(look, is_stale=False) | {
                "alpha": 1.0 if is_within(point) else 0.35
            }
            style |= {"marker": look.marker, "ls": "", "color": look.color, "ms": 6.5 * sized(look)}
            ax.plot(point.seconds_per_simulated_second, point.error, zorder=3, **style)
        for k, point in enumerate(within[: MAX_RUNNERS_UP + 1]):
            ring: dict[str, Any] = (
                {"mec": TEXT_COLOUR, "mew": 1.8, "ms": 18} if not k else {"mec": MUTED_COLOUR, "mew": 0.9, "ms": 14}
            )
            ax.plot(point.seconds_per_simulated_second, point.error, "o", mfc="none", zorder=4, **ring)
            ax.annotate(
                "recommended" if not k else str(k),
                (point.seconds_per_simulated_second, point.error), (0, 10 if k else -22),
                textcoords="offset points", ha="center", fontsize=9, color=TEXT_COLOUR if not k else MUTED_COLOUR,
            )  # fmt: skip
        format_log_axis(ax.xaxis, *along, unit="time")
        format_log_axis(ax.yaxis, *down, unit="percent")
        ax.set_xlabel("wall time a simulated second", fontsize=9, loc="left")
        note: dict[str, Any] = {"textcoords": "offset points", "ha": "right", "fontsize": 9, "color": MUTED_COLOUR}
        if error_requested is not None:
            ax.annotate(
                f"asked: {100 * error_requested:.3g} %", (1.0, error_requested), (-6, 4),
                xycoords=("axes fraction", "data"), **note,
            )  # fmt: skip
        if cost_limit is not None:
            ax.annotate(
                f"budget: {format_duration(cost_limit)}", (cost_limit, 1.0), (-4, -14),
                xycoords=("data", "axes fraction"), **note,
            )  # fmt: skip
        draw_legend(
            page, {solver: looks[solver]._replace(dash="") for solver in dict.fromkeys(p.solver for p in points)}
        )
        draw_notes(page, words)
    return sheet_paths(stem)


def _describe_candidate(point: CandidatePoint, best: CandidatePoint | None = None) -> str:
    times = (
        f", {format_quantity(point.seconds_per_simulated_second / best.seconds_per_simulated_second)} times as long"
        if best
        else ""
    )
    return (
        f"{point.description}: an error of {100 * point.error:.2g} % for "
        f"{format_duration(point.seconds_per_simulated_second)} a simulated second{times}"
    )
