"""Notes on surfaces in a picture that may intersect themselves."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from springbench.harness.recording.recorder_interface import INTERSECTION_FREE_PROPERTY, RecordingReplay
from springbench.harness.scenes.edge_triangle_intersections import find_edge_triangle_intersections

_MAX_TRIANGLES = 50_000
"""Maximum number of triangles for which frames are tested for intersections, about 0.1 s each."""


def describe_self_intersection(replay: RecordingReplay, frames: Iterable[int]) -> list[str]:
    """Describe a surface simulated without self-contact, and whether it intersects itself in these frames.

    Args:
        replay: recording.
        frames: indices of the frames to test.

    Returns:
        At most one phrase; empty if self-contact was simulated or there is no surface.
    """
    if not len(replay.triangles) or replay.properties.get(INTERSECTION_FREE_PROPERTY, True):
        return []
    if len(replay.triangles) > _MAX_TRIANGLES:
        return ["no self-contact: may pass through itself"]
    t = replay.triangles
    sides = np.unique(np.sort(t[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    crossed = any(find_edge_triangle_intersections(replay.positions[k].astype(np.float64), sides, t) for k in frames)
    return ["no self-contact: passes through itself" if crossed else "no self-contact"]
