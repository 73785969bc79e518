"""Which vertices a camera frames: all, unless some have left the others far behind.

A runaway vertex or a part that nothing holds would make a dot of everything else. With the distance of each vertex from
the middle of those that moved least, at the start plus what it moved, the vertices are framed up to the first gap:

    reach_i = |p_i(0) - centre| + max_t |p_i(t) - p_i(0)|,    framed: reach_i <= r_k for the least k of at least
    SHARE n vertices with r_{k+1} > GAP max(r_k, half the diagonal of the start)

A connected mesh has no such gap, nor has one that moves as a whole.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

GAP = 4.0
"""The step in distance from which on vertices are left out: until then a quarter of the view shows the others."""
SHARE = 0.3
"""Of the vertices, framed at least: one of three layers that is held, the others having fallen."""


def framed_vertices(start: NDArray[np.floating], moved: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the vertices (n,) that a camera frames.

    Args:
      start: positions at the start (n, 3) [m], finite.
      moved: largest distance from there in the frames to be seen (n,) [m].
    """
    calm = moved <= np.median(moved)
    reach = np.linalg.norm(start - np.median(start[calm], axis=0), axis=1) + moved
    r = np.sort(reach)
    near = np.maximum(r[:-1], np.linalg.norm(np.ptp(start, axis=0)) / 2)
    least = math.ceil(SHARE * len(r))
    gaps = np.flatnonzero(r[1:] > GAP * near) + 1
    gaps = gaps[gaps >= least]
    return reach <= r[gaps[0] - 1] if len(gaps) else np.full(len(r), True)


def outside_words(framed: NDArray[np.bool_]) -> list[str]:
    """Say how many vertices are not framed; nothing where all are."""
    count = int((~framed).sum())
    verb = "is" if count == 1 else "are"
    return [f"{count:,} of {len(framed):,} vertices {verb} outside"] if count else []
