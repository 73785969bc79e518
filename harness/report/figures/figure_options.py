"""Options of a figure from the command line; lengths are in millimetres."""

from __future__ import annotations

import re
from dataclasses import dataclass

from springbench.harness.errors import InputError, InputMistake, format_allowed_names

MIN_FONT_SIZE = 6.0
"""Minimum font size [points], because smaller type is not readable in print."""

_MILLIMETRES_PER_UNIT = {"mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72.0}
_MIN_WIDTH, _MAX_WIDTH = 40.0, 400.0
"""Minimum and maximum width [mm]: below there is no space for text, and no page is wider."""
FIGURE_FORMATS = ("pdf", "svg", "png")
MESH_KINDS = frozenset({"run", "comparison", "scenes"})
"""Kinds of figures that show meshes, which the process that selects them draws."""


@dataclass(frozen=True, slots=True)
class FigureOptions:
    """Options of a figure.

    Attributes:
        width_mm: width [mm].
        font_size: font size [points].
        selectors: parts of panel names; the parts of one selector are joined by colons on the command line.
    """

    width_mm: float = 85.0
    formats: tuple[str, ...] = ("pdf", "svg", "png")
    font_size: float = 8.0
    selectors: tuple[tuple[str, ...], ...] = ()
    has_title: bool = True
    is_transparent: bool = False

    @property
    def small_font_size(self) -> float:
        """The font size of ticks and of the foot [points]."""
        return max(MIN_FONT_SIZE, self.font_size - 1.0)

    @property
    def mark_scale(self) -> float:
        """Size of markers and lines, 1 at a font size of 8 points or less."""
        return max(1.0, self.font_size / 8.0)

    @property
    def background_colour(self) -> str:
        """The background colour in Matplotlib's terms."""
        return "none" if self.is_transparent else "white"


def parse_figure_options(
    width: str, formats: str, font_size: float, panels: str, *, has_title: bool, is_transparent: bool
) -> FigureOptions:
    """Parse the figure options of the command line.

    Args:
        width: length with unit, such as 85mm.
        formats: formats separated by commas.
        font_size: font size [points].
        panels: selectors separated by commas.
        has_title: whether the figure has a title and a line on the machine.
        is_transparent: whether the background is transparent.

    Raises:
        InputError: with all mistakes in the options.
    """
    mistakes: list[InputMistake] = []
    millimetres = _parse_length(width, mistakes)
    given = tuple(dict.fromkeys(word.strip().lower() for word in formats.split(",") if word.strip()))
    for word in given or ("",):
        if word not in FIGURE_FORMATS:
            mistakes.append(
                InputMistake(f"got {word!r}; expected {format_allowed_names(word, FIGURE_FORMATS)}", key="--format")
            )
    if not MIN_FONT_SIZE <= font_size <= 24.0:
        why = (
            f"got {font_size:g}; expected from {MIN_FONT_SIZE:g} to 24 points, as smaller type cannot be read in print"
        )
        mistakes.append(InputMistake(why, key="--font-size"))
    if mistakes:
        raise InputError(mistakes)
    selectors = tuple(tuple(part for part in one.split(":") if part) for one in panels.split(",") if one.strip(" :"))
    return FigureOptions(millimetres, given, font_size, selectors, has_title, is_transparent)


def _parse_length(words: str, mistakes: list[InputMistake]) -> float:
    found = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*(mm|cm|in|pt)\s*", words)
    if found is None:
        mistakes.append(
            InputMistake(f"got {words!r}; expected a length such as 85mm, 8.5cm, 3.35in or 241pt", key="--width")
        )
        return 0.0
    length = float(found[1]) * _MILLIMETRES_PER_UNIT[found[2]]
    if not _MIN_WIDTH <= length <= _MAX_WIDTH:
        problem = f"got {words}; expected from {_MIN_WIDTH:g}mm to {_MAX_WIDTH:g}mm"
        mistakes.append(InputMistake(problem, key="--width"))
    return length
