"""Correctness first: whether two answers are the same, before anybody asks which came sooner."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

AGREEMENT = 1e-9
"""How far two answers may lie apart, in their own size: round-off of some hundred iterations in another order."""


def difference(new: ArrayLike, old: ArrayLike, tolerance: float = AGREEMENT) -> str:
    """How two answers, arrays of points (n, d) or of any other shape, differ, in words; empty where they agree.

    tolerance: as a part of the old answer's size, the largest extent along an axis; 0 wants the same numbers.
    """
    now, was = np.asarray(new, float), np.asarray(old, float)
    if now.shape != was.shape:
        return f"arrays of {now.shape} and {was.shape}"
    points = was.reshape(-1, was.shape[-1]) if was.ndim > 1 else was.reshape(-1, 1)
    size = float(np.ptp(points, axis=0).max(initial=0.0)) if points.size else 0.0
    size = size or float(np.abs(was).max(initial=0.0)) or 1.0
    apart = float(np.abs(now - was).max(initial=0.0)) / size
    if apart <= tolerance:  # NaN is not
        return ""
    return f"they lie {apart:.1e} of the answer's size apart, wanted {tolerance:g}"
