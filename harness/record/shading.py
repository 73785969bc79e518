"""Strain colours and vertex normals of a recorded mesh, fast enough for every frame.

The strain of a spring is length / rest length - 1. A vertex shows the incident strain of largest magnitude, with its
sign, so that a single overstretched spring is visible. Normals are area-weighted. Both are rounded: the recording's
compression then finds equal neighbours, and the rounding is too fine to be visible.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from harness.record.base import RecordingInfo
from solvers.compiling import kept
from solvers.problem import Positions

Reals = NDArray[np.float64]

STRAIN_COLOURS = ("#125490", "#64a2d6", "#d9d7d2", "#e5863b", "#943404")
"""Colours at strains -range, -range/2, 0, range/2, range: blue compressed, grey at rest, orange stretched.

They are colour-blind safe, and the middle is grey enough for light and shadow to remain visible."""

PIN_COLOUR = "#c5299b"
"""Colour of pinned vertices in recordings and pictures: not on any strain scale, clear on light and on dark."""

STRAIN_RANGE = 0.1
"""End of the scale where a run states no strain range."""
LEAST_RANGE = 1e-3

LEVELS = 65
NORMAL_STEPS = 32
NEUTRAL = (128, 128, 128, 255)
"""Colour of a strain that is NaN."""


def palette() -> NDArray[np.uint8]:
    """Return the colours of the levels, most compressed first, then NEUTRAL: (LEVELS + 1, 4)."""
    stops = np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)] + [255] for colour in STRAIN_COLOURS])
    at = np.linspace(0, len(stops) - 1, LEVELS)
    channels: list[NDArray[np.float64]] = [np.interp(at, range(len(stops)), channel) for channel in stops.T]
    colours = np.stack(channels, axis=1)
    return np.vstack([np.rint(colours), NEUTRAL]).astype(np.uint8)


def strain_range(
    positions: Iterable[Positions], springs: NDArray[np.int64], rest_lengths: NDArray[np.float64]
) -> float:
    """Return the end of a scale that shows the strains at the given positions.

    Args:
      positions: vertex positions, each (n, 3) [m].
      springs: vertex pairs (m, 2).
      rest_lengths: rest lengths (m,) [m].

    Returns: the range of `scale_end` over all strains; STRAIN_RANGE without springs.
    """
    found = [strains(p, springs, rest_lengths)[1] for p in positions if len(rest_lengths)]
    return scale_end(np.concatenate(found)) if found else STRAIN_RANGE


def scale_end(strain: NDArray[np.float64]) -> float:
    """Return the end of a scale: the round number above 99 % of the strains.

    A few large strains at a pin thus do not leave all others grey. The result is STRAIN_RANGE where none is
    finite.
    """
    known = np.abs(strain[np.isfinite(strain)])
    if not len(known):
        return STRAIN_RANGE
    wanted = max(float(np.quantile(known, 0.99)), LEAST_RANGE)
    decade = 10.0 ** np.floor(np.log10(wanted) + 1e-9)
    return float(next(step * decade for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * decade >= 0.999 * wanted))


def percent(strain: float, digits: int = 3) -> str:
    """Format a strain with its sign as a percentage."""
    return f"{100 * strain:+.{digits}g} %".replace("-", "−")


def colours(strain: NDArray[np.float64], end: float) -> NDArray[np.uint32]:
    """Return the colours 0xRRGGBBAA (m,) of strains (m,) on the scale from -end to end."""
    with np.errstate(invalid="ignore"):
        level = np.rint((np.clip(strain / end, -1, 1) + 1) * (LEVELS - 1) / 2)
    return _packed()[np.where(np.isnan(level), LEVELS, level).astype(np.intp)]


@cache
def _packed() -> NDArray[np.uint32]:
    return palette().view(">u4").astype(np.uint32).ravel()


def widest(ends: tuple[float, float], strain: NDArray[np.float64]) -> tuple[float, float]:
    """Return the smallest and the largest of `ends` and the finite strains."""
    known = strain[np.isfinite(strain)]
    return float(known.min(initial=ends[0])), float(known.max(initial=ends[1]))


class Shading:
    """Strains, colours and normals of one run's mesh."""

    def __init__(self, info: RecordingInfo) -> None:
        self._range, self._triangles = info.strain_range, info.mesh.triangles
        self._springs, self._rest_lengths = info.springs, info.rest_lengths

    def strains(self, p: Positions) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the strains of springs (m,) and of vertices (n,).

        The strain of a vertex is the one of largest magnitude among its springs. It is 0 where a rest length is 0 or a
        vertex has no spring.
        """
        return strains(p, self._springs, self._rest_lengths)

    def colours(self, strain: NDArray[np.float64]) -> NDArray[np.uint32]:
        """Return the colour of each strain as 0xRRGGBBAA, shape (len(strain),)."""
        return colours(strain, self._range)

    def normals(self, p: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the unit vertex normals (n, 3), rounded to 1/32; zero where undefined."""
        normals = np.zeros(p.shape)  # areas of tiny or huge triangles leave the range of single precision
        _normals(p.astype(np.float64), self._triangles, normals)
        return normals.astype(np.float32)


def strains(
    p: Positions, springs: NDArray[np.int64], rest_lengths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the strains of springs and of vertices.

    Args:
      p: positions (n, 3) [m].
      springs: vertex pairs (m, 2).
      rest_lengths: rest lengths (m,) [m].

    Returns: strains of the springs (m,), and for each vertex (n,) the one of largest magnitude among its springs.
    """
    of_spring, of_vertex = np.empty(len(rest_lengths)), np.zeros(len(p))
    _strains(p.copy(), springs, rest_lengths, of_spring, of_vertex)
    return of_spring, of_vertex


# Positions are passed as writable copies: a read-only array is another type to Numba and causes another compilation.
# The kernels release the interpreter lock, so that a concurrent solver need not wait.
@kept(error_model="numpy", nogil=True)
def _strains(
    p: Positions,
    springs: NDArray[np.int64],
    rest_lengths: Reals,
    of_spring: Reals,
    of_vertex: Reals,
) -> None:
    for e in range(len(springs)):
        i, j = springs[e, 0], springs[e, 1]
        x, y, z = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        r = rest_lengths[e]
        strain = math.sqrt(x * x + y * y + z * z) / r - 1 if r > 0 else 0.0
        of_spring[e] = strain
        for v in (i, j):
            if abs(strain) > abs(of_vertex[v]) or math.isnan(strain):
                of_vertex[v] = strain


@kept(error_model="numpy", nogil=True)
def _normals(p: Reals, triangles: NDArray[np.int64], out: Reals) -> None:
    for t in range(len(triangles)):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
        bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
        for v in (i, j, k):
            out[v, 0] += ay * bz - az * by
            out[v, 1] += az * bx - ax * bz
            out[v, 2] += ax * by - ay * bx
    for v in range(len(out)):
        length = math.sqrt(out[v, 0] ** 2 + out[v, 1] ** 2 + out[v, 2] ** 2)
        for c in range(3):
            unit = out[v, c] / length
            out[v, c] = round(unit * NORMAL_STEPS) / NORMAL_STEPS if math.isfinite(unit) else 0.0
