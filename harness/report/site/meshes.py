"""Meshes for the results page, from recordings.

These are the last frame of each run, and the iterates of solves with a reference. Positions are in single precision
relative to the recording's origin: differences below 1e-7 of a scene's size are not resolved.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import SpringbenchError
from harness.record.base import Replay
from harness.record.local_origin import store_relative
from harness.report.accuracy.measured import Curve, Measurements
from harness.report.site import script
from harness.report.site.folders import Folder
from harness.report.site.viewer import write_recording

Say = Callable[[str], None]

KEPT = 25
"""Maximum number of iterates of a solve, evenly spaced over the recorded ones; a slider does not resolve more."""
_NEAR = 1e-6
"""Lower end of the distance scale, relative to the largest distance."""


def write_last(folder: Folder, home: Path, units: Sequence[str], say: Say) -> set[str]:
    """Write the last frames of these runs unless they are up to date.

    Args:
        folder: folder of the sweep's results.
        home: folder of the page's data of this sweep.
        units: units of rows, whose names are those of their recordings.
        say: prints a remark.
    Returns: the units with a script.
    """
    there: set[str] = set()
    for unit in units:
        recording, target = folder.path / "recordings" / f"{unit}.rrd", script.below(home / "meshes", unit)
        if not _fresh(target, recording):
            replay = _read(recording, [-1], say)
            if replay is None or not len(replay.frames):
                continue
            value = _shape(replay) | {"positions": _packed(replay.positions[-1], np.float32)}
            script.write(target, f"{folder.slug}/meshes/{unit}", value)
        there.add(unit)
    return there


def write_solves(folder: Folder, home: Path, table: Measurements, say: Say) -> dict[str, str]:
    """Write the iterates of all recorded solves.

    Args:
        folder: folder of the sweep's results.
        home: folder of the page's data of this sweep.
        table: data of an accuracy measurement.
        say: prints a remark.
    Returns: the names of the scripts by their recordings.
    """
    written: dict[str, str] = {}
    for problem in table.problems:
        recorded = [curve for curve in table.curves if curve.problem is problem and curve.recording]
        curves = [curve for curve in recorded if (folder.path / curve.recording).is_file()]
        ended = [curve for curve in curves if len(curve.largest) and np.isfinite(curve.largest[-1])]
        if ended:
            best = min(ended, key=lambda curve: curve.largest[-1])
            written |= _solves(folder, home, curves, best, say)
    return written


def write_recordings(folder: Folder, home: Path, recordings: Mapping[str, str]) -> dict[str, str]:
    """Write recordings with their titles as scripts unless they are up to date.

    Args:
        folder: folder of the sweep's results.
        home: folder of the page's data of this sweep.
        recordings: titles by path of the recording.
    Returns: the names of the scripts by their recordings.
    """
    there = {name: f"recordings/{Path(name).stem}" for name in recordings if (folder.path / name).is_file()}
    for name in there:
        write_recording(folder.path / name, script.below(home / "recordings", Path(name).stem), recordings[name])
    return there


def _solves(folder: Folder, home: Path, curves: Sequence[Curve], best: Curve, say: Say) -> dict[str, str]:
    """Write the solves of one snapshot.

    The last iterate of `best` is the reference of all.
    """
    truth = folder.path / best.recording
    targets = {curve.recording: script.below(home / "solves", Path(curve.recording).stem) for curve in curves}
    stale = [name for name, target in targets.items() if not _fresh(target, folder.path / name, truth)]
    last = _read(truth, [-1], say) if stale else None
    for name in stale:
        replay = _read(folder.path / name, None, say)
        if replay is None or last is None or not len(replay.frames):
            continue
        distance = script.number(float(best.largest[-1] * best.problem.mean_rest_length))
        reference = store_relative(last.absolute_positions(-1), replay.origin)
        told = {"of": best.label, "distance": distance, "positions": _packed(reference, np.float32)}
        value = _iterates(replay, reference) | {"reference": told}
        script.write(targets[name], f"{folder.slug}/solves/{targets[name].stem}", value)
    return {name: f"solves/{target.stem}" for name, target in targets.items() if target.exists()}


def _iterates(replay: Replay, reference: NDArray[np.float32]) -> dict[str, Any]:
    """Select some of a solve's iterates, with the limits of their distances [m].

    Distances are from the reference.
    """
    kept = np.unique(np.linspace(0, len(replay.frames) - 1, min(KEPT, len(replay.frames))).round().astype(int))
    farthest = float(np.linalg.norm(replay.positions[kept] - reference, axis=2).max()) or 1.0
    return _shape(replay) | {
        "iterations": replay.frames[kept].tolist(),
        "positions": _packed(replay.positions[kept], np.float32),
        "farthest": script.number(farthest),
        "nearest": script.number(_NEAR * farthest),
    }


def _shape(replay: Replay) -> dict[str, Any]:
    """Return the constant data of a mesh: triangles, springs, and the mean rest length [m]."""
    lengths = replay.rest_lengths
    return {
        "triangles": _packed(replay.triangles, np.uint32),
        "springs": _packed(replay.springs, np.uint32),
        "length": script.number(float(lengths.mean())) if lengths.any() else 1.0,
    }


def _packed(values: NDArray[Any], kind: type) -> str:
    """Encode the bytes of an array, little endian, in base64."""
    return b64encode(np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes()).decode()


def _fresh(made: Path, *sources: Path) -> bool:
    return made.exists() and all(source.stat().st_mtime_ns <= made.stat().st_mtime_ns for source in sources)


def _read(recording: Path, frames: list[int] | None, say: Say) -> Replay | None:
    """Read a recording; return None, after a remark, if it is damaged."""
    from harness.record.reader import read_replay  # brings Rerun along, which a page of what is there already needs not

    try:
        return read_replay(recording, frames)
    except SpringbenchError as error:
        say(f"not on the page: {error}")
        return None
