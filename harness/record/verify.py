"""A recording read back from its file, before its run counts as done: its last frame is the motion's end.

Colours are made once more, plainly, from the positions that the run ended at, so that neither another frame's positions
nor another frame's colours pass. They may be one level of the scale off, for the rounding of a strain between two.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from harness.base.errors import RunFailed
from harness.record.base import RecordingInfo
from harness.record.reader import cell, open_recording
from harness.record.shading import LEVELS, palette
from solvers.problem import Positions

ROUNDING = 1e-9
"""Strains that differ by less, one of them stretched and one compressed, may be taken in either order."""

_PARTS = (("Mesh3D:vertex_positions", "Mesh3D:vertex_colors"), ("Points3D:positions", "Points3D:colors"))


def require_last(path: Path, info: RecordingInfo, frame: int, time: float, p: Positions) -> str:
    """The SHA-256 of the positions in the recording's last frame, as its file has them (float32 bytes).

    Raises RunFailed unless that frame has this number, time [s], these positions (n, 3) [m], rounded to float32, and
    their colours; InputError where the file cannot be read.
    """
    last = _last(path)
    if last.frame != frame or not abs(last.time - time) <= 1e-6 * max(1.0, abs(time)):  # the file counts nanoseconds
        came = f"frame {last.frame} at {last.time:g} s" if last.frame >= 0 else "no frame"
        raise RunFailed(f"{path.name}: the recording ends with {came}, the run with frame {frame} at {time:g} s")
    with np.errstate(over="ignore"):
        expected = p.astype(np.float32)
    if last.positions.tobytes() != expected.tobytes():
        raise RunFailed(f"{path.name}: frame {frame} was recorded with other positions than the run ended at")
    if not _are_of(last.colours, info, p):
        raise RunFailed(f"{path.name}: frame {frame} was recorded with other colours than its strains have")
    return hashlib.sha256(last.positions.tobytes()).hexdigest()


class _Last(NamedTuple):
    """Number (-1 for none), time [s], positions (n, 3) [m] and colours (n,), as 0xRRGGBBAA, of the last frame."""

    frame: int
    time: float
    positions: NDArray[np.float32]
    colours: NDArray[np.uint32]


def _last(path: Path) -> _Last:
    found = _Last(-1, np.nan, np.empty((0, 3), np.float32), np.empty(0, np.uint32))
    with open_recording(path) as source:
        for positions, colours in _PARTS:
            for chunk in source.chunks(content="/scene/mesh", components=[positions, colours]):
                batch = chunk.to_record_batch()
                if not {positions, colours} <= set(batch.schema.names):
                    continue
                numbers, times = (batch[name].cast(pa.int64()).to_numpy() for name in ("frame", "time"))
                k = int(np.argmax(numbers))
                if numbers[k] > found.frame:
                    at, of = cell(batch, positions, k).reshape(-1, 3), cell(batch, colours, k)
                    found = _Last(int(numbers[k]), times[k] / 1e9, at, of)
    return found


def _are_of(colours: NDArray[np.uint32], info: RecordingInfo, p: Positions) -> bool:
    """Whether the vertices at p have the colours of the largest of their springs' strains."""
    rest, high, low = info.rest_lengths, np.zeros(len(p)), np.zeros(len(p))
    with np.errstate(all="ignore"):
        length = np.linalg.norm(np.diff(p[info.springs], axis=1)[:, 0], axis=1)
        strain = np.where(rest > 0.0, length / rest - 1.0, 0.0)
    for ends in info.springs.T:
        np.maximum.at(high, ends, strain)
        np.minimum.at(low, ends, strain)
    known = {int(colour): level for level, colour in enumerate(palette()[:LEVELS].view(">u4").ravel())}
    recorded = np.array([known.get(int(colour), -LEVELS) for colour in colours])

    def near(largest: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.bool_]:
        level = np.rint((np.clip(largest / info.strain_range, -1, 1) + 1) * (LEVELS - 1) / 2)
        return (np.abs(recorded - level) <= 1) & (np.abs(largest) >= (1.0 - ROUNDING) * np.abs(other))

    return bool((near(high, low) | near(low, high)).all())
