"""Selection of the vertices that a camera frames: all but those far from the others.

A runaway vertex or an unsupported part would reduce the rest of the mesh to a dot. The radius of a vertex is its
initial distance from the centre of the vertices that moved least, plus its displacement. Vertices are framed up to the
first gap in the sorted radii:

    reach_i = |p_i(0) - centre| + max_t |p_i(t) - p_i(0)|,    framed: reach_i <= r_k for the least k of at least
    MIN_FRAMED_SHARE n vertices with r_{k+1} > GAP_FACTOR max(r_k, half the diagonal of the initial positions)

A connected mesh has no such gap, and neither has one that moves as a whole.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

GAP_FACTOR = 4.0
"""Minimum ratio of radii at a gap: below it, the other vertices still fill a quarter of the view."""
MIN_FRAMED_SHARE = 0.3
"""Minimum fraction of framed vertices: one of three layers that is supported while the others have fallen."""


def find_framed_vertices(start: NDArray[np.floating], moved: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the vertices that a camera frames.

    Args:
        start: initial positions (n, 3) [m], finite.
        moved: largest displacement from `start` over the frames shown (n,) [m].
    """
    calm = moved <= np.median(moved)
    reach = np.linalg.norm(start - np.median(start[calm], axis=0), axis=1) + moved
    r = np.sort(reach)
    near = np.maximum(r[:-1], np.linalg.norm(np.ptp(start, axis=0)) / 2)
    least = math.ceil(MIN_FRAMED_SHARE * len(r))
    gaps = np.flatnonzero(r[1:] > GAP_FACTOR * near) + 1
    gaps = gaps[gaps >= least]
    return reach <= r[gaps[0] - 1] if len(gaps) else np.full(len(r), True)


def describe_outside(framed: NDArray[np.bool_]) -> list[str]:
    """Return a description of how many vertices are not framed; empty where all are."""
    count = int((~framed).sum())
    verb = "is" if count == 1 else "are"
    return [f"{count:,} of {len(framed):,} vertices {verb} outside"] if count else []
