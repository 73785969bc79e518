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
from springbench.harness.errors import InputError
from springbench.harness.report.plot_style import BACKGROUND_COLOUR, MUTED_COLOUR, PAGE_DPI, RULE_COLOUR, TEXT_COLOUR
from springbench.harness.report.provenance_words import describe_machine_and_commit
from springbench.harness.report.robustness import (
    MAP_NOTE,
    RUN_OUTCOMES,
    RunOutcome,
    VerifiedRun,
    format_cell,
    format_share,
    map_headline,
    read_verified_runs,
    score_solvers,
)
from springbench.harness.results import row_store

(
    _CELL_HEIGHT,
    _CELL_WIDTH,
    _CASE_LABEL_WIDTH,
    _SOLVER_LABEL_HEIGHT,
    _LEGEND_COLUMN_WIDTH,
    _LEGEND_ROW_HEIGHT,
    _TEXT_LINE_HEIGHT,
) = 0.2, 0.64, 2.3, 1.35, 2.1, 0.26, 0.17
"""Inches: height and width of a cell, space for the names of cases and of solvers, column width and row height of
the legend, and height of a line of the note.
"""

_MIN_WIDTH, _ROTATED_LETTER_WIDTH = 6.5, 0.075
"""Inches: minimum width, and the horizontal extent of a letter in a rotated name."""

_TITLE_SIZE, _NOTE_SIZE, _LETTER_WIDTH = 13.0, 8.0, 0.64
"""Font sizes of title and note [points], and the width of a letter in units of the font size."""

_SCORE_ROWS, _HEADING_ROWS = 3, 1.2
"""Number of rows for the solvers' scores, and rows between two families of cases."""


def draw_robustness_map(cells: Sequence[VerifiedRun], path: Path, title: str, stale_ids: Collection[str] = ()) -> None:
    """Draw the map as a PNG file.

    Args:
        cells: verified runs.
        path: target file.
        title: title of the map.
        stale_ids: ids of runs that were executed by other code than the current version; they get a hollow mark.
    """
    solvers = list(dict.fromkeys(cell.solver for cell in cells))
    places, rows = _layout_rows(list(dict.fromkeys(cell.case for cell in cells)))
    used = [outcome for outcome in RUN_OUTCOMES if any(cell.outcome == outcome for cell in cells)]
    ends = [_CELL_WIDTH * (x + 0.45) + _ROTATED_LETTER_WIDTH * len(solver) for x, solver in enumerate(solvers)]
    width = max(_CASE_LABEL_WIDTH + max([_CELL_WIDTH * len(solvers) + 0.3, *ends]), _MIN_WIDTH)
    provenance = ", ".join(describe_machine_and_commit([{"cpu": cell.cpu, "commit": cell.commit} for cell in cells]))
    head, foot = (
        _wrap_words(title, width, _TITLE_SIZE),
        [*_wrap_words(MAP_NOTE, width, _NOTE_SIZE), *_wrap_words(provenance, width, _NOTE_SIZE)],
    )
    if any(cell.run_id in stale_ids for cell in cells):
        foot += _wrap_words("Hollow marks: runs that other code than today's did.", width, _NOTE_SIZE)
    across = max(1, int((width - 0.3) / _LEGEND_COLUMN_WIDTH))
    legend, below = _LEGEND_ROW_HEIGHT * -(-len(used) // across), _TEXT_LINE_HEIGHT * len(foot) + 0.35
    top, bottom = _SOLVER_LABEL_HEIGHT + 0.28 * len(head), below + legend + 0.15
    height = top + _CELL_HEIGHT * rows + bottom
    figure = Figure((width, height), PAGE_DPI, facecolor=BACKGROUND_COLOUR)
    ax = figure.add_axes(
        (_CASE_LABEL_WIDTH / width, bottom / height, _CELL_WIDTH * len(solvers) / width, _CELL_HEIGHT * rows / height)
    )
    ax.set_xlim(0, len(solvers))
    ax.set_ylim(rows, 0)
    ax.set_axis_off()
    for cell in cells:
        x, y = solvers.index(cell.solver), places[cell.case]
        ax.add_patch(Rectangle((x + 0.02, y + 0.05), 0.96, 0.9, facecolor=cell.outcome.color, linewidth=0))
        ax.text(
            x + 0.5, y + 0.53, format_cell(cell), ha="center", va="center", fontsize=8, color=_text_colour(cell.outcome)
        )
        if cell.run_id in stale_ids:
            ax.plot(x + 0.1, y + 0.5, "o", mfc=BACKGROUND_COLOUR, mec=TEXT_COLOUR, ms=4.5, mew=1.0)
    for x, solver in enumerate(solvers):
        ax.text(x + 0.45, -0.25, solver, ha="left", va="bottom", rotation=40, fontsize=9, color=TEXT_COLOUR)
    for case, y in places.items():
        ax.text(-0.1, y + 0.53, _case_member(case), ha="right", va="center", fontsize=8.5, color=TEXT_COLOUR)
    for family, of in groupby(places, _case_family):
        ax.text(
            -0.1, places[next(of)] - 0.45, family, ha="right", va="center", fontsize=9, color=TEXT_COLOUR, weight="bold"
        )
    _draw_scores(ax, cells)
    words = "\n".join(head)
    figure.text(
        0.15 / width, 1 - 0.15 / height, words, fontsize=_TITLE_SIZE, color=TEXT_COLOUR, weight="bold", va="top"
    )
    _draw_legend(figure, cells, used, across, below + legend - 0.2)
    words = "\n".join(foot)
    figure.text(
        0.15 / width, 0.15 / height, words, fontsize=_NOTE_SIZE, color=MUTED_COLOUR, linespacing=1.5, va="bottom"
    )
    figure.savefig(path, facecolor=BACKGROUND_COLOUR)


def _layout_rows(cases: Sequence[str]) -> tuple[dict[str, float], float]:
    """Lay out the cases, with space above each family for its name.

    Returns: the row of each case, and the total number of rows.
    """
    places, y = dict[str, float](), float(_SCORE_ROWS)
    for _, family in groupby(cases, _case_family):
        y += _HEADING_ROWS
        for case in family:
            places[case] = y
            y += 1.0
    return places, y


def _draw_scores(ax: Axes, cells: Sequence[VerifiedRun]) -> None:
    """Draw the solvers' scores above their columns: both shares as bars, and the worst error."""
    for y, words in enumerate(("right", "finite", "worst")):
        ax.text(-0.1, y + 0.53, words, ha="right", va="center", fontsize=8.5, color=TEXT_COLOUR, weight="bold")
    for x, score in enumerate(score_solvers(cells)):
        for y, share in enumerate((score.correct_share, score.finite_share)):
            ax.add_patch(Rectangle((x + 0.02, y + 0.05), 0.96, 0.9, facecolor=RULE_COLOUR, linewidth=0))
            ax.add_patch(
                Rectangle((x + 0.02, y + 0.05), 0.96 * (share or 0.0), 0.9, facecolor=_SHARE_COLOURS[y], linewidth=0)
            )
        for y, words in enumerate(
            (format_share(score.correct_share), format_share(score.finite_share), score.worst_run.error_text)
        ):
            ax.text(x + 0.5, y + 0.53, words, ha="center", va="center", fontsize=8, color=TEXT_COLOUR, weight="bold")


_SHARE_COLOURS = ("#8fcbad", "#c4ccd6")
"""Colours of the bars for the correct and the finite share."""


def _draw_legend(
    figure: Figure, cells: Sequence[VerifiedRun], used: Sequence[RunOutcome], columns: int, top: float
) -> None:
    """Draw the legend of the outcomes, with `columns` entries per row, from `top` [inches] downwards."""
    width, height = figure.get_size_inches()
    for k, outcome in enumerate(used):
        row, column = divmod(k, columns)
        x, y = 0.15 + _LEGEND_COLUMN_WIDTH * column, top - _LEGEND_ROW_HEIGHT * row
        words = f"{outcome.label} ({sum(cell.outcome == outcome for cell in cells)})"
        box = Rectangle((x / width, y / height), 0.2 / width, 0.16 / height, facecolor=outcome.color)
        figure.add_artist(box)
        figure.text((x + 0.27) / width, (y + 0.08) / height, words, fontsize=9, va="center", color=TEXT_COLOUR)


def _wrap_words(words: str, width: float, size: float) -> list[str]:
    """Wrap text into lines that fit a width [inches] at a font size [points]."""
    return wrap(words, int(72.0 * (width - 0.3) / (_LETTER_WIDTH * size)))


def _case_family(case: str) -> str:
    return case.partition("-")[0]


def _case_member(case: str) -> str:
    return case.partition("-")[2] or case


def _text_colour(outcome: RunOutcome) -> str:
    red, green, blue = (int(outcome.color[k : k + 2], 16) for k in (1, 3, 5))
    return TEXT_COLOUR if 0.3 * red + 0.6 * green + 0.1 * blue > 120 else BACKGROUND_COLOUR


def draw_robustness_maps(
    results: Path, find_stale: Callable[[Path], Collection[str]]
) -> Iterator[tuple[Path, list[VerifiedRun]]]:
    """Draw the maps of all sweeps with verified runs in a folder.

    Args:
        results: folder of results, or the folder of one sweep.
        find_stale: returns the ids of those runs in a sweep's folder that other code than the current version executed.
    Yields: each picture and its runs.
    """
    for rows in row_store.find_row_folders(results, "rows"):
        with suppress(InputError):
            cells = read_verified_runs(rows.parent)
            picture = rows.parent / "pictures" / "robustness.png"
            picture.parent.mkdir(exist_ok=True)
            draw_robustness_map(
                cells, picture, map_headline(cells, rows.parent.resolve().name), find_stale(rows.parent)
            )
            yield picture, cells
