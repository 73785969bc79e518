# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Work-precision diagram: error of a simulation against its wall time, and the Pareto front."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from harness.report.accuracy.measured import Measurements, WorkPoint, older
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
    size,
)
from harness.report.accuracy.times import duration, power
from harness.report.page import quantity, step_words, text
from harness.report.style import INK, MUTED, OLDER, PAGE, Mark, looks
from solvers.about import LOCAL_GLOBAL
from solvers.integrators import INTEGRATORS

ACROSS = 4
"""Number of panels in a row."""

_PLAIN, _OWN = 4.4, 7.0
"""Marker sizes: the smallest of a tolerance, and that of substepping methods, which have no connected line."""

_WILD = 1e3
"""Relative errors beyond it belong to motions that exploded, even if finite: they are above the panel."""

ERRORS = (0.1, 0.03, 0.01, 0.003, 0.001)
"""Errors at which the Pareto front is described in words."""


def is_default(work: WorkPoint) -> bool:
    """Return whether this is the most common setting.

    It is implicit Euler at 1/30 s with 50 iterations of local-global.
    """
    same_method = work.family == LOCAL_GLOBAL and work.integrator == "implicit-euler"
    return same_method and work.tolerance is None and work.iterations == 50 and abs(30 * work.time_step - 1) < 1e-9


def default(works: Iterable[WorkPoint]) -> WorkPoint | None:
    """Find the most common setting among these, by the fastest of its backends."""
    return min((w for w in works if is_default(w) and _known(w)), key=lambda w: w.seconds, default=None)


def front(works: Iterable[WorkPoint]) -> list[WorkPoint]:
    """Return the Pareto front in time and error, the cheapest first."""
    kept: list[WorkPoint] = []
    for work in sorted((w for w in works if _known(w)), key=lambda w: (w.seconds, w.error)):
        if not kept or work.error < kept[-1].error:
            kept.append(work)
    return kept


def findings(works: Sequence[WorkPoint]) -> list[str]:
    """Describe the cheapest setting for each error, compared with the default setting's method."""
    base = default(works)
    words: list[str] = []
    if base:
        words.append(
            f"the default ({base.setting}) has an error of {100 * base.error:.2g} % "
            f"for {duration(base.seconds)} a simulated second"
        )
    for error in ERRORS:
        best = next((work for work in front(works) if work.error <= error), None)
        if best:
            euler = min(
                (w for w in works if same_method(w, base) and _known(w) and w.error <= error),
                key=lambda w: w.seconds,
                default=None,
            )
            against = (
                f", 1/{quantity(euler.seconds / best.seconds)} of what the default's method needs" if euler else ""
            )
            words.append(f"{100 * error:g} %: {best.setting}: {duration(best.seconds)} a simulated second{against}")
    return words


def same_method(work: WorkPoint, base: WorkPoint | None) -> bool:
    """Return whether it differs from the default only in the time step."""
    return base is not None and (work.label, work.integrator, work.tolerance, work.iterations) == (
        base.label,
        base.integrator,
        base.tolerance,
        base.iterations,
    )


def draw_work(table: Measurements, folder: Path) -> list[Path]:
    """Draw a picture for each mesh, one panel per integrator; return the files."""
    drawn: list[Path] = []
    marked = looks((work.label, work.solver) for work in table.works)
    for mesh in dict.fromkeys(work.mesh for work in table.works):
        here = [work for work in table.works if work.mesh == mesh]
        if any(_known(work) for work in here):
            stem = folder / mesh.replace(" ", "-")
            _draw(stem, mesh, here, marked, table.machine)
            drawn += files(stem)
    return drawn


def _known(work: WorkPoint) -> bool:
    return work.status == "ok" and 0.0 < work.error < np.inf and 0.0 < work.seconds < np.inf


def _draw(stem: Path, mesh: str, works: list[WorkPoint], marked: dict[str, Mark], machine: Sequence[str]) -> None:
    words = _notes(works)
    there = {work.integrator for work in works}
    integrators = [*(name for name in INTEGRATORS if name in there), *sorted(there - set(INTEGRATORS))]
    known = [work for work in works if _known(work)]
    sizes = _sizes(works)
    across = limits([w.seconds for w in known], margin=1.6)
    down = limits([w.error for w in known if w.error < _WILD] or [w.error for w in known], margin=1.6)
    facts = [f"{quantity(works[0].horizon)} s simulated", "time stepping and solver together", *machine]
    if any(work.truth == "self-converged" for work in works):
        facts.insert(1, "by a self-converged reference")
    with sheet(stem, f"Work and precision: {mesh}", facts) as page:
        across_page, down_page = min(ACROSS, len(integrators)), -(-len(integrators) // ACROSS)
        width = (RIGHT - LEFT - 62) / across_page - 20
        height = (foot(words) - TOP - 46) / down_page
        text(page, LEFT + 62, TOP + 4, "error of the positions, relative to the way from the start", size=10.5)
        for k, integrator in enumerate(integrators):
            row, column = divmod(k, ACROSS)
            left, top = LEFT + 62 + column * (width + 20), TOP + 46 + row * height
            ax = panel(page, left, top, width, height - 46, integrator)
            _panel(ax, [work for work in known if work.integrator == integrator], marked, sizes)
            _front(ax, known)
            log_axis(ax.xaxis, *across, unit="time")
            log_axis(ax.yaxis, *down, unit="percent")
            ax.set_xlabel("wall time a simulated second", fontsize=9, loc="left")
            if column:
                ax.tick_params(labelleft=False)
        minimises = {work.label: work.minimises for work in works}
        names = {
            label if minimises[label] else f"{label} †": mark for label, mark in marked.items() if label in minimises
        }
        legend(page, names, below=_meanings(sizes))
        notes(page, words)


def _sizes(works: Iterable[WorkPoint]) -> dict[float | None, float]:
    """Assign marker sizes by tolerance, larger for tighter ones; None, fixed iterations, gets the smallest.

    Substepping methods have no iterations, and the largest markers.
    """
    tolerances = sorted({work.tolerance for work in works if work.tolerance is not None}, reverse=True)
    return {None: 2.8, **{tolerance: _PLAIN + 1.6 * k for k, tolerance in enumerate(tolerances)}}


def _panel(ax: Axes, works: list[WorkPoint], marked: dict[str, Mark], sizes: dict[float | None, float]) -> None:
    """Draw the points of one integrator.

    Points that differ only in the time step, or only in the substeps, are joined.
    """
    chains: dict[tuple[str, float | None, float, str], list[WorkPoint]] = {}
    divided = _divided(works)
    for work in works:
        differs = work.time_step if work.label in divided else work.iterations
        chains.setdefault((work.label, work.tolerance, differs, work.first_guess), []).append(work)
    for (label, tolerance, *_), members in chains.items():
        members.sort(key=lambda work: (work.time_step, -work.iterations))
        look, hollow = marked[label], [older(work) for work in members]
        x, y = [work.seconds for work in members], [work.error for work in members]
        grown = max(_OWN, *sizes.values()) if members[0].own_steps else sizes[tolerance]
        line(ax, x, y, look, spaced=False, older=hollow, linewidth=0.9, markersize=grown * size(look))
    base = default(works)
    if base:
        ax.plot(base.seconds, base.error, "o", mfc="none", mec=INK, markersize=15, mew=1.6, zorder=6)
        ax.annotate(
            "the default", (base.seconds, base.error), (11, 4), textcoords="offset points",
            fontsize=9, ha="left", color=INK, bbox={"facecolor": PAGE, "alpha": 0.8, "edgecolor": "none", "pad": 0.8},
        )  # fmt: skip


def _divided(works: Iterable[WorkPoint]) -> set[str]:
    """Find the labels of methods that were measured with several numbers of substeps."""
    tried: dict[str, set[int]] = {}
    for work in works:
        if work.own_steps:
            tried.setdefault(work.label, set()).add(work.iterations)
    return {label for label, numbers in tried.items() if len(numbers) > 1}


def _front(ax: Axes, works: list[WorkPoint]) -> None:
    """Draw the Pareto front of all integrators, the same in each panel.

    It is the smallest error for each wall time.
    """
    best = front(works)
    if best:
        x, y = [work.seconds for work in best], [work.error for work in best]
        ax.plot(
            [x[0], *x, 1e6], [1e6, *y, y[-1]], drawstyle="steps-post", color=MUTED, linewidth=5, alpha=0.28, zorder=1
        )


def _meanings(sizes: dict[float | None, float]) -> list[tuple[Line2D, str]]:
    def dot(**more: Any) -> Line2D:
        return Line2D([], [], color=MUTED, marker="o", linestyle="", **more)

    return [
        (Line2D([], [], color=MUTED, linewidth=5, alpha=0.28), "Pareto front of all"),
        *((dot(markersize=grown), _stop(t)) for t, grown in sizes.items()),
    ]


def _stop(tolerance: float | None) -> str:
    if tolerance is None:
        return "fixed iterations"
    return f"tolerance {power(tolerance)}" if tolerance else "tolerance auto"


def _notes(works: Sequence[WorkPoint]) -> list[str]:
    words = ["Joined points differ in the time step alone: " + ", ".join(map(step_words, _steps(works)))]
    divided = _divided(works)
    if solvers := sorted({work.solver for work in works if work.label in divided}):
        words[0] += f"; those of {', '.join(solvers)} in the substeps alone"
    if any(_known(work) and work.error >= _WILD for work in works):
        words.append("What leaves a panel at its top exploded")
    if not all(work.minimises for work in works):
        words.append("† does not minimise the step's objective: its limit is not the integrator's own solution")
    words += [OLDER] if any(map(older, works)) else []
    failed = [work for work in works if work.status != "ok"]
    return words + [f"× {work.setting}: {work.status}{': ' if work.reason else ''}{work.reason}" for work in failed]


def _steps(works: Sequence[WorkPoint]) -> list[float]:
    return sorted({work.time_step for work in works}, reverse=True)
