"""Recordings of runs that were killed or ran out of disk, files that were cut, and files that are no recordings."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.recording.recording_reader import read_replay, summarise_recording
from springbench.harness.recording.rerun_recorder import FLUSH_INTERVAL

from tests.synthetic_recordings import build_recording_info, generate_waves, write_foreign_recording, write_recording

RECORD = """
import os, resource, signal, sys
from pathlib import Path
from springbench.harness.recording.rerun_recorder import RerunRecorder
from tests.synthetic_recordings import build_recording_info, generate_waves
recorder = RerunRecorder(Path(sys.argv[1]), build_recording_info())
{before}
try:
    for frame in generate_waves(build_recording_info(), 33):
        recorder.record_frame(frame)
    {after}
finally:
    recorder.abandon_recording()
"""
KILLED_PROGRAM = RECORD.format(before="", after="os.kill(os.getpid(), signal.SIGKILL)")
FULL = RECORD.format(
    before="signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16))",
    after="recorder.finish_recording({})",
)

THREADS = """
import os, sys
from pathlib import Path
from tests.synthetic_recordings import write_recording
for _ in range(4):
    write_recording(Path(sys.argv[1]), frame_count=2)
    print(len(os.listdir("/proc/self/task")))
"""


def run(code: str, path: Path) -> subprocess.CompletedProcess[str]:
    """Run Python code in a process of its own, in the repository."""
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", code, path]
    # The limit turns waiting for ever, for a writer that has died, into a failure; a healthy run takes a second.
    return subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=120)


def test_a_full_disk_is_a_failure_and_not_a_damaged_file(tmp_path: Path):
    result = run(FULL, tmp_path / "a.rrd")
    assert "WriteError" in result.stderr
    assert "cannot be written" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_many_recordings_leave_no_threads_behind(tmp_path: Path):
    result = run(THREADS, tmp_path / "a.rrd")
    one, *more = map(int, result.stdout.split())  # those of a recording are there until the next one begins
    assert more == [one] * 3, result.stderr


def test_a_killed_run_leaves_all_frames_up_to_the_last_flush(tmp_path: Path):
    result = run(KILLED_PROGRAM, tmp_path / "a.rrd")
    assert result.returncode == -signal.SIGKILL, result.stderr
    (left,) = tmp_path.iterdir()
    assert left.name != "a.rrd"
    found, replay = summarise_recording(left), read_replay(left)
    assert not found.is_complete
    assert len(replay.frames) > 33 - FLUSH_INTERVAL
    expected = [
        frame.positions.astype(np.float32) for frame in generate_waves(build_recording_info(), len(replay.frames))
    ]
    np.testing.assert_array_equal(replay.positions, expected)
    assert len(replay.scalars["/max_strain"][0]) == len(replay.frames)


@pytest.mark.parametrize("share", [0.5, 0.8, 0.99])
def test_a_file_that_was_cut_is_read_up_to_the_cut(share: float, tmp_path: Path):
    path = write_recording(tmp_path / "a.rrd", frame_count=60)
    whole = read_replay(path)
    os.truncate(path, int(share * path.stat().st_size))
    replay, found = read_replay(path), summarise_recording(path)
    assert not found.is_complete
    assert 0 < len(replay.frames) <= 60
    np.testing.assert_array_equal(replay.positions, whole.positions[: len(replay.frames)])
    assert [file.name for file in tmp_path.iterdir()] == ["a.rrd"]


STRANGERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "no such file"),
    "folder": (lambda path: path.mkdir(), "no such file"),
    "empty": (lambda path: path.write_bytes(b""), "is empty"),
    "text": (lambda path: path.write_text("frame,x,y\\n0,1,2\\n"), "is not a Rerun recording"),
    "noise": (lambda path: path.write_bytes(bytes(range(256)) * 9), "is not a Rerun recording"),
    "head": (lambda path: path.write_bytes(b"RRF2"), "Rerun recording"),
    "garbage": (lambda path: path.write_bytes(b"RRF2" + bytes(range(256)) * 9), "Rerun recording|can be read"),
    "foreign": (write_foreign_recording, "not of one run"),
}


@pytest.mark.parametrize("name", STRANGERS)
def test_what_is_no_recording_is_refused_by_name(name: str, tmp_path: Path):
    make, message = STRANGERS[name]
    path = tmp_path / "a.rrd"
    make(path)
    with pytest.raises(InputError, match=message) as refused:
        read_replay(path)
    assert refused.value.mistakes[0].file == path
