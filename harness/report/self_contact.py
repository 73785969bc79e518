"""Notes on surfaces in a picture that may intersect themselves."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from harness.record.base import SELF_CONTACT, Replay
from harness.scenes.intersections import crossings

_LARGEST = 50_000
"""Maximum number of triangles for which frames are tested for intersections, about 0.1 s each."""


def self_contact_words(replay: Replay, frames: Iterable[int]) -> list[str]:
    """Describe a surface simulated without self-contact, and whether it intersects itself in these frames.

    Args:
        replay: recording.
        frames: indices of the frames to test.
    Returns: at most one phrase; empty if self-contact was simulated or there is no surface.
    """
    if not len(replay.triangles) or replay.properties.get(SELF_CONTACT, True):
        return []
    if len(replay.triangles) > _LARGEST:
        return ["no self-contact: may pass through itself"]
    t = replay.triangles
    sides = np.unique(np.sort(t[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    crossed = any(crossings(replay.positions[k].astype(np.float64), sides, t) for k in frames)
    return ["no self-contact: passes through itself" if crossed else "no self-contact"]
