# pyright: reportUnknownMemberType=false
# Matplotlib's stubs say nothing of most keywords.
"""The robustness map: solvers x cases, coloured by outcome, the worst residual in each cell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from harness.base import shelf
from harness.base.errors import InputError
from harness.report.robustness import (
    DIVERGED,
    FAILED,
    OUTCOMES,
    RIGHT,
    WRONG,
    Cell,
    Outcome,
    percent,
    read_cells,
    scores,
)
from harness.report.style import DPI, INK, MUTED, PAGE, RULE

_ROW, _COLUMN, _LEFT, _TOP, _BOTTOM, _ACROSS = 0.2, 0.64, 2.3, 1.75, 1.5, 2.2
"""Inches: a cell's height and width, room for the cases' names, for title and solvers' names, and for the legend, and
from one of its columns to the next."""

_SCORES, _HEADING = 3, 1.2
"""Rows for the solvers' scores, and rows from the last case of a family to the first of the next."""

NOTE = (
    "Figures: the largest residual |Q\u207b\u00b9 grad g|_Q that a step ended with, over its value at its start\n"
    "(or round-off); of methods that do not minimise, the largest distance from a converged run, in per cent of the\n"
    "size. Shares: of the cases that a solver does not refuse."
)


def headline(cells: Sequence[Cell], name: str) -> str:
    """The map in a line of words."""
    of = {outcome: sum(cell.outcome == outcome for cell in cells) for outcome in OUTCOMES}
    broken = of[DIVERGED] + of[FAILED]
    return f"{name}: {of[RIGHT]} of {len(cells)} runs right, {of[WRONG]} silently wrong, {broken} diverged or failed"


def draw_map(cells: Sequence[Cell], path: Path, title: str) -> None:
    """Draw the map to a PNG."""
    solvers = list(dict.fromkeys(cell.solver for cell in cells))
    places, rows = _places(list(dict.fromkeys(cell.case for cell in cells)))
    width, height = _LEFT + _COLUMN * len(solvers) + 0.8, _TOP + _ROW * rows + _BOTTOM
    figure = Figure((width, height), DPI, facecolor=PAGE)
    ax = figure.add_axes((_LEFT / width, _BOTTOM / height, _COLUMN * len(solvers) / width, _ROW * rows / height))
    ax.set_xlim(0, len(solvers))
    ax.set_ylim(rows, 0)
    ax.set_axis_off()
    for cell in cells:
        x, y = solvers.index(cell.solver), places[cell.case]
        ax.add_patch(Rectangle((x + 0.02, y + 0.05), 0.96, 0.9, facecolor=cell.outcome.color, linewidth=0))
        ax.text(x + 0.5, y + 0.53, cell.figure, ha="center", va="center", fontsize=8, color=_ink(cell.outcome))
    for x, solver in enumerate(solvers):
        ax.text(x + 0.45, -0.25, solver, ha="left", va="bottom", rotation=40, fontsize=9, color=INK)
    for case, y in places.items():
        ax.text(-0.1, y + 0.53, _member(case), ha="right", va="center", fontsize=8.5, color=INK)
    for family, of in groupby(places, _family):
        ax.text(-0.1, places[next(of)] - 0.45, family, ha="right", va="center", fontsize=9, color=INK, weight="bold")
    _draw_scores(ax, cells)
    figure.text(0.15 / width, 1 - 0.32 / height, title, fontsize=13, color=INK, weight="bold")
    _legend(figure, cells)
    figure.savefig(path, facecolor=PAGE)


def _places(cases: Sequence[str]) -> tuple[dict[str, float], float]:
    """The row of each case, with room above each family for its name; and how many rows there are in all."""
    places, y = dict[str, float](), float(_SCORES)
    for _, family in groupby(cases, _family):
        y += _HEADING
        for case in family:
            places[case] = y
            y += 1.0
    return places, y


def _draw_scores(ax: Axes, cells: Sequence[Cell]) -> None:
    """The solvers' scores above their columns: both shares as bars, and the worst of their figures."""
    for y, words in enumerate(("right", "finite", "worst")):
        ax.text(-0.1, y + 0.53, words, ha="right", va="center", fontsize=8.5, color=INK, weight="bold")
    for x, score in enumerate(scores(cells)):
        for y, share in enumerate((score.right, score.finite)):
            ax.add_patch(Rectangle((x + 0.02, y + 0.05), 0.96, 0.9, facecolor=RULE, linewidth=0))
            ax.add_patch(Rectangle((x + 0.02, y + 0.05), 0.96 * (share or 0.0), 0.9, facecolor=_BARS[y], linewidth=0))
        for y, words in enumerate((percent(score.right), percent(score.finite), score.worst.figure)):
            ax.text(x + 0.5, y + 0.53, words, ha="center", va="center", fontsize=8, color=INK, weight="bold")


_BARS = ("#8fcbad", "#c4ccd6")
"""Of the shares that are right and finite."""


def _legend(figure: Figure, cells: Sequence[Cell]) -> None:
    width, height = figure.get_size_inches()
    for k, outcome in enumerate(OUTCOMES):
        x, y = 0.15 + _ACROSS * (k % 4), 1.12 - 0.26 * (k // 4)
        words = f"{outcome.words} ({sum(cell.outcome == outcome for cell in cells)})"
        box = Rectangle((x / width, y / height), 0.2 / width, 0.16 / height, facecolor=outcome.color)
        figure.add_artist(box)
        figure.text((x + 0.27) / width, (y + 0.08) / height, words, fontsize=9, va="center", color=INK)
    figure.text(0.15 / width, 0.2 / height, NOTE, fontsize=8, color=MUTED, linespacing=1.5)


def _family(case: str) -> str:
    return case.partition("-")[0]


def _member(case: str) -> str:
    return case.partition("-")[2] or case


def _ink(outcome: Outcome) -> str:
    red, green, blue = (int(outcome.color[k : k + 2], 16) for k in (1, 3, 5))
    return INK if 0.3 * red + 0.6 * green + 0.1 * blue > 120 else PAGE


def draw_maps(results: Path) -> Iterator[tuple[Path, list[Cell]]]:
    """Draw the maps of those sweeps in a folder of results, or of one sweep, whose runs were judged."""
    for rows in shelf.folders(results, "rows"):
        with suppress(InputError):
            cells = read_cells(rows.parent)
            picture = rows.parent / "pictures" / "robustness.png"
            picture.parent.mkdir(exist_ok=True)
            draw_map(cells, picture, headline(cells, rows.parent.resolve().name))
            yield picture, cells
