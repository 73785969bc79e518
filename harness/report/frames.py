"""Which frames of a recording can be drawn, and the scale of strain that shows what is in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from harness.record.base import Replay
from harness.report.render import vertex_strain

_BLOWN_UP = 1e4  # coordinates this many times larger than the start's are drawn as if not finite


def drawable_frames(replay: Replay) -> NDArray[np.int64]:
    """The recorded frames before the first that is not finite (or has blown up beyond drawing)."""
    start = replay.positions[0]
    limit = _BLOWN_UP * max(float(np.abs(start).max(initial=0.0)), 1.0)
    with np.errstate(invalid="ignore"):
        good = np.abs(replay.positions).max(axis=(1, 2), initial=0.0) <= limit  # not so for a NaN
    return np.arange(len(good) if good.all() else int(np.argmin(good)))


def shown_limit(replays: Sequence[Replay], frames: Sequence[int]) -> float:
    """The end of a scale that shows the strains of these frames, one of each recording: the round number above what
    99 % of the vertices have, so that a few at a pin do not leave all others grey."""
    strains = np.concatenate([np.abs(vertex_strain(r, k)) for r, k in zip(replays, frames, strict=True)])
    strains = strains[np.isfinite(strains)]
    wanted = max(float(np.quantile(strains, 0.99)) if len(strains) else 0.0, 1e-3)
    decade = 10.0 ** np.floor(np.log10(wanted) + 1e-9)
    return float(next(step * decade for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * decade >= 0.999 * wanted))
