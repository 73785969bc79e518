"""What a recording ends with is read back from its file and compared with where the run ended."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from harness.base.errors import InputError, RunFailed
from harness.record.rerun import RerunRecorder
from harness.record.verify import require_last
from tests.recordings import MESHES, info, record, waving

COUNT = 12
TIME = 0.01 * (COUNT - 1)


def ends(mesh: str = "cloth") -> np.ndarray:
    """The positions in the last frame."""
    return [*waving(info(mesh), COUNT)][-1].positions


@pytest.mark.parametrize("mesh", MESHES)
def test_a_recording_that_ends_as_the_run_did_passes(mesh: str, tmp_path: Path):
    p = ends(mesh)
    told = require_last(record(tmp_path / "a.rrd", info(mesh), COUNT), info(mesh), COUNT - 1, TIME, p)
    assert told == hashlib.sha256(p.astype(np.float32).tobytes()).hexdigest()


def test_a_mesh_without_springs_passes(tmp_path: Path):
    of = info(springs=np.empty((0, 2), np.int64), rest_lengths=np.empty(0))
    require_last(record(tmp_path / "a.rrd", of, COUNT), of, COUNT - 1, TIME, ends())


def moved(p: np.ndarray) -> np.ndarray:
    out = p.copy()
    out[7, 1] = np.nextafter(np.float32(out[7, 1]), np.float32(np.inf))
    return out


ENDS = {
    "another frame": (COUNT, TIME, lambda p: p, "ends with frame 11 at 0.11 s"),
    "another time": (COUNT - 1, TIME + 0.01, lambda p: p, "the run with frame 11 at 0.12 s"),
    "another last bit": (COUNT - 1, TIME, moved, "other positions"),
}


@pytest.mark.parametrize(("frame", "time", "change", "reason"), ENDS.values(), ids=ENDS)
def test_a_recording_that_ends_otherwise_is_refused(frame: int, time: float, change, reason: str, tmp_path: Path):
    with pytest.raises(RunFailed, match=reason):
        require_last(record(tmp_path / "a.rrd", count=COUNT), info(), frame, time, change(ends()))


def test_one_vertex_in_another_colour_is_refused(tmp_path: Path):
    of = info()
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    colours = recorder._shading.colours
    recorder._shading.colours = lambda strain: np.where(np.arange(len(strain)) == 3, 0xD9D7D2FF, colours(strain))
    for frame in waving(of, COUNT):
        recorder.frame(frame)
    with pytest.raises(RunFailed, match="other colours"):
        require_last(recorder.close({}), of, COUNT - 1, TIME, ends())


def test_a_recording_without_frames_and_a_file_that_is_none_are_refused(tmp_path: Path):
    with pytest.raises(RunFailed, match="ends with no frame"):
        require_last(RerunRecorder(tmp_path / "a.rrd", info()).close({}), info(), 1, 0.01, ends())
    (tmp_path / "b.rrd").write_bytes(b"")
    with pytest.raises(InputError, match="not a Rerun recording"):
        require_last(tmp_path / "b.rrd", replace(info()), 1, 0.01, ends())
