"""Selection of drawable frames of a recording, and their strain scale."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from harness.base import quantities
from harness.record.base import Replay
from harness.record.shading import scale_end
from harness.report.render import spacing, spring_strain, vertex_strain

_BLOWN_UP = 1e4  # coordinates this many times larger than the start's are drawn as if not finite


def drawable_frames(replay: Replay) -> NDArray[np.int64]:
    """Return the indices of the frames that can be drawn.

    These are the recorded frames before the first that is not finite or has blown up.
    """
    start = replay.positions[0]
    limit = _BLOWN_UP * (max(float(np.abs(start).max(initial=0.0)), spacing(replay)) or 1.0)
    with np.errstate(invalid="ignore"):
        good = np.abs(replay.positions).max(axis=(1, 2), initial=0.0) <= limit  # not so for a NaN
    return np.arange(len(good) if good.all() else int(np.argmin(good)))


def shown_limit(replays: Sequence[Replay], frames: Sequence[int]) -> float:
    """Return the end of a colour scale for the strains of these frames, see `scale_end`.

    Args:
        replays: recordings.
        frames: one frame index per recording.
    """
    return scale_end(np.concatenate([vertex_strain(r, k) for r, k in zip(replays, frames, strict=True)]))


def largest_strain(replay: Replay) -> float:
    """Return the largest strain of the run as its rows state it.

    The result is NaN if no frame after the start was recorded.
    """
    if "/strain/largest" in replay.scalars:
        return quantities.largest_strain(*replay.scalars["/strain/largest"])
    strains = [np.abs(spring_strain(replay, k)).max(initial=0.0) for k in range(len(replay.frames))]
    return quantities.largest_strain(replay.frames, np.array(strains))


def strain_ends(replays: Sequence[Replay]) -> tuple[float, float]:
    """Return the smallest and the largest spring strain over all drawable frames after the start.

    An end is 0 where there is no strain below or above zero. The end of larger magnitude is the run's largest strain.
    """
    low = high = 0.0
    for replay in replays:
        shown = [int(k) for k in drawable_frames(replay) if replay.frames[k] > 0]
        strain = np.concatenate([spring_strain(replay, k) for k in shown] or [np.zeros(0)])
        known = strain[np.isfinite(strain)]
        ends = float(known.min(initial=0.0)), float(known.max(initial=0.0))
        if len(shown) == (replay.frames > 0).sum() and np.isfinite(largest := largest_strain(replay)):
            ends = (ends[0], largest) if ends[1] >= -ends[0] else (-largest, ends[1])  # not rounded to single precision
        low, high = min(low, ends[0]), max(high, ends[1])
    return low, high
