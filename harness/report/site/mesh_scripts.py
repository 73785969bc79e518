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
from springbench.harness.errors import SpringbenchError
from springbench.harness.recording.local_origin import store_relative
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, ConvergenceCurve
from springbench.harness.report.site import data_scripts
from springbench.harness.report.site.rerun_viewer import write_recording
from springbench.harness.report.site.sweep_folders import SweepFolder

PrintMessage = Callable[[str], None]

MAX_ITERATES = 25
"""Maximum number of iterates of a solve, evenly spaced over the recorded ones; a slider does not resolve more."""
_MIN_DISTANCE_RATIO = 1e-6
"""Lower end of the distance scale, relative to the largest distance."""


def write_last_frames(
    folder: SweepFolder, data_folder: Path, units: Sequence[str], print_message: PrintMessage
) -> set[str]:
    """Write the last frames of these runs unless they are up to date.

    Args:
        folder: folder of the sweep's results.
        data_folder: folder of the page's data of this sweep.
        units: units of rows, whose names are those of their recordings.
        print_message: prints a remark.

    Returns:
        The units with a script.
    """
    there: set[str] = set()
    for unit in units:
        recording, target = (
            folder.path / "recordings" / f"{unit}.rrd",
            data_scripts.script_path(data_folder / "meshes", unit),
        )
        if data_scripts.is_script_outdated(target, [recording]):
            replay = _read_recording(recording, [-1], print_message)
            if replay is None or not len(replay.frames):
                continue
            value = _mesh_topology(replay) | {"positions": _encode_array(replay.positions[-1], np.float32)}
            data_scripts.write_script(target, f"{folder.slug}/meshes/{unit}", value)
        there.add(unit)
    return there


def write_solves(
    folder: SweepFolder, data_folder: Path, table: AccuracyData, print_message: PrintMessage
) -> dict[str, str]:
    """Write the iterates of all recorded solves.

    Args:
        folder: folder of the sweep's results.
        data_folder: folder of the page's data of this sweep.
        table: data of an accuracy measurement.
        print_message: prints a remark.

    Returns:
        The names of the scripts by their recordings.
    """
    written: dict[str, str] = {}
    for problem in table.problems:
        recorded = [curve for curve in table.curves if curve.problem is problem and curve.recording_path]
        curves = [curve for curve in recorded if (folder.path / curve.recording_path).is_file()]
        ended = [curve for curve in curves if len(curve.max_vertex_error) and np.isfinite(curve.max_vertex_error[-1])]
        if ended:
            best = min(ended, key=lambda curve: curve.max_vertex_error[-1])
            written |= _write_snapshot_solves(folder, data_folder, curves, best, print_message)
    return written


def write_recordings(folder: SweepFolder, data_folder: Path, recordings: Mapping[str, str]) -> dict[str, str]:
    """Write recordings with their titles as scripts unless they are up to date.

    Args:
        folder: folder of the sweep's results.
        data_folder: folder of the page's data of this sweep.
        recordings: titles by path of the recording.

    Returns:
        The names of the scripts by their recordings.
    """
    there = {name: f"recordings/{Path(name).stem}" for name in recordings if (folder.path / name).is_file()}
    for name in there:
        write_recording(
            folder.path / name, data_scripts.script_path(data_folder / "recordings", Path(name).stem), recordings[name]
        )
    return there


def _write_snapshot_solves(
    folder: SweepFolder,
    data_folder: Path,
    curves: Sequence[ConvergenceCurve],
    best: ConvergenceCurve,
    print_message: PrintMessage,
) -> dict[str, str]:
    """Write the solves of one snapshot.

    The last iterate of `best` is the reference of all.
    """
    truth = folder.path / best.recording_path
    targets = {
        curve.recording_path: data_scripts.script_path(data_folder / "solves", Path(curve.recording_path).stem)
        for curve in curves
    }
    stale = [
        name for name, target in targets.items() if data_scripts.is_script_outdated(target, [folder.path / name, truth])
    ]
    last = _read_recording(truth, [-1], print_message) if stale else None
    for name in stale:
        replay = _read_recording(folder.path / name, None, print_message)
        if replay is None or last is None or not len(replay.frames):
            continue
        distance = data_scripts.round_number(float(best.max_vertex_error[-1] * best.problem.mean_rest_length))
        reference = store_relative(last.absolute_positions(-1), replay.origin)
        document = {
            "reference_label": best.label,
            "distance": distance,
            "positions": _encode_array(reference, np.float32),
        }
        value = _select_iterates(replay, reference) | {"reference": document}
        data_scripts.write_script(targets[name], f"{folder.slug}/solves/{targets[name].stem}", value)
    return {name: f"solves/{target.stem}" for name, target in targets.items() if target.exists()}


def _select_iterates(replay: RecordingReplay, reference: NDArray[np.float32]) -> dict[str, Any]:
    """Select iterates of a solve, with the limits of a scale of their distances [m].

    Distances are from the reference. One distance in a hundred is beyond the scale, and so are non-finite ones. The
    scale thus resolves the convergence even if some iterates diverge.
    """
    selected = np.unique(
        np.linspace(0, len(replay.frames) - 1, min(MAX_ITERATES, len(replay.frames))).round().astype(int)
    )
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(replay.positions[selected].astype(np.float64) - reference, axis=2)
    known = distance[np.isfinite(distance)]
    farthest = (float(np.quantile(known, 0.99)) if len(known) else 0.0) or 1.0
    return _mesh_topology(replay) | {
        "iterations": replay.frames[selected].tolist(),
        "positions": _encode_array(replay.positions[selected], np.float32),
        "max_distance": data_scripts.round_number(farthest),
        "min_distance": data_scripts.round_number(_MIN_DISTANCE_RATIO * farthest),
    }


def _mesh_topology(replay: RecordingReplay) -> dict[str, Any]:
    """Return the constant data of a mesh: triangles, springs, and the mean rest length [m]."""
    lengths = replay.rest_lengths
    return {
        "triangles": _encode_array(replay.triangles, np.uint32),
        "springs": _encode_array(replay.springs, np.uint32),
        "mean_rest_length": data_scripts.round_number(float(lengths.mean())) if lengths.any() else 1.0,
    }


def _encode_array(values: NDArray[Any], kind: type) -> str:
    """Encode the bytes of an array, little endian, in base64."""
    return b64encode(np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes()).decode()


def _read_recording(recording: Path, frames: list[int] | None, print_message: PrintMessage) -> RecordingReplay | None:
    """Read a recording; return None, after a remark, if it is damaged."""
    from springbench.harness.recording.recording_reader import (
        read_replay,  # imports Rerun, which is not needed if all scripts are up to date
    )

    try:
        return read_replay(recording, frames)
    except SpringbenchError as error:
        print_message(f"not on the page: {error}")
        return None
