"""Selection of drawable frames and framed vertices of recordings, and their strain scale."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from springbench.harness.recording.camera_framing import find_framed_vertices
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.recording.strain_scale import round_scale_end
from springbench.harness.report.recorded_strain import compute_spring_strain, compute_vertex_strain, mean_rest_length
from springbench.harness.results import quantities

_MAX_DRAWABLE_EXTENT = 1e4  # coordinates this many times larger than the start's count as non-finite


def find_drawable_frames(replay: RecordingReplay) -> NDArray[np.int64]:
    """Return the indices of the frames that can be drawn.

    These are the recorded frames before the first that is not finite or has blown up.
    """
    start = replay.positions[0]
    limit = _MAX_DRAWABLE_EXTENT * (max(float(np.abs(start).max(initial=0.0)), mean_rest_length(replay)) or 1.0)
    with np.errstate(invalid="ignore"):
        good = np.abs(replay.positions).max(axis=(1, 2), initial=0.0) <= limit  # False for a NaN
    return np.arange(len(good) if good.all() else int(np.argmin(good)))


def framed_vertex_mask(replay: RecordingReplay, frames: Iterable[int]) -> NDArray[np.bool_]:
    """Return the mask (n,) of the vertices that a camera frames in recorded frames.

    Args:
        replay: recording, whose first frame is the start.
        frames: indices of recorded frames, at least one; the largest displacement over them counts.
    """
    start = replay.positions[0].astype(np.float64)
    moved = [np.linalg.norm(replay.positions[k] - start, axis=1) for k in frames]
    return find_framed_vertices(start, np.max(moved, axis=0))


def strain_scale_limit(replays: Sequence[RecordingReplay], frames: Sequence[int]) -> float:
    """Return the end of a colour scale for the strains of these frames.

    It is a round number above 99 % of them. A spring to a vertex that the camera does not frame is left out: it would
    leave all others grey.

    Args:
        replays: recordings.
        frames: one frame index per recording.
    """
    return round_scale_end(np.concatenate([_framed_strain(r, k) for r, k in zip(replays, frames, strict=True)]))


def _framed_strain(replay: RecordingReplay, frame: int) -> NDArray[np.float64]:
    near = framed_vertex_mask(replay, [frame])
    framed = near[replay.springs].all(axis=1)
    part = replace(replay, springs=replay.springs[framed], rest_lengths=replay.rest_lengths[framed])
    return compute_vertex_strain(part, frame)[near]


def max_recorded_strain(replay: RecordingReplay) -> float:
    """Return the largest strain of the run as its rows state it.

    The result is NaN if no frame after the start was recorded.
    """
    if "/max_strain" in replay.scalars:
        return quantities.compute_max_strain(*replay.scalars["/max_strain"])
    strains = [np.abs(compute_spring_strain(replay, k)).max(initial=0.0) for k in range(len(replay.frames))]
    return quantities.compute_max_strain(replay.frames, np.array(strains))


def strain_extremes(replays: Sequence[RecordingReplay]) -> tuple[float, float]:
    """Return the smallest and the largest spring strain over all drawable frames after the start.

    An end is 0 where there is no strain below or above zero. The end of larger magnitude is the run's largest strain.
    """
    low = high = 0.0
    for replay in replays:
        shown = [int(k) for k in find_drawable_frames(replay) if replay.frames[k] > 0]
        strain = np.concatenate([compute_spring_strain(replay, k) for k in shown] or [np.zeros(0)])
        known = strain[np.isfinite(strain)]
        ends = float(known.min(initial=0.0)), float(known.max(initial=0.0))
        if len(shown) == (replay.frames > 0).sum() and np.isfinite(largest := max_recorded_strain(replay)):
            ends = (ends[0], largest) if ends[1] >= -ends[0] else (-largest, ends[1])  # not rounded to single precision
        low, high = min(low, ends[0]), max(high, ends[1])
    return low, high
