"""Visual style of all pictures: page size, colours, strain scale, solver styles."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from hashlib import sha256
from typing import Any, NamedTuple

from springbench.harness.results.solver_metadata import read_registered_traits
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS

PAGE_WIDTH, PAGE_HEIGHT, PAGE_DPI = 1600, 900, 100
"""Size of every picture [pixels], and the dots per inch that convert it into the size of a Matplotlib figure."""

BACKGROUND_COLOUR, TEXT_COLOUR, MUTED_COLOUR, RULE_COLOUR = "#fcfbf9", "#23262b", "#6c7078", "#dcdad5"
"""Colours of background, text, secondary text and hairlines."""

STALE_NOTE = "Hollow marks: measured by other code than today's."
"""Meaning of hollow marks in all pictures; the results page defines its own relative to the newest rows."""

WARNING_COLOUR = "#b3261e"
"""Colour of text that a reader must not miss."""

SLOWER_COLOUR, FASTER_COLOUR = WARNING_COLOUR, "#1b7f5c"
"""Colours of benchmark changes."""

PAGE_RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": TEXT_COLOUR,
    "figure.facecolor": BACKGROUND_COLOUR,
    "axes.facecolor": BACKGROUND_COLOUR,
    "axes.edgecolor": MUTED_COLOUR,
    "axes.labelcolor": MUTED_COLOUR,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": MUTED_COLOUR,
    "ytick.color": MUTED_COLOUR,
    "grid.color": RULE_COLOUR,
    "grid.linewidth": 0.8,
}


class SeriesStyle(NamedTuple):
    """Style of one solver: a colour, a Matplotlib marker and a Matplotlib line style.

    Example:
        >>> springbench.SeriesStyle("#0072b2", "o").dash
        '-'
    """

    color: str
    marker: Any
    dash: Any = "-"


DASHED_LINE, DOTTED_LINE, DASH_DOTTED_LINE = (0, (5, 2)), (0, (1, 1.6)), (0, (6, 2, 1, 2))
_LINE_STYLES = ("-", DASHED_LINE, DOTTED_LINE, DASH_DOTTED_LINE)

STAR_MARKERS: tuple[Any, ...] = ((4, 1, 0), (6, 1, 0), (3, 1, 0), (8, 1, 0), (3, 1, 180))
"""Stars with four, six, three, eight and three points, the last upside down."""
CORNER_MARKERS: tuple[Any, ...] = ((3, 0, 45), (3, 0, -45), (3, 0, 135), (3, 0, -135))
"""Triangles that point to the upper left, upper right, lower left and lower right."""
HOURGLASS_MARKER: Any = ((-1, 1), (1, 1), (-1, -1), (1, -1), (-1, 1))
BOWTIE_MARKER: Any = ((-1, -1), (-1, 1), (1, -1), (1, 1), (-1, -1))
"""Two triangles that touch at their tips, one above the other and side by side."""
LOZENGE_MARKER: Any = ((-1, 0), (0, 0.5), (1, 0), (0, -0.5), (-1, 0))
"""A diamond, wider than high."""
ARROWHEAD_MARKER: Any = ((0, 1), (0.9, -0.8), (0, -0.25), (-0.9, -0.8), (0, 1))
"""A triangle that points up, with a notch below."""
ARROW_BAR_MARKERS: tuple[Any, ...] = (
    ((-0.9, 1), (0.9, 1), (0.9, 0.6), (0.2, 0.6), (0.9, -0.9), (-0.9, -0.9), (-0.2, 0.6), (-0.9, 0.6), (-0.9, 1)),
    ((-1, -0.9), (-1, 0.9), (-0.6, 0.9), (-0.6, 0.2), (0.9, 0.9), (0.9, -0.9), (-0.6, -0.2), (-0.6, -0.9), (-1, -0.9)),
    ((-0.9, -1), (0.9, -1), (0.9, -0.6), (0.2, -0.6), (0.9, 0.9), (-0.9, 0.9), (-0.2, -0.6), (-0.9, -0.6), (-0.9, -1)),
)
"""Triangles that point up, left and down, with a bar at the tip."""
CHEVRON_MARKER: Any = ((-1, -0.7), (0, 0.1), (1, -0.7), (1, 0), (0, 0.8), (-1, 0), (-1, -0.7))
"""A broad chevron that points up."""
SPEARHEAD_MARKERS: tuple[Any, ...] = (
    ((1, 0), (-1, 0.5), (-1, -0.5), (1, 0)),
    ((-1, 0), (1, 0.5), (1, -0.5), (-1, 0)),
    ((0, -1), (0.5, 1), (-0.5, 1), (0, -1)),
    ((0, 1), (0.5, -1), (-0.5, -1), (0, 1)),
)
"""Slim triangles that point right, left, down and up."""
_ALL_MARKERS: tuple[Any, ...] = (
    "s",
    "o",
    "D",
    "^",
    "v",
    "P",
    "X",
    "p",
    "*",
    "<",
    ">",
    "h",
    "d",
    "H",
    "8",
    *STAR_MARKERS,
    *CORNER_MARKERS,
    HOURGLASS_MARKER,
    BOWTIE_MARKER,
    LOZENGE_MARKER,
    ARROWHEAD_MARKER,
    *ARROW_BAR_MARKERS,
    CHEVRON_MARKER,
    *SPEARHEAD_MARKERS,
)

_FAMILY_COLOURS: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("#0072b2", (0.0, 0.44, 0.3, 0.17, -0.26)),
    ("#00a878", (0.0, -0.13, 0.19, -0.48, -0.28)),
    ("#e69f00", (0.0,)),
    ("#d55e00", (0.0, 0.3)),
    ("#9a86e0", (0.0,)),
    ("#cc79a7", (0.0, -0.21, -0.42)),
    ("#b155eb", (0.0, -0.28, -0.42, 0.15)),
    ("#858585", (0.0, -0.46, 0.55, -0.15, 0.17, 0.36, -0.31)),
    ("#8a994c", (0.0, 0.21, -0.34, -0.17)),
    ("#8b4a1c", (0.0, 0.12, 0.3, -0.16)),
)
"""Colours of families in the order of the registry, and by how much each member is lighter, or darker if negative.

Members of two families are 25 units of CIELAB apart or more, members of one family almost 8.
"""
_MEMBER_LINE_STYLES: tuple[Any, ...] = (
    *("-", DASHED_LINE, (0, (14, 2)), DASH_DOTTED_LINE, (0, (1, 3)), (0, (3, 1, 1, 1, 1, 1))),
    (0, (12, 2, 1, 2)),
)
"""Line styles of a family's members."""
_VARIANT_LINE_STYLES: tuple[Any, ...] = tuple(dict.fromkeys((*_LINE_STYLES, *_MEMBER_LINE_STYLES)))
"""Line styles of variants that differ from a solver only in their settings."""
_PLUGIN_COLOURS = (
    *("#8a8a00", "#00a0a0", "#8c564b", "#4c6ef5", "#5a9e2f", "#c9506b", "#b8860b", "#6a3d9a", "#1f8a70", "#e377c2"),
    *("#3b7a9e", "#d97b66", "#7a9a01", "#9c4f96"),
)


def assign_solver_styles(solvers: Iterable[str] = ()) -> dict[str, SeriesStyle]:
    """Return the style of each solver of the registry, and of these others.

    Styles are stable and distinct. The style of a solver outside the registry follows from a hash of its name. If two
    would get the same colour, the later one in alphabetical order gets the next free colour, and if there is none, the
    next free style.

    Example:
        >>> springbench.assign_solver_styles(["my-method"])["my-method"].dash
        '-'
    """
    looks = dict(_shipped_solver_styles((*SOLVERS, *OPTIONAL_SOLVERS)))
    free = [
        SeriesStyle(color, marker, dash)
        for dash in _LINE_STYLES
        for color in _PLUGIN_COLOURS
        for marker in _ALL_MARKERS
    ]
    taken: set[str | SeriesStyle] = set()
    for name in sorted({*SOLVERS, *OPTIONAL_SOLVERS, *solvers} - set(looks)):
        place = int(sha256(name.encode()).hexdigest(), 16) % (len(free) // len(_LINE_STYLES))
        order = [*free[place:], *free[:place]]
        unused = (look for look in order if look.color not in taken)
        looks[name] = next(unused, None) or next(look for look in order if look not in taken)
        taken |= {looks[name].color, looks[name]}
    return looks


@cache
def _shipped_solver_styles(names: tuple[str, ...]) -> dict[str, SeriesStyle]:
    """Return the styles of the registry's solvers.

    A style has the colour of the solver's family, and a marker of its own. Solvers beyond the number of markers, or of
    the shades of their family, get no style here.
    """
    families: dict[str, list[str]] = {}
    traits = read_registered_traits()
    for name in names:
        families.setdefault(traits[name].family, []).append(name)
    markers = dict(zip(names, _ALL_MARKERS, strict=False))
    return {
        name: SeriesStyle(shade_colour(color, by), markers[name], dash)
        for (color, shades), members in zip(_FAMILY_COLOURS, families.values(), strict=False)
        for name, by, dash in zip(members, shades, _MEMBER_LINE_STYLES, strict=False)
        if name in markers
    }


def contrasting_text_colour(color: str) -> str:
    """Return TEXT_COLOUR or white, whichever is easier to read on a colour `#rrggbb`.

    Contrast and relative luminance are those of WCAG 2.1.
    """
    dark, light, behind = (_relative_luminance(one) + 0.05 for one in (TEXT_COLOUR, "#ffffff", color))
    return TEXT_COLOUR if behind / dark > light / behind else "#ffffff"


def _relative_luminance(color: str) -> float:
    channels = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
    linear = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels)
    return sum(weight * c for weight, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def shade_colour(color: str, amount: float) -> str:
    """Mix a colour with white or black.

    Args:
        color: colour #rrggbb.
        amount: share of white in (0, 1], or of black if it is negative.
    """
    end = 1.0 if amount > 0.0 else 0.0
    parts = (int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
    return "#" + "".join(f"{round(255.0 * ((1.0 - abs(amount)) * part + abs(amount) * end)):02x}" for part in parts)


def assign_label_styles(label_solver_pairs: Iterable[tuple[str, str]]) -> dict[str, SeriesStyle]:
    """Assign a style to each (label, solver) pair.

    All labels of a solver have its colour and marker, and the first one also its line style.
    """

    def change_dash(own: SeriesStyle, k: int) -> SeriesStyle:
        styles = [own.dash, *(dash for dash in _VARIANT_LINE_STYLES if dash != own.dash)]
        return own._replace(dash=styles[k % len(styles)])

    return _assign_variants(label_solver_pairs, change_dash)


def assign_label_shades(label_solver_pairs: Iterable[tuple[str, str]]) -> dict[str, SeriesStyle]:
    """Assign a shade to each (label, solver) pair, for charts without line styles.

    The first label has its solver's colour, the others have lighter and darker shades of it.
    """

    def change_shade(own: SeriesStyle, k: int) -> SeriesStyle:
        step = 0.22 * ((k + 1) // 2) * (1.0 if k % 2 else -1.0)
        return own._replace(color=shade_colour(own.color, max(-0.7, min(step, 0.7))) if k else own.color)

    return _assign_variants(label_solver_pairs, change_shade)


def _assign_variants(
    label_solver_pairs: Iterable[tuple[str, str]], vary: Callable[[SeriesStyle, int], SeriesStyle]
) -> dict[str, SeriesStyle]:
    pairs = sorted(set(label_solver_pairs))
    own, found = assign_solver_styles(solver for _, solver in pairs), dict[str, SeriesStyle]()
    for solver, mark in own.items():
        labels = [label for label, its in pairs if its == solver]
        found |= {label: vary(mark, k) for k, label in enumerate(labels)}
    return found


def build_indexed_style(number: int) -> SeriesStyle:
    """Return the style of something that is not a solver, by its index.

    There are 64 styles from index 0 on, the first 8 in distinct colours.
    """
    # The marker is shifted by one with each pass through the colours.
    return SeriesStyle(_FAMILY_COLOURS[number % 8][0], _ALL_MARKERS[(number + number // 8) % 8], (0, (3, 1.2)))
