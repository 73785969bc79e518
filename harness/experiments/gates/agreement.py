"""Correctness check before timing: whether two answers agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

AGREEMENT = 1e-9
"""Default tolerance of the difference of two answers, relative to their size. It covers round-off of some hundred
iterations in another order.
"""


def difference(new: ArrayLike, old: ArrayLike, tolerance: float = AGREEMENT) -> str:
    """Describe the difference of two answers in words; empty if they agree.

    Args:
        new: points (n, d), or an array of any other shape.
        old: baseline of the same shape.
        tolerance: tolerance relative to the size of `old`, its largest extent along an axis; 0 requires equal numbers.
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
