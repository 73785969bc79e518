"""Visual style of all pictures: page size, colours, strain scale, solver styles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from hashlib import sha256
from typing import Any, NamedTuple

from matplotlib.colors import LinearSegmentedColormap, to_hex, to_rgb

from harness.record.shading import STRAIN_COLOURS
from solvers.registry import OPTIONAL, SOLVERS, about, load

WIDTH, HEIGHT, DPI = 1600, 900, 100
"""Size of every picture [pixels], and the dots per inch that convert it into the size of a Matplotlib figure."""

PAGE, INK, MUTED, RULE = "#fcfbf9", "#23262b", "#6c7078", "#dcdad5"
"""Colours of background, text, secondary text and hairlines."""

OLDER = "Hollow marks: measured by other code than today's."
"""Meaning of hollow marks in all pictures; the results page defines its own relative to the newest rows."""

WARNING = "#b3261e"
"""Colour of text that a reader must not miss."""

SLOWER, FASTER = WARNING, "#1b7f5c"
"""Colours of benchmark changes."""

STRAIN_MAP = LinearSegmentedColormap.from_list("strain", STRAIN_COLOURS, N=512)
"""Colour map of strains in recordings, from -strain_range to strain_range."""

RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": INK,
    "figure.facecolor": PAGE,
    "axes.facecolor": PAGE,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "grid.color": RULE,
    "grid.linewidth": 0.8,
}


class Mark(NamedTuple):
    """Style of one solver: a colour, a Matplotlib marker and a Matplotlib line style."""

    color: str
    marker: Any
    dash: Any = "-"


DASHED, DOTTED, DASH_DOTTED = (0, (5, 2)), (0, (1, 1.6)), (0, (6, 2, 1, 2))
_DASHES = ("-", DASHED, DOTTED, DASH_DOTTED)

STARS: tuple[Any, ...] = ((4, 1, 0), (6, 1, 0), (3, 1, 0), (8, 1, 0), (3, 1, 180))
"""Stars with four, six, three, eight and three points, the last upside down."""
CORNERS: tuple[Any, ...] = ((3, 0, 45), (3, 0, -45), (3, 0, 135), (3, 0, -135))
"""Triangles that point to the upper left, upper right, lower left and lower right."""
HOURGLASS: Any = ((-1, 1), (1, 1), (-1, -1), (1, -1), (-1, 1))
BOWTIE: Any = ((-1, -1), (-1, 1), (1, -1), (1, 1), (-1, -1))
"""Two triangles that touch at their tips, one above the other and side by side."""
LOZENGE: Any = ((-1, 0), (0, 0.5), (1, 0), (0, -0.5), (-1, 0))
"""A diamond, wider than high."""
ARROWHEAD: Any = ((0, 1), (0.9, -0.8), (0, -0.25), (-0.9, -0.8), (0, 1))
"""A triangle that points up, with a notch below."""
BARS: tuple[Any, ...] = (
    ((-0.9, 1), (0.9, 1), (0.9, 0.6), (0.2, 0.6), (0.9, -0.9), (-0.9, -0.9), (-0.2, 0.6), (-0.9, 0.6), (-0.9, 1)),
    ((-0.9, -1), (0.9, -1), (0.9, -0.6), (0.2, -0.6), (0.9, 0.9), (-0.9, 0.9), (-0.2, -0.6), (-0.9, -0.6), (-0.9, -1)),
)
"""Triangles that point up and down, with a bar at the tip."""
CHEVRON: Any = ((-1, -0.7), (0, 0.1), (1, -0.7), (1, 0), (0, 0.8), (-1, 0), (-1, -0.7))
"""A broad chevron that points up."""
SPEARHEADS: tuple[Any, ...] = (
    ((1, 0), (-1, 0.5), (-1, -0.5), (1, 0)),
    ((-1, 0), (1, 0.5), (1, -0.5), (-1, 0)),
    ((0, -1), (0.5, 1), (-0.5, 1), (0, -1)),
    ((0, 1), (0.5, -1), (-0.5, -1), (0, 1)),
)
"""Slim triangles that point right, left, down and up."""
_MARKERS: tuple[Any, ...] = (
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
    *STARS,
    *CORNERS,
    HOURGLASS,
    BOWTIE,
    LOZENGE,
    ARROWHEAD,
    *BARS,
    CHEVRON,
    *SPEARHEADS,
)

# For families in the order of the registry: four colours of Okabe and Ito's palette, and six more.
_FAMILIES = (
    "#0072b2",
    "#00a878",
    "#e69f00",
    "#d55e00",
    "#9a86e0",
    "#cc79a7",
    "#a8326e",
    "#858585",
    "#8a994c",
    "#99634c",
)
_MEMBERS: tuple[tuple[float, Any], ...] = (
    *((0.0, "-"), (-0.27, DASHED), (0.3, (0, (14, 2))), (0.2, DASH_DOTTED), (-0.12, (0, (1, 3)))),
)
"""Lightening of a family's members (darkening where negative), and their line styles."""
_MANY: tuple[tuple[float, Any], ...] = (
    *((0.0, "-"), (-0.3, DOTTED), (0.3, (0, (10, 3))), (-0.48, (0, (3, 1, 1, 1, 1, 1)))),
    *((0.15, (0, (8, 2, 2, 2, 2, 2))), (-0.16, (0, (1, 3))), (0.42, (0, (12, 2, 1, 2)))),
)
"""Shades and line styles for families of more than five members, and for engines; other families rarely use these."""
_VARIANTS: tuple[Any, ...] = (*_DASHES, *(dash for _, dash in _MANY[2:]))
"""Line styles of variants that differ from a solver only in their settings."""
_STRANGERS = (
    *("#8a8a00", "#00a0a0", "#8c564b", "#4c6ef5", "#5a9e2f", "#c9506b", "#b8860b", "#6a3d9a", "#1f8a70", "#e377c2"),
    *("#3b7a9e", "#d97b66", "#7a9a01", "#9c4f96"),
)


def marks(solvers: Iterable[str] = ()) -> dict[str, Mark]:
    """Return the style of each solver of the registry, and of these others.

    Styles are stable and distinct. The style of a solver outside the registry follows from a hash of its name. If two
    would get the same colour, the later one in alphabetical order gets the next free colour, and if there is none, the
    next free style.
    """
    looks = dict(_shipped((*SOLVERS, *OPTIONAL)))
    free = [Mark(color, marker, dash) for dash in _DASHES for color in _STRANGERS for marker in _MARKERS]
    taken: set[str | Mark] = set()
    for name in sorted({*SOLVERS, *OPTIONAL, *solvers} - set(looks)):
        place = int(sha256(name.encode()).hexdigest(), 16) % (len(free) // len(_DASHES))
        order = [*free[place:], *free[:place]]
        unused = (look for look in order if look.color not in taken)
        looks[name] = next(unused, None) or next(look for look in order if look not in taken)
        taken |= {looks[name].color, looks[name]}
    return looks


@cache
def _shipped(names: tuple[str, ...]) -> dict[str, Mark]:
    """Return the styles of the registry's solvers.

    A style has the colour of the solver's family, and a marker of its own. Solvers beyond the number of markers get no
    style here.
    """
    families: dict[str, list[str]] = {}
    for name in names:
        families.setdefault(about(load((SOLVERS | OPTIONAL)[name]), name).family, []).append(name)
    markers = dict(zip(names, _MARKERS, strict=False))
    return {
        name: Mark(shade(color, by), markers[name], dash)
        for color, members in zip(_FAMILIES, families.values(), strict=False)
        for name, (by, dash) in zip(members, _members(members), strict=False)
        if name in markers
    }


def _members(family: Sequence[str]) -> Sequence[tuple[float, Any]]:
    """Return the shades and line styles of a family's members.

    For engines one style is skipped: their solid light brown would look like a green of others to some readers, and
    their darkest brown like black.
    """
    if not set(family) & SOLVERS.keys():
        return *_MANY[:3], *_MANY[4:]
    return _MANY if len(family) > len(_MEMBERS) else _MEMBERS


def shade(color: str, by: float) -> str:
    """Mix a colour with white, or with black if `by` is negative."""
    end = 1.0 if by > 0.0 else 0.0
    red, green, blue = ((1.0 - abs(by)) * part + abs(by) * end for part in to_rgb(color))
    return to_hex((red, green, blue))


def looks(labelled: Iterable[tuple[str, str]]) -> dict[str, Mark]:
    """Assign a style to each (label, solver) pair.

    All labels of a solver have its colour and marker, and the first one also its line style.
    """

    def dashed(own: Mark, k: int) -> Mark:
        styles = [own.dash, *(dash for dash in _VARIANTS if dash != own.dash)]
        return own._replace(dash=styles[k % len(styles)])

    return _varied(labelled, dashed)


def shades(labelled: Iterable[tuple[str, str]]) -> dict[str, Mark]:
    """Assign a shade to each (label, solver) pair, for charts without line styles.

    The first label has its solver's colour, the others have lighter and darker shades of it.
    """

    def shaded(own: Mark, k: int) -> Mark:
        step = 0.22 * ((k + 1) // 2) * (1.0 if k % 2 else -1.0)
        return own._replace(color=shade(own.color, max(-0.7, min(step, 0.7))) if k else own.color)

    return _varied(labelled, shaded)


def _varied(labelled: Iterable[tuple[str, str]], vary: Callable[[Mark, int], Mark]) -> dict[str, Mark]:
    pairs = sorted(set(labelled))
    own, found = marks(solver for _, solver in pairs), dict[str, Mark]()
    for solver, mark in own.items():
        labels = [label for label, its in pairs if its == solver]
        found |= {label: vary(mark, k) for k, label in enumerate(labels)}
    return found


def numbered(number: int) -> Mark:
    """Return the style of something that is not a solver, by its index.

    There are 64 styles from index 0 on, the first 8 in distinct colours.
    """
    # The marker is shifted by one with each pass through the colours.
    return Mark(_FAMILIES[number % 8], _MARKERS[(number + number // 8) % 8], (0, (3, 1.2)))
