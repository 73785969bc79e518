# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Robustness map: solvers x cases, coloured by outcome, with the worst error in each cell."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from textwrap import wrap

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from harness.base import shelf
from harness.base.errors import InputError
from harness.report.origin import machine_and_commit
from harness.report.robustness import (
    DIVERGED,
    FAILED,
    OUTCOMES,
    RIGHT,
    WRONG,
    Judged,
    Outcome,
    percent,
    read_cells,
    scores,
)
from harness.report.style import DPI, INK, MUTED, PAGE, RULE

_ROW, _COLUMN, _LEFT, _TOP, _ACROSS, _LEGEND, _LINE = 0.2, 0.64, 2.3, 1.35, 2.1, 0.26, 0.17
"""Inches: height and width of a cell, space for the names of cases and of solvers, column width and row height of
the legend, and height of a line of the note.
"""

_NARROWEST, _TURNED = 6.5, 0.075
"""Inches: minimum width, and the horizontal extent of a letter in a rotated name."""

_TITLE, _NOTE, _LETTER = 13.0, 8.0, 0.64
"""Font sizes of title and note [points], and the width of a letter in units of the font size."""

_SCORES, _HEADING = 3, 1.2
"""Number of rows for the solvers' scores, and rows between two families of cases."""

NOTE = (
    "Numbers: the largest final residual |Q\u207b\u00b9 grad g|_Q of a step, over its value at the start of the step "
    "(or round-off); for methods that do not minimise, the largest distance from a converged run, in percent of the "
    "scene's size. Shares: of the cases that a solver supports."
)


def headline(cells: Sequence[Judged], name: str) -> str:
    """Return the headline of the map: counts of the main outcomes."""
    of = {outcome: sum(cell.outcome == outcome for cell in cells) for outcome in OUTCOMES}
    broken = of[DIVERGED] + of[FAILED]
    return f"{name}: {of[RIGHT]} of {len(cells)} runs right, {of[WRONG]} silently wrong, {broken} diverged or failed"


def draw_map(cells: Sequence[Judged], path: Path, title: str, older: Collection[str] = ()) -> None:
    """Draw the map as a PNG file.

    Args:
        cells: verified runs.
        path: target file.
        title: title of the map.
        older: ids of runs that were executed by other code than the current version; they get a hollow mark.
    """
    solvers = list(dict.fromkeys(cell.solver for cell in cells))
    places, rows = _places(list(dict.fromkeys(cell.case for cell in cells)))
    used = [outcome for outcome in OUTCOMES if any(cell.outcome == outcome for cell in cells)]
    ends = [_COLUMN * (x + 0.45) + _TURNED * len(solver) for x, solver in enumerate(solvers)]
    width = max(_LEFT + max([_COLUMN * len(solvers) + 0.3, *ends]), _NARROWEST)
    told = ", ".join(machine_and_commit([{"cpu": cell.cpu, "commit": cell.commit} for cell in cells]))
    head, foot = _fitted(title, width, _TITLE), [*_fitted(NOTE, width, _NOTE), *_fitted(told, width, _NOTE)]
    if any(cell.run_id in older for cell in cells):
        foot += _fitted("Hollow marks: runs that other code than today's did.", width, _NOTE)
    across = max(1, int((width - 0.3) / _ACROSS))
    legend, below = _LEGEND * -(-len(used) // across), _LINE * len(foot) + 0.35
    top, bottom = _TOP + 0.28 * len(head), below + legend + 0.15
    height = top + _ROW * rows + bottom
    figure = Figure((width, height), DPI, facecolor=PAGE)
    ax = figure.add_axes((_LEFT / width, bottom / height, _COLUMN * len(solvers) / width, _ROW * rows / height))
    ax.set_xlim(0, len(solvers))
    ax.set_ylim(rows, 0)
    ax.set_axis_off()
    for cell in cells:
        x, y = solvers.index(cell.solver), places[cell.case]
        ax.add_patch(Rectangle((x + 0.02, y + 0.05), 0.96, 0.9, facecolor=cell.outcome.color, linewidth=0))
        ax.text(x + 0.5, y + 0.53, cell.figure, ha="center", va="center", fontsize=8, color=_ink(cell.outcome))
        if cell.run_id in older:
            ax.plot(x + 0.1, y + 0.5, "o", mfc=PAGE, mec=INK, ms=4.5, mew=1.0)
    for x, solver in enumerate(solvers):
        ax.text(x + 0.45, -0.25, solver, ha="left", va="bottom", rotation=40, fontsize=9, color=INK)
    for case, y in places.items():
        ax.text(-0.1, y + 0.53, _member(case), ha="right", va="center", fontsize=8.5, color=INK)
    for family, of in groupby(places, _family):
        ax.text(-0.1, places[next(of)] - 0.45, family, ha="right", va="center", fontsize=9, color=INK, weight="bold")
    _draw_scores(ax, cells)
    words = "\n".join(head)
    figure.text(0.15 / width, 1 - 0.15 / height, words, fontsize=_TITLE, color=INK, weight="bold", va="top")
    _legend(figure, cells, used, across, below + legend - 0.2)
    words = "\n".join(foot)
    figure.text(0.15 / width, 0.15 / height, words, fontsize=_NOTE, color=MUTED, linespacing=1.5, va="bottom")
    figure.savefig(path, facecolor=PAGE)


def _places(cases: Sequence[str]) -> tuple[dict[str, float], float]:
    """Lay out the cases, with space above each family for its name.

    Returns: the row of each case, and the total number of rows.
    """
    places, y = dict[str, float](), float(_SCORES)
    for _, family in groupby(cases, _family):
        y += _HEADING
        for case in family:
            places[case] = y
            y += 1.0
    return places, y


def _draw_scores(ax: Axes, cells: Sequence[Judged]) -> None:
    """Draw the solvers' scores above their columns: both shares as bars, and the worst error."""
    for y, words in enumerate(("right", "finite", "worst")):
        ax.text(-0.1, y + 0.53, words, ha="right", va="center", fontsize=8.5, color=INK, weight="bold")
    for x, score in enumerate(scores(cells)):
        for y, share in enumerate((score.right, score.finite)):
            ax.add_patch(Rectangle((x + 0.02, y + 0.05), 0.96, 0.9, facecolor=RULE, linewidth=0))
            ax.add_patch(Rectangle((x + 0.02, y + 0.05), 0.96 * (share or 0.0), 0.9, facecolor=_BARS[y], linewidth=0))
        for y, words in enumerate((percent(score.right), percent(score.finite), score.worst.figure)):
            ax.text(x + 0.5, y + 0.53, words, ha="center", va="center", fontsize=8, color=INK, weight="bold")


_BARS = ("#8fcbad", "#c4ccd6")
"""Colours of the bars for the correct and the finite share."""


def _legend(figure: Figure, cells: Sequence[Judged], used: Sequence[Outcome], across: int, top: float) -> None:
    """Draw the legend of the outcomes, with `across` entries per row, from `top` [inches] downwards."""
    width, height = figure.get_size_inches()
    for k, outcome in enumerate(used):
        row, column = divmod(k, across)
        x, y = 0.15 + _ACROSS * column, top - _LEGEND * row
        words = f"{outcome.words} ({sum(cell.outcome == outcome for cell in cells)})"
        box = Rectangle((x / width, y / height), 0.2 / width, 0.16 / height, facecolor=outcome.color)
        figure.add_artist(box)
        figure.text((x + 0.27) / width, (y + 0.08) / height, words, fontsize=9, va="center", color=INK)


def _fitted(words: str, width: float, size: float) -> list[str]:
    """Wrap text into lines that fit a width [inches] at a font size [points]."""
    return wrap(words, int(72.0 * (width - 0.3) / (_LETTER * size)))


def _family(case: str) -> str:
    return case.partition("-")[0]


def _member(case: str) -> str:
    return case.partition("-")[2] or case


def _ink(outcome: Outcome) -> str:
    red, green, blue = (int(outcome.color[k : k + 2], 16) for k in (1, 3, 5))
    return INK if 0.3 * red + 0.6 * green + 0.1 * blue > 120 else PAGE


def draw_maps(results: Path, older: Callable[[Path], Collection[str]]) -> Iterator[tuple[Path, list[Judged]]]:
    """Draw the maps of all sweeps with verified runs in a folder.

    Args:
        results: folder of results, or the folder of one sweep.
        older: returns the ids of those runs in a sweep's folder that other code than the current version executed.
    Yields: each picture and its runs.
    """
    for rows in shelf.folders(results, "rows"):
        with suppress(InputError):
            cells = read_cells(rows.parent)
            picture = rows.parent / "pictures" / "robustness.png"
            picture.parent.mkdir(exist_ok=True)
            draw_map(cells, picture, headline(cells, rows.parent.resolve().name), older(rows.parent))
            yield picture, cells
