"""Strain of recorded frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.harness.recording.recorder_interface import RecordingReplay


def compute_spring_strain(replay: RecordingReplay, frame: int) -> NDArray[np.float64]:
    """Compute the strain, length / rest length - 1, of each spring.

    Args:
        replay: recording.
        frame: index among the recorded frames.

    Returns:
        Strains (m,); 0 where the rest length is 0.
    """
    i, j = replay.springs.T
    p = replay.positions[frame].astype(np.float64)
    rest = replay.rest_lengths
    stretch = np.linalg.norm(p[i] - p[j], axis=1) - rest
    return np.divide(stretch, rest, out=np.zeros(len(rest)), where=rest > 0)


def compute_vertex_strain(replay: RecordingReplay, frame: int) -> NDArray[np.float64]:
    """Return the signed strain of the most strained spring at each vertex, shape (n,).

    Args:
        replay: recording with springs and their rest lengths.
        frame: index of a recorded frame.

    Returns:
        The strains; 0 at vertices without a spring.
    """
    strain = np.repeat(compute_spring_strain(replay, frame), 2)
    ends = replay.springs.ravel()
    by_size = np.argsort(np.abs(strain))
    out = np.zeros(replay.positions.shape[1])
    out[ends[by_size]] = strain[by_size]  # the last write to a vertex, its largest strain, stays
    return out


def mean_rest_length(replay: RecordingReplay) -> float:
    """Return the mean rest length [m], or 1 if there are no springs."""
    return float(replay.rest_lengths.mean()) if len(replay.rest_lengths) else 1.0
