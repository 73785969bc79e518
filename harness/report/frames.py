"""Which frames of a recording can be drawn, and the scale of strain that shows what is in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from harness.record.base import Replay
from harness.record.shading import scale_end
from harness.report.render import spacing, spring_strain, vertex_strain

_BLOWN_UP = 1e4  # coordinates this many times larger than the start's are drawn as if not finite


def drawable_frames(replay: Replay) -> NDArray[np.int64]:
    """The recorded frames before the first that is not finite (or has blown up beyond drawing)."""
    start = replay.positions[0]
    limit = _BLOWN_UP * (max(float(np.abs(start).max(initial=0.0)), spacing(replay)) or 1.0)
    with np.errstate(invalid="ignore"):
        good = np.abs(replay.positions).max(axis=(1, 2), initial=0.0) <= limit  # not so for a NaN
    return np.arange(len(good) if good.all() else int(np.argmin(good)))


def shown_limit(replays: Sequence[Replay], frames: Sequence[int]) -> float:
    """The end of a scale that shows the strains of these frames, one of each recording (`scale_end`)."""
    return scale_end(np.concatenate([vertex_strain(r, k) for r, k in zip(replays, frames, strict=True)]))


def shown_ends(replays: Sequence[Replay], frames: Sequence[int]) -> tuple[float, float]:
    """The smallest and the largest strain of a spring in these frames; 0 where there is none below, or above."""
    strain = np.concatenate([spring_strain(r, k) for r, k in zip(replays, frames, strict=True)] or [np.zeros(0)])
    known = strain[np.isfinite(strain)]
    return float(known.min(initial=0.0)), float(known.max(initial=0.0))
