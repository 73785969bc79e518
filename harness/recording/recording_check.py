"""Check of a recording file: the last frame and a few random frames.

Recorded positions must be those of the run, rounded to single precision relative to the recording's origin. The
rounding is bounded by the mesh size, wherever the mesh is: an origin that does not resolve the mesh is an error.

Colours are recomputed by separate, simple code from the positions of the run, so that positions or colours of another
frame are detected. They may differ by one level of the scale, since a strain between two levels may be rounded to
either.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from springbench.harness.errors import RunFailed
from springbench.harness.recording.local_origin import MIN_DIAGONALS_PER_CELL, read_origin, store_relative
from springbench.harness.recording.recorder_interface import RecordingInfo
from springbench.harness.recording.recording_reader import open_recording_source, read_cell, read_properties
from springbench.harness.recording.strain_scale import NUM_LEVELS, build_palette
from springbench.solvers.model.step_problem import Positions

ROUNDING_RTOL = 1e-9
"""Relative difference of magnitude below which a stretched and a compressed strain count as equally large."""

_FLOAT32_ROUNDOFF = 2.0**-24
"""Relative round-off of single precision."""

_POSITION_COMPONENTS = (("Mesh3D:vertex_positions", "Mesh3D:vertex_colors"), ("Points3D:positions", "Points3D:colors"))


def require_recorded_frames(
    path: Path, info: RecordingInfo, times: Mapping[int, float], run: Mapping[int, Positions]
) -> str:
    """Check some frames of a recording against the run.

    Args:
        path: path of the recording.
        info: properties of the recording.
        times: time [s] of each checked frame.
        run: positions (n, 3) [m] of each checked frame; the last of them is the run's last frame.

    Returns:
        SHA-256 of the positions in the recording's last frame, as stored (float32 bytes).

    Raises:
        RunFailed: the recording does not end with that frame, or times, positions or colours of a frame differ.
        InputError: the file cannot be read.
    """
    last = max(run)
    origin, end, found = _read_frames(path, run)
    if end != last or last not in found:
        last_frame = f"frame {end}" if end >= 0 else "no frame"
        raise RunFailed(f"{path.name}: the recording ends with {last_frame}, the run with frame {last}")
    for frame, p in run.items():
        if frame not in found:
            raise RunFailed(f"{path.name}: frame {frame} was not recorded")
        recorded, time = found[frame], times[frame]
        if not abs(recorded.time - time) <= 1e-6 * max(1.0, abs(time)):  # the file counts nanoseconds
            raise RunFailed(f"{path.name}: frame {frame} was recorded at {recorded.time:g} s, it is at {time:g} s")
        if recorded.positions.tobytes() != store_relative(p, origin).tobytes():
            raise RunFailed(f"{path.name}: frame {frame} was recorded with other positions than the run had")
        coarse = _measure_excess_error(recorded.positions, origin, info, p)
        if coarse:
            raise RunFailed(f"{path.name}: frame {frame} was recorded with positions rounded by {coarse:.2g} m")
        if not _has_strain_colours(recorded.colours, info, p):
            raise RunFailed(f"{path.name}: frame {frame} was recorded with other colours than its strains have")
    return hashlib.sha256(found[last].positions.tobytes()).hexdigest()


class _ReadFrame(NamedTuple):
    """A recorded frame.

    Attributes:
        time: time [s].
        positions: positions (n, 3) [m] relative to the origin.
        colours: colours (n,) as 0xRRGGBBAA.
    """

    time: float
    positions: NDArray[np.float32]
    colours: NDArray[np.uint32]


def _read_frames(path: Path, expected: Collection[int]) -> tuple[NDArray[np.float64], int, dict[int, _ReadFrame]]:
    """Read the origin, the last frame's number (-1 for none), and the selected frames."""
    end, found = -1, dict[int, _ReadFrame]()
    with open_recording_source(path) as source:
        origin = read_origin(read_properties(source)[1])
        for positions, colours in _POSITION_COMPONENTS:
            for chunk in source.iterate_chunks(content="/scene/mesh", components=[positions, colours]):
                batch = chunk.to_record_batch()
                if not {positions, colours} <= set(batch.schema.names):
                    continue
                numbers, times = (batch[name].cast(pa.int64()).to_numpy() for name in ("frame", "time"))
                end = max(end, int(numbers.max()))
                for k in np.flatnonzero(np.isin(numbers, [*expected])).tolist():
                    p, of = read_cell(batch, positions, k).reshape(-1, 3), read_cell(batch, colours, k)
                    found[int(numbers[k])] = _ReadFrame(times[k] / 1e9, p.copy(), of.copy())
    return origin, end, found


def _measure_excess_error(
    recorded: NDArray[np.float32], origin: NDArray[np.float64], info: RecordingInfo, p: Positions
) -> float:
    """Return the largest error [m] in excess of single-precision rounding, or 0.

    Allowed is the round-off of the distance from the centre of the mesh at rest, and of the largest cell of an origin.
    """
    rest = info.mesh.rest_positions
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(recorded + origin - p)
        reach = np.abs(p - (rest.min(axis=0) / 2 + rest.max(axis=0) / 2)) + 2 * MIN_DIAGONALS_PER_CELL * (
            info.mesh.bounding_box_diagonal or 1.0
        )
        beyond = error > _FLOAT32_ROUNDOFF * reach + np.spacing(np.abs(p))  # the origin is added in double precision
    return float(error[beyond].max(initial=0.0))


def _has_strain_colours(colours: NDArray[np.uint32], info: RecordingInfo, p: Positions) -> bool:
    """Return whether the vertices at p have the colours of their largest strains."""
    rest, high, low = info.rest_lengths, np.zeros(len(p)), np.zeros(len(p))
    with np.errstate(all="ignore"):
        length = np.linalg.norm(np.diff(p[info.springs], axis=1)[:, 0], axis=1)
        strain = np.where(rest > 0.0, length / rest - 1.0, 0.0)
    for ends in info.springs.T:
        np.maximum.at(high, ends, strain)
        np.minimum.at(low, ends, strain)
    known = {int(colour): level for level, colour in enumerate(build_palette()[:NUM_LEVELS].view(">u4").ravel())}
    recorded = np.array([known.get(int(colour), -NUM_LEVELS) for colour in colours])

    def is_near(largest: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.bool_]:
        level = np.rint((np.clip(largest / info.strain_range, -1, 1) + 1) * (NUM_LEVELS - 1) / 2)
        return (np.abs(recorded - level) <= 1) & (np.abs(largest) >= (1.0 - ROUNDING_RTOL) * np.abs(other))

    return bool((is_near(high, low) | is_near(low, high)).all())
