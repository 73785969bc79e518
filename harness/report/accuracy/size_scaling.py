# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Scaling with size: time to a gap of 1e-3 against the number of vertices.

Power laws are fitted to these times.
"""

from __future__ import annotations

from collections.abc import Callable
from math import ceil
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.ticker import FixedLocator
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, ConvergenceCurve, is_stale
from springbench.harness.report.accuracy.convergence_plot import INITIAL_GUESS_LABELS
from springbench.harness.report.accuracy.plot_sheet import (
    PANEL_LEFT,
    PANEL_RIGHT,
    PANEL_TOP,
    add_panel,
    draw_legend,
    draw_line,
    draw_notes,
    format_log_axis,
    log_limits,
    notes_top,
    plot_sheet,
    sheet_paths,
)
from springbench.harness.report.accuracy.time_to_accuracy import describe_excluded_steps, format_gap
from springbench.harness.report.accuracy.time_to_accuracy_plot import median_time
from springbench.harness.report.line_end_labels import draw_direct_labels
from springbench.harness.report.plot_style import STALE_NOTE, assign_label_styles

GAP_TARGET = 1e-3

_MIN_FIT_SIZES, _MAX_SCENES, _MAX_COLUMNS = (
    3,
    4,
    3,
)  # sizes that a fit needs; scenes in a row; panels that stay in one row


class SizeScaling(NamedTuple):
    """A solver's times to GAP_TARGET on the sizes of a scene where it reached it.

    Attributes:
        vertices: numbers of vertices (k,).
        seconds: median over the snapshots (k,) [s].
        exponent: exponent of the fitted power law; nan for too few sizes.
        unsolved_sizes: numbers of vertices of the sizes on which the gap was not reached.
        stale: which of the sizes (k,) involve measurements by other code than the current version.
    """

    scene: str
    initial_guess: str
    label: str
    vertices: list[int]
    seconds: list[float]
    exponent: float
    unsolved_sizes: list[int]
    stale: list[bool]


def fit_scalings(
    table: AccuracyData, is_stale_curve: Callable[[ConvergenceCurve], bool] = is_stale
) -> list[SizeScaling]:
    """Fit the scaling of each solver on each scene with two sizes or more.

    Args:
        table: data of an accuracy measurement.
        is_stale_curve: returns whether other code measured a curve.
    """
    groups: dict[tuple[str, str, str], dict[int, list[ConvergenceCurve]]] = {}
    for curve in table.curves:
        sizes = groups.setdefault((curve.problem.scene, curve.initial_guess, curve.label), {})
        sizes.setdefault(curve.problem.vertices, []).append(curve)
    found: list[SizeScaling] = []
    for (scene, guess, label), sizes in groups.items():
        times = {n: median_time(curves, GAP_TARGET) for n, curves in sorted(sizes.items())}
        reached = {n: t for n, t in times.items() if np.isfinite(t) and t > 0.0}
        if len(times) > 1:
            lost = [n for n, t in times.items() if t == np.inf]
            hollow = [any(map(is_stale_curve, sizes[n])) for n in reached]
            exponent = _fit_exponent(reached)
            found.append(SizeScaling(scene, guess, label, [*reached], [*reached.values()], exponent, lost, hollow))
    return found


def _fit_exponent(times: dict[int, float]) -> float:
    if len(times) < _MIN_FIT_SIZES:
        return np.nan
    return float(np.polyfit(np.log([*times]), np.log([*times.values()]), 1)[0])


def draw_scalings(table: AccuracyData, stem: Path) -> list[Path]:
    """Draw the scaling of all scenes with several sizes, and return the files.

    There is a column for each scene and a row for each initial guess.
    """
    found = fit_scalings(table)
    scenes = list(dict.fromkeys(growth.scene for growth in found))[:_MAX_SCENES]
    if not scenes:
        return []
    marked = assign_label_styles((curve.label, curve.solver) for curve in table.curves)
    guesses = [guess for guess in INITIAL_GUESS_LABELS if any(growth.initial_guess == guess for growth in found)]
    words = [
        "Median over the steps of a mesh, set-up apart. Powers are fitted to three sizes or more.",
        *describe_excluded_steps(problem for problem in table.problems if problem.scene in scenes),
        *(
            f"× {g.label} on {g.scene}, {INITIAL_GUESS_LABELS[g.initial_guess]}, did not get "
            f"there at {_join_numbers(g.unsolved_sizes)} vertices"
            for g in found
            if g.unsolved_sizes
        ),
        *([STALE_NOTE] if any(any(growth.stale) for growth in found) else []),
    ]
    with plot_sheet(stem, f"Growth with size: time to a gap of {format_gap(GAP_TARGET)}", table.machine_words) as page:
        places = [(guess, scene) for guess in guesses for scene in scenes]
        columns = len(places) if len(places) <= _MAX_COLUMNS else len(scenes)
        width = (PANEL_RIGHT - PANEL_LEFT - 56) / columns - 24
        height = (notes_top(words) - PANEL_TOP) / ceil(len(places) / columns) - 82
        low, high = log_limits([t for growth in found for t in growth.seconds], margin=1.6)
        for k, (guess, scene) in enumerate(places):
            row, column = divmod(k, columns)
            left, top = PANEL_LEFT + 56 + column * (width + 24), PANEL_TOP + 22 + row * (height + 78)
            ax = add_panel(page, left, top, width, height, f"{scene}, {INITIAL_GUESS_LABELS[guess]}")
            here = [g for g in found if (g.scene, g.initial_guess) == (scene, guess)]
            sizes = sorted({n for g in here for n in (*g.vertices, *g.unsolved_sizes)}) or [1, 10]
            # Space at the right for the labels of lines with a fitted exponent.
            room = 1 / max(width / 170 - 1, 1) if any(np.isfinite(g.exponent) for g in here) else 0.0
            format_log_axis(ax.xaxis, sizes[0] / 1.2, 1.2 * sizes[-1] * (sizes[-1] / sizes[0]) ** room, unit="plain")
            ax.xaxis.set_major_locator(FixedLocator(sizes[:: ceil(len(sizes) / 5)]))
            format_log_axis(ax.yaxis, low, high, unit="time")
            ax.tick_params(labelleft=column == 0)
            for growth in here:
                draw_line(
                    ax, growth.vertices, growth.seconds, marked[growth.label], spaced_markers=False, stale=growth.stale
                )
            ends = [
                (g.vertices[-1], g.seconds[-1], f"{g.label}  $n^{{{g.exponent:.2f}}}$", marked[g.label].color)
                for g in here
                if np.isfinite(g.exponent)
            ]
            draw_direct_labels(ax, ends)
            ax.set_xlabel("vertices", fontsize=9, loc="left")
        used = {growth.label for growth in found}
        draw_legend(page, {label: mark for label, mark in marked.items() if label in used})
        draw_notes(page, words)
    return sheet_paths(stem)


def _join_numbers(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers))
