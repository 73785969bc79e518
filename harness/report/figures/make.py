"""Production of a figure: selection of its panels, composition, checks and output."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from harness.base.errors import InputError, Mistake
from harness.report.figures import entry, writing
from harness.report.figures.asked import Asked
from harness.report.figures.canvas import compose
from harness.report.figures.faults import faults
from harness.report.figures.kinds import Kind
from harness.report.figures.of_runs import Older

_TOLD = 3
"""Maximum number of faults that a message lists."""


class Made(NamedTuple):
    """A figure that was written.

    Attributes:
        paths: files.
        panels: names of its panels.
        millimetres: width and height [mm].
        others: number of further panels in the results.
        example: name of one of them.
    """

    paths: list[Path]
    panels: list[str]
    millimetres: tuple[float, float]
    others: int
    example: str


def make(name: str, kind: Kind, results: Path, older: Older, folder: Path, asked: Asked) -> Made:
    """Write the figure of a kind to files.

    Args:
        name: name of the kind.
        kind: kind of figure.
        results: folder of the results.
        older: see `Kind.panels`.
        folder: folder that the files are written to.
        asked: options of the figure.
    Raises:
        InputError: if the results contain nothing of the kind, if no panel matches a selector, if curves and maps are
            selected together, or if the text does not fit the width.
    """
    entries = kind.panels(results, older)
    if not entries:
        raise InputError(Mistake(f"holds nothing to draw as {name}; wanted {kind.wanted}", results))
    usual = [one for one in kind.usual if any(set(one) <= set(known.parts) for known in entries)]
    picked = entry.chosen(entries, asked.selectors or usual)
    panels = kind.draw(picked)
    if len({type(panel) for panel in panels}) > 1:
        parts = ", ".join(":".join(one.parts) for one in picked)
        why = f"came {parts}, of which some are curves and some are maps; wanted one of both: their data differ"
        raise InputError(Mistake(f"{why}; draw the others as a figure of their own", key="--panels"))
    figure = compose(panels, kind.title, asked)
    wrong = faults(figure)
    if wrong:
        more = f" and {len(wrong) - _TOLD} more" if len(wrong) > _TOLD else ""
        why = f"came {asked.width:g} mm for type of {asked.size:g} points, in which {'; '.join(wrong[:_TOLD])}{more}"
        raise InputError(Mistake(f"{why}; wanted a wider figure, smaller type or fewer panels", key="--width"))
    parts = [part for selector in asked.selectors for part in selector]
    stem = folder / "-".join(dict.fromkeys([name, *parts]))
    paths = writing.write(figure, panels, stem, kind.title, asked)
    rest = [one for one in entries if one not in picked]
    example = ":".join(rest[0].parts) if rest else ""
    shown = [":".join(one.parts) for one in picked]
    return Made(paths, shown, writing.millimetres(figure), len(rest), example)
