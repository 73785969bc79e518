# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Reproduction of figures 2 and 3 of Liu et al. 2013.

Own curves are drawn over the paper's, and their differences are listed. The paper's values are read from its figures
and text: the relative error (g - g*)/(g0 - g*), g0 at the inertial target, of the curtain (1 m x 1 m, 1 kg, dt = 1/30
s). Figure 2 is one step of the 81 x 81 curtain on one core of 2012; figure 3 has means over 50 frames. The paper does
not state pins, damping and frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from harness.report.accuracy.measured import LONG, Curve, Measurements, Problem, by_other_code
from harness.report.accuracy.sheet import (
    LEFT,
    RIGHT,
    TOP,
    files,
    foot,
    legend,
    limits,
    line,
    log_axis,
    notes,
    panel,
    sheet,
)
from harness.report.style import INK, MUTED, PAGE, Mark, looks
from solvers.about import LOCAL_GLOBAL

FIGURE_2 = {1: (3.61e-1, 5.4e-3), 10: (1.96e-1, 50.6e-3), 100: (4.02e-2, 0.501), 1000: (2.98e-4, 5.05)}
"""Iterations of local-global: relative error, seconds."""

FIGURE_2_NEWTON = ((1.45, 4.1e-4), (1.75, 4.6e-6))
"""Newton with preconditioned conjugate gradients: seconds, relative error."""

ITERATIONS = (1, 10, 50, 100)

FIGURE_3 = {
    (81, 1200): (0.16, 0.048, 0.0206, 0.0130),
    (41, 600): (0.123, 0.038, 0.0125, 0.0069),
    (21, 300): (0.061, 0.016, 0.0032, 0.00104),
    (11, 150): (0.035, 0.0039, 6.7e-5, 1.3e-5),
    (21, 600): (0.114, 0.033, 0.0062, 0.00195),
    (21, 1200): (0.237, 0.100, 0.035, 0.0156),
    (21, 2400): (0.26, 0.132, 0.062, 0.035),
}
"""Vertices per side and stiffness [N/m]: mean relative error after each of ITERATIONS of local-global."""

FAR = 2.0
"""Ratio to the paper's error beyond which a sentence reports the difference."""

_COLORS = ("#0b3c5d", "#2f7fb8", "#3fae8f", "#c9a227", "#d9822b", "#c0392b", "#7b2d8b")
_HEADINGS = ("Figure 2, by iterations", "Figure 2, by time", "Figure 3, by size", "Figure 3, 21 × 21 by stiffness")


class PaperComparison(NamedTuple):
    """One point of a curve: own error, the paper's error, and averaged frames."""

    curve: str
    iterations: int
    ours: float
    theirs: float
    frames: int

    @property
    def ratio(self) -> float:
        """The own error divided by the paper's."""
        return self.ours / self.theirs

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        when = f"after {self.iterations} iteration{'s' if self.iterations > 1 else ''}"
        over = f"over {self.frames} frame{'s' if self.frames > 1 else ''}"
        values = f"ours {self.ours:.2g} {over}, the paper's {self.theirs:.2g}, ratio {self.ratio:.2g}"
        return f"{self.curve}, {when}: {values}"


def stiffness(problem: Problem) -> float:
    """Return the springs' stiffness [N/m] of the paper's curtain, whose vertices share 1 kg."""
    return problem.stiffness_ratio / (problem.vertices * problem.time_step**2)


def comparisons(table: Measurements) -> list[PaperComparison]:
    """Return all points of the paper that the rows have a counterpart of."""
    found: list[PaperComparison] = []
    for curve in _long(table)[:1]:
        for iterations, (theirs, _) in FIGURE_2.items():
            ours = at(curve, iterations)
            if np.isfinite(ours):
                found.append(PaperComparison("figure 2", iterations, ours, theirs, 1))
    for (side, k), values in FIGURE_3.items():
        curves = _frames(table, side, k)
        for iterations, theirs in zip(ITERATIONS, values, strict=True):
            errors = [at(curve, iterations) for curve in curves]
            known = [error for error in errors if np.isfinite(error)]
            if known:
                name = f"figure 3, {side} × {side}, k = {k}"
                found.append(PaperComparison(name, iterations, float(np.mean(known)), theirs, len(known)))
    return found


def at(curve: Curve, iterations: int) -> float:
    """Return the gap after n iterations, at least round-off.

    A curve that converged before n iterations counts with its last gap.

    Returns: the gap; nan if it is unknown or the minimum is not certified.
    """
    if curve.problem.doubt or not len(curve.iterations) or curve.status in ("failed", "diverged", "unsupported"):
        return np.nan
    k = int(np.searchsorted(curve.iterations, iterations, side="right")) - 1
    ended = curve.iterations[-1] < iterations and curve.status == "ok"
    exact = curve.iterations[k] == iterations or ended
    return max(float(curve.gap[k]), curve.problem.round_off) if exact else np.nan


def own(table: Measurements) -> Iterator[Curve]:
    """Select the paper's local-global by the fastest measured backend, from the paper's initial guess."""
    paper = [c for c in table.curves if c.problem.paper and c.first_guess == "inertial"]
    theirs = [c for c in paper if c.family == LOCAL_GLOBAL]
    solver = min(theirs, key=_iteration_seconds).solver if theirs else None
    return (curve for curve in paper if curve.solver == solver)


def _iteration_seconds(curve: Curve) -> float:
    """Return the time of one iteration per vertex [s].

    Times are per vertex because sizes differ; infinite if nothing was timed.
    """
    done = curve.iterations.max(initial=0.0) * curve.problem.vertices
    seconds = float(np.median(curve.seconds[:, -1])) if len(curve.iterations) else np.nan
    return seconds / done if done and np.isfinite(seconds) else np.inf


def _long(table: Measurements) -> list[Curve]:
    return [c for c in own(table) if c.problem.vertices == 81**2 and c.iterations.max(initial=0.0) >= LONG]


def _frames(table: Measurements, side: int, k: float) -> list[Curve]:
    """Select the curves of one curtain, with a stiffness tolerance of 10 %.

    The tolerance allows for different ways to count pins, and still separates all stiffnesses.
    """
    return [c for c in own(table) if c.problem.vertices == side**2 and abs(stiffness(c.problem) / k - 1) < 0.1]


def draw_paper(table: Measurements, stem: Path) -> list[Path]:
    """Draw four panels of own results over the paper's, and return the files.

    No file is written if no row belongs to the reproduction.
    """
    found = comparisons(table)
    if not found:
        return []
    far = sorted((c for c in found if max(c.ratio, 1 / c.ratio) > FAR), key=lambda c: -abs(np.log(c.ratio)))
    words = [*by_other_code(own(table)), *(f"differs by more than {FAR:g}: {c.sentence}" for c in far)]
    facts = ["relative error (g − g*) / (g0 − g*)", "ours filled, the paper's open", *table.machine]
    long = [
        c for c in table.curves if _long(table) and c.problem is _long(table)[0].problem and c.first_guess == "inertial"
    ]
    marked = looks((c.label, c.solver) for c in long)
    with sheet(stem, "Liu et al. 2013, reproduced", facts) as page:
        width, height = (RIGHT - LEFT - 62) / 4 - 20, foot(words) - TOP - 176
        axes = [panel(page, LEFT + 62 + k * (width + 20), TOP + 22, width, height, h) for k, h in enumerate(_HEADINGS)]
        _figure_2(axes[0], axes[1], long, marked, found)
        _figure_3(axes[2], found, [key for key in FIGURE_3 if key[1] * 80 == 1200 * (key[0] - 1)])
        _figure_3(axes[3], found, [key for key in FIGURE_3 if key[0] == 21])
        _scales(axes)
        theirs = Line2D([], [], color=INK, marker="o", mfc=PAGE, linestyle=(0, (1, 1.6)))
        legend(
            page,
            marked,
            below=[
                (theirs, "Liu et al. 2013"),
                (Line2D([], [], color=INK, marker="D", mfc=PAGE, linestyle=""), "their Newton"),
            ],
        )
        notes(page, words)
    return files(stem)


def _figure_2(
    by_iterations: Axes,
    by_time: Axes,
    curves: Sequence[Curve],
    marked: dict[str, Mark],
    found: Sequence[PaperComparison],
) -> None:
    for curve in curves:
        gap = np.maximum(curve.gap, curve.problem.round_off)
        line(by_iterations, curve.iterations[1:], gap[1:], marked[curve.label])
        line(by_time, np.median(curve.seconds, axis=0)[1:], gap[1:], marked[curve.label])
    ratios = [f"{c.ratio:.2g}" for c in found if c.curve == "figure 2"]
    _below(by_iterations, 0, f"ours / the paper's after {', '.join(map(str, FIGURE_2))}:", MUTED)
    _below(by_iterations, 1, f"81 × 81, k = 1200:   {'   '.join(ratios) or 'not measured'}", INK)
    errors, seconds = zip(*FIGURE_2.values(), strict=True)
    look: dict[str, Any] = {
        "color": INK,
        "linestyle": (0, (1, 1.6)),
        "mfc": PAGE,
        "markersize": 7,
        "mew": 1.4,
        "zorder": 6,
    }
    empty: Any = look | {"linestyle": ""}
    by_iterations.plot([*FIGURE_2], errors, marker="o", **look)
    by_time.plot(seconds, errors, marker="o", **look)
    by_time.plot(*zip(*FIGURE_2_NEWTON, strict=True), marker="D", **empty)


def _figure_3(ax: Axes, compared: Sequence[PaperComparison], keys: Sequence[tuple[int, int]]) -> None:
    """Draw own and published errors in one colour per curtain, with the ratios below."""
    for row, (side, k) in enumerate(keys):
        color = _COLORS[list(FIGURE_3).index((side, k))]
        theirs = FIGURE_3[side, k]
        ax.plot(ITERATIONS, theirs, color=color, linestyle=(0, (1, 1.6)), marker="o", mfc=PAGE, mew=1.4, markersize=7)
        found = [c for c in compared if c.curve == f"figure 3, {side} × {side}, k = {k}"]
        ax.plot(
            [c.iterations for c in found], [c.ours for c in found], color=color, marker="o", markersize=5, linewidth=1.5
        )
        ratios = "   ".join(f"{c.ratio:.2g}" for c in found) or "not measured"
        _below(ax, row + 1, f"{side} × {side}, k = {k}:   {ratios}", color)
    _below(ax, 0, f"ours / the paper's after {', '.join(map(str, ITERATIONS))}:", MUTED)


def _below(ax: Axes, row: int, words: str, color: str) -> None:
    """Draw a line of text below a panel."""
    ax.text(0.0, -(62 + 17 * row) / ax.bbox.height, words, color=color, fontsize=8.5, transform=ax.transAxes)


def _scales(axes: Sequence[Axes]) -> None:
    """Set one error scale for all panels; the x-axis is iterations, or time."""
    drawn = [line for ax in axes for line in ax.lines]
    errors = limits((value for line in drawn for value in np.asarray(line.get_ydata(), float)), least=1e-12)
    for k, ax in enumerate(axes):
        across = [value for line in ax.lines for value in np.asarray(line.get_xdata(), float)]
        log_axis(ax.xaxis, *limits(across), unit="time" if k == 1 else "plain")
        log_axis(ax.yaxis, *errors)
        ax.set_xlabel("wall time, ours and of 2012" if k == 1 else "iterations", fontsize=9, loc="left")
        ax.tick_params(labelleft=k == 0)
