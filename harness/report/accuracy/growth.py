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

from harness.report.accuracy.convergence import GUESSES
from harness.report.accuracy.measured import Curve, Measurements, older
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
from harness.report.accuracy.time_plot import middle
from harness.report.accuracy.times import left_out, power
from harness.report.labels import direct_labels
from harness.report.style import OLDER, looks

TARGET = 1e-3

_FITTED, _COLUMNS, _ABREAST = 3, 4, 3  # sizes that a fit needs; scenes in a row; panels that stay in one row


class SizeGrowth(NamedTuple):
    """A solver's times to TARGET on the sizes of a scene where it reached it.

    Attributes:
        vertices: numbers of vertices (k,).
        seconds: median over the snapshots (k,) [s].
        exponent: exponent of the fitted power law; nan for too few sizes.
        lost: numbers of vertices of the sizes on which the gap was not reached.
        older: which of the sizes (k,) involve measurements by other code than the current version.
    """

    scene: str
    first_guess: str
    label: str
    vertices: list[int]
    seconds: list[float]
    exponent: float
    lost: list[int]
    older: list[bool]


def growths(table: Measurements, other: Callable[[Curve], bool] = older) -> list[SizeGrowth]:
    """Fit the scaling of each solver on each scene with two sizes or more.

    Args:
        table: data of an accuracy measurement.
        other: returns whether other code measured a curve.
    """
    groups: dict[tuple[str, str, str], dict[int, list[Curve]]] = {}
    for curve in table.curves:
        sizes = groups.setdefault((curve.problem.scene, curve.first_guess, curve.label), {})
        sizes.setdefault(curve.problem.vertices, []).append(curve)
    found: list[SizeGrowth] = []
    for (scene, guess, label), sizes in groups.items():
        times = {n: middle(curves, TARGET) for n, curves in sorted(sizes.items())}
        reached = {n: t for n, t in times.items() if np.isfinite(t) and t > 0.0}
        if len(times) > 1:
            lost = [n for n, t in times.items() if t == np.inf]
            hollow = [any(map(other, sizes[n])) for n in reached]
            exponent = _exponent(reached)
            found.append(SizeGrowth(scene, guess, label, [*reached], [*reached.values()], exponent, lost, hollow))
    return found


def _exponent(times: dict[int, float]) -> float:
    if len(times) < _FITTED:
        return np.nan
    return float(np.polyfit(np.log([*times]), np.log([*times.values()]), 1)[0])


def draw_growth(table: Measurements, stem: Path) -> list[Path]:
    """Draw the scaling of all scenes with several sizes, and return the files.

    There is a column for each scene and a row for each initial guess.
    """
    found = growths(table)
    scenes = list(dict.fromkeys(growth.scene for growth in found))[:_COLUMNS]
    if not scenes:
        return []
    marked = looks((curve.label, curve.solver) for curve in table.curves)
    guesses = [guess for guess in GUESSES if any(growth.first_guess == guess for growth in found)]
    words = [
        "Median over the steps of a mesh, set-up apart. Powers are fitted to three sizes or more.",
        *left_out(problem for problem in table.problems if problem.scene in scenes),
        *(
            f"× {g.label} on {g.scene}, {GUESSES[g.first_guess]}, did not get there at {_listed(g.lost)} vertices"
            for g in found
            if g.lost
        ),
        *([OLDER] if any(any(growth.older) for growth in found) else []),
    ]
    with sheet(stem, f"Growth with size: time to a gap of {power(TARGET)}", table.machine) as page:
        places = [(guess, scene) for guess in guesses for scene in scenes]
        columns = len(places) if len(places) <= _ABREAST else len(scenes)
        width = (RIGHT - LEFT - 56) / columns - 24
        height = (foot(words) - TOP) / ceil(len(places) / columns) - 82
        low, high = limits([t for growth in found for t in growth.seconds], margin=1.6)
        for k, (guess, scene) in enumerate(places):
            row, column = divmod(k, columns)
            left, top = LEFT + 56 + column * (width + 24), TOP + 22 + row * (height + 78)
            ax = panel(page, left, top, width, height, f"{scene}, {GUESSES[guess]}")
            here = [g for g in found if (g.scene, g.first_guess) == (scene, guess)]
            sizes = sorted({n for g in here for n in (*g.vertices, *g.lost)}) or [1, 10]
            # Space at the right for the labels of lines with a fitted exponent.
            room = 1 / max(width / 170 - 1, 1) if any(np.isfinite(g.exponent) for g in here) else 0.0
            log_axis(ax.xaxis, sizes[0] / 1.2, 1.2 * sizes[-1] * (sizes[-1] / sizes[0]) ** room, unit="plain")
            ax.xaxis.set_major_locator(FixedLocator(sizes[:: ceil(len(sizes) / 5)]))
            log_axis(ax.yaxis, low, high, unit="time")
            ax.tick_params(labelleft=column == 0)
            for growth in here:
                line(ax, growth.vertices, growth.seconds, marked[growth.label], spaced=False, older=growth.older)
            ends = [
                (g.vertices[-1], g.seconds[-1], f"{g.label}  $n^{{{g.exponent:.2f}}}$", marked[g.label].color)
                for g in here
                if np.isfinite(g.exponent)
            ]
            direct_labels(ax, ends)
            ax.set_xlabel("vertices", fontsize=9, loc="left")
        used = {growth.label for growth in found}
        legend(page, {label: mark for label, mark in marked.items() if label in used})
        notes(page, words)
    return files(stem)


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers))
