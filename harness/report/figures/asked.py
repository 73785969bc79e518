"""Options of a figure from the command line; lengths are in millimetres."""

from __future__ import annotations

import re
from dataclasses import dataclass

from harness.base.errors import InputError, Mistake, did_you_mean

LEAST = 6.0
"""Minimum font size [points], because smaller type is not readable in print."""

_UNITS = {"mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72.0}
_NARROWEST, _WIDEST = 40.0, 400.0
"""Minimum and maximum width [mm]: below there is no space for text, and no page is wider."""
FORMATS = ("pdf", "svg", "png")


@dataclass(frozen=True, slots=True)
class Asked:
    """Options of a figure.

    Attributes:
        width: width [mm].
        size: font size [points].
        selectors: parts of panel names; the parts of one selector are joined by colons on the command line.
    """

    width: float = 85.0
    formats: tuple[str, ...] = ("pdf", "svg", "png")
    size: float = 8.0
    selectors: tuple[tuple[str, ...], ...] = ()
    titled: bool = True
    transparent: bool = False

    @property
    def small(self) -> float:
        """The font size of ticks and of the foot [points]."""
        return max(LEAST, self.size - 1.0)

    @property
    def background(self) -> str:
        """The background colour in Matplotlib's terms."""
        return "none" if self.transparent else "white"


def asked(width: str, formats: str, size: float, panels: str, *, titled: bool, transparent: bool) -> Asked:
    """Parse the figure options of the command line.

    Args:
        width: length with unit, such as 85mm.
        formats: formats separated by commas.
        size: font size [points].
        panels: selectors separated by commas.
        titled: whether the figure has a title and a line on the machine.
        transparent: whether the background is transparent.
    Raises:
        InputError: with all mistakes in the options.
    """
    mistakes: list[Mistake] = []
    millimetres = _length(width, mistakes)
    wanted = tuple(dict.fromkeys(word.strip().lower() for word in formats.split(",") if word.strip()))
    for word in wanted or ("",):
        if word not in FORMATS:
            mistakes.append(Mistake(f"came {word!r}; wanted {did_you_mean(word, FORMATS)}", key="--format"))
    if not LEAST <= size <= 24.0:
        why = f"came {size:g}; wanted from {LEAST:g} to 24 points, as smaller type cannot be read in print"
        mistakes.append(Mistake(why, key="--font-size"))
    if mistakes:
        raise InputError(mistakes)
    selectors = tuple(tuple(part for part in one.split(":") if part) for one in panels.split(",") if one.strip(" :"))
    return Asked(millimetres, wanted, size, selectors, titled, transparent)


def _length(words: str, mistakes: list[Mistake]) -> float:
    found = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*(mm|cm|in|pt)\s*", words)
    if found is None:
        mistakes.append(Mistake(f"came {words!r}; wanted a length such as 85mm, 8.5cm, 3.35in or 241pt", key="--width"))
        return 0.0
    length = float(found[1]) * _UNITS[found[2]]
    if not _NARROWEST <= length <= _WIDEST:
        wanted = f"came {words}; wanted from {_NARROWEST:g}mm to {_WIDEST:g}mm"
        mistakes.append(Mistake(wanted, key="--width"))
    return length
