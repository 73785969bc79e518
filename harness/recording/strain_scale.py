"""Colours of strains in recordings and pictures, and the ends of their scale."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

STRAIN_COLOURS = ("#125490", "#64a2d6", "#d9d7d2", "#e5863b", "#943404")
"""Colours at strains -range, -range/2, 0, range/2, range: blue compressed, grey at rest, orange stretched.

They are colour-blind safe, and the middle is grey enough for light and shadow to remain visible."""

PIN_COLOUR = "#c5299b"
"""Colour of pinned vertices in recordings and pictures: not on any strain scale, clear on light and on dark."""

DEFAULT_STRAIN_RANGE = 0.1
"""End of the scale where a run states no strain range."""
MIN_STRAIN_RANGE = 1e-3

NUM_LEVELS = 65
"""Number of colours of the scale; NUM_LEVELS - 1 is a multiple of 4, so that each of its five labels is at a level."""
NEUTRAL_COLOUR = (128, 128, 128, 255)
"""Colour of a strain that is NaN."""


def build_palette() -> NDArray[np.uint8]:
    """Return the colours of the levels, most compressed first, then NEUTRAL_COLOUR: (NUM_LEVELS + 1, 4)."""
    stops = np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)] + [255] for colour in STRAIN_COLOURS])
    at = np.linspace(0, len(stops) - 1, NUM_LEVELS)
    channels: list[NDArray[np.float64]] = [np.interp(at, range(len(stops)), channel) for channel in stops.T]
    colours = np.stack(channels, axis=1)
    return np.vstack([np.rint(colours), NEUTRAL_COLOUR]).astype(np.uint8)


def round_scale_end(strain: NDArray[np.float64]) -> float:
    """Return the end of a scale: the round number above 99 % of the strains.

    A few large strains at a pin thus do not leave all others grey. The result is DEFAULT_STRAIN_RANGE where none is
    finite.
    """
    known = np.abs(strain[np.isfinite(strain)])
    if not len(known):
        return DEFAULT_STRAIN_RANGE
    extent = max(float(np.quantile(known, 0.99)), MIN_STRAIN_RANGE)
    decade = 10.0 ** np.floor(np.log10(extent) + 1e-9)
    return float(next(step * decade for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * decade >= 0.999 * extent))


def format_percent(strain: float, digits: int = 3) -> str:
    """Format a strain with its sign as a percentage.

    Args:
        strain: relative change of length.
        digits: number of significant digits.
    """
    return f"{100 * strain:+.{digits}g} %".replace("-", "−")


def compute_strain_colours(strain: NDArray[np.float64], end: float) -> NDArray[np.uint32]:
    """Return the colours 0xRRGGBBAA (m,) of strains on the scale from -end to end.

    Args:
        strain: strains (m,); NaN has NEUTRAL_COLOUR, and strains beyond the scale have the colour of its end.
        end: strain at the end of the scale, positive.
    """
    with np.errstate(invalid="ignore"):
        level = np.rint((np.clip(strain / end, -1, 1) + 1) * (NUM_LEVELS - 1) / 2)
    return _packed_palette()[np.where(np.isnan(level), NUM_LEVELS, level).astype(np.intp)]


@cache
def _packed_palette() -> NDArray[np.uint32]:
    return build_palette().view(">u4").astype(np.uint32).ravel()


def widen_range(ends: tuple[float, float], strain: NDArray[np.float64]) -> tuple[float, float]:
    """Return the smallest and the largest of `ends` and the finite strains.

    Args:
        ends: smallest and largest strain so far.
        strain: strains (m,), which need not be finite.
    """
    known = strain[np.isfinite(strain)]
    return float(known.min(initial=ends[0])), float(known.max(initial=ends[1]))
