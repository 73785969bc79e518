"""Frames of a recording are read back from its file and compared with the run: the last one and some random ones."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.recording import rerun_recorder
from springbench.harness.recording.local_origin import compute_local_origin
from springbench.harness.recording.recorder_interface import FrameSamples, RecordedFrame, RecordingInfo
from springbench.harness.recording.recording_check import require_recorded_frames
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.recording.rerun_recorder import RerunRecorder

from tests.synthetic_recordings import MESHES_BY_KIND, build_recording_info, generate_waves, write_recording

COUNT = 12
TIME = 0.01 * (COUNT - 1)


def ends(mesh: str = "cloth") -> np.ndarray:
    """The positions in the last frame."""
    return [*generate_waves(build_recording_info(mesh), COUNT)][-1].positions


def require_last(path: Path, of: RecordingInfo, frame: int, time: float, p: np.ndarray) -> str:
    return require_recorded_frames(path, of, {frame: time}, {frame: p})


@pytest.mark.parametrize("mesh", MESHES_BY_KIND)
def test_a_recording_that_ends_as_the_run_did_passes(mesh: str, tmp_path: Path):
    p = ends(mesh)
    message = require_last(
        write_recording(tmp_path / "a.rrd", build_recording_info(mesh), COUNT),
        build_recording_info(mesh),
        COUNT - 1,
        TIME,
        p,
    )
    assert message == hashlib.sha256(p.astype(np.float32).tobytes()).hexdigest()


def test_a_mesh_without_springs_passes(tmp_path: Path):
    of = build_recording_info(springs=np.empty((0, 2), np.int64), rest_lengths=np.empty(0))
    require_last(write_recording(tmp_path / "a.rrd", of, COUNT), of, COUNT - 1, TIME, ends())


def displace_positions(p: np.ndarray) -> np.ndarray:
    out = p.copy()
    out[7, 1] = np.nextafter(np.float32(out[7, 1]), np.float32(np.inf))
    return out


ENDS = {
    "another frame": (COUNT, TIME, lambda p: p, "ends with frame 11, the run with frame 12"),
    "another time": (COUNT - 1, TIME + 0.01, lambda p: p, "frame 11 was recorded at 0.11 s, it is at 0.12 s"),
    "another last bit": (COUNT - 1, TIME, displace_positions, "other positions"),
}


@pytest.mark.parametrize(("frame", "time", "change", "reason"), ENDS.values(), ids=ENDS)
def test_a_recording_that_ends_otherwise_is_refused(frame: int, time: float, change, reason: str, tmp_path: Path):
    with pytest.raises(RunFailed, match=reason):
        require_last(
            write_recording(tmp_path / "a.rrd", frame_count=COUNT), build_recording_info(), frame, time, change(ends())
        )


def test_one_vertex_in_another_colour_is_refused(tmp_path: Path):
    of = build_recording_info()
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    colours = recorder._shading.compute_colours
    recorder._shading.compute_colours = lambda strain: np.where(
        np.arange(len(strain)) == 3, 0xD9D7D2FF, colours(strain)
    )
    for frame in generate_waves(of, COUNT):
        recorder.record_frame(frame)
    with pytest.raises(RunFailed, match="other colours"):
        require_last(recorder.finish_recording({}), of, COUNT - 1, TIME, ends())


def test_a_recording_without_frames_and_a_file_that_is_none_are_refused(tmp_path: Path):
    with pytest.raises(RunFailed, match="ends with no frame"):
        require_last(
            RerunRecorder(tmp_path / "a.rrd", build_recording_info()).finish_recording({}),
            build_recording_info(),
            1,
            0.01,
            ends(),
        )
    (tmp_path / "b.rrd").write_bytes(b"")
    with pytest.raises(InputError, match="not a Rerun recording"):
        require_last(tmp_path / "b.rrd", replace(build_recording_info()), 1, 0.01, ends())


def whole(of: RecordingInfo) -> dict[int, np.ndarray]:
    return {frame.index: frame.positions for frame in generate_waves(of, COUNT)}


TIMES = {k: 0.01 * k for k in range(COUNT)}
FALSE_FRAMES = {
    "one step late in odd frames": lambda f, before: replace(f, positions=(before if f.index % 2 else f).positions),
    "late in one frame": lambda f, before: replace(f, positions=before.positions if f.index == 4 else f.positions),
    "its time late": lambda f, before: replace(f, time=before.time if f.index == 4 else f.time),
}


@pytest.mark.parametrize("lie", FALSE_FRAMES.values(), ids=FALSE_FRAMES)
def test_a_recording_that_is_wrong_before_its_end_is_refused(
    lie: Callable[[RecordedFrame, RecordedFrame], RecordedFrame], tmp_path: Path
):
    of, before = build_recording_info(), next(generate_waves(build_recording_info(), 1))
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    for frame in generate_waves(of, COUNT):
        recorder.record_frame(lie(frame, before) if frame.index < COUNT - 1 else frame)
        before = frame
    path = recorder.finish_recording({})
    require_last(path, of, COUNT - 1, TIME, ends())
    with pytest.raises(RunFailed, match=r"frame \d+ was recorded (with other positions|at)"):
        require_recorded_frames(path, of, TIMES, whole(of))


def test_a_few_random_frames_and_the_last_are_sampled():
    drawn = [FrameSamples(100).frames for _ in range(20)]
    assert all(len(frames) == 9 and max(frames) == 100 and min(frames) >= 1 for frames in drawn)
    assert len(set[int]().union(*drawn)) > 30, "other frames each time"
    assert (FrameSamples(1).frames, FrameSamples(3).frames) == ({1}, {1, 2, 3})
    samples, p = FrameSamples(2), np.zeros((1, 3))
    for frame in (1, 2):
        p[:] = frame  # solvers may reuse an array
        samples.add_frame(frame, p)
    assert [float(samples.positions[frame][0, 0]) for frame in (1, 2)] == [1.0, 2.0]


FAR = np.array([32_000_000.0, -5e6, 1e6])


def far_info() -> RecordingInfo:
    mesh = replace(MESHES_BY_KIND["cloth"], rest_positions=MESHES_BY_KIND["cloth"].rest_positions + FAR)
    return replace(build_recording_info(), mesh=mesh)


def test_positions_far_from_zero_are_stored_relative_to_an_origin(tmp_path: Path):
    of = far_info()
    path = write_recording(tmp_path / "a.rrd", of, COUNT)
    require_recorded_frames(path, of, TIMES, whole(of))
    replay = read_replay(path)
    assert np.abs(replay.positions).max() < 10 * of.mesh.bounding_box_diagonal
    np.testing.assert_array_equal(replay.origin, compute_local_origin(of.mesh.rest_positions))
    for k, p in whole(of).items():
        assert np.abs(replay.absolute_positions(k) - p).max() < 1e-6 * of.mesh.bounding_box_diagonal, (
            "not the metre of single precision"
        )


def test_positions_rounded_far_from_zero_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Single precision resolves 2 m at 32,000 km; an origin of zero is consistent with that, and no excuse for it."""
    of = far_info()
    monkeypatch.setattr(rerun_recorder, "compute_local_origin", lambda rest: np.zeros(3))
    with pytest.raises(RunFailed, match=r"positions rounded by 1\.\d* m|positions rounded by 0\.\d+ m"):
        require_last(write_recording(tmp_path / "a.rrd", of, COUNT), of, COUNT - 1, TIME, whole(of)[COUNT - 1])


@pytest.mark.parametrize("size", [1e-300, 1e-9, 1.0, 1e9, 1e300])
@pytest.mark.parametrize("distance", [0.0, 3.0, 1e3, 1e7])
def test_an_origin_is_near_its_mesh_and_preserves_relative_positions(size: float, distance: float):
    rest = size * (np.array([[0.0, 0, 0], [0.3, 0.9, 0], [0, 0, 0.1]]) + np.array([distance, -distance, 0]))
    origin, diagonal = compute_local_origin(rest), float(np.linalg.norm(np.ptp(rest / size, axis=0))) * size
    assert np.abs(rest - origin).max() <= 10 * diagonal, "a cell is less than 16 diagonals"
    np.testing.assert_allclose((rest - origin) + origin, rest, rtol=3e-16, atol=0)  # a unit in the last place
    assert distance > 4 or not origin.any(), "near zero positions stay as they are"


def test_an_origin_of_what_has_no_extent_or_no_end_is_finite():
    np.testing.assert_array_equal(compute_local_origin(np.array([[0.2, 1e7 + 0.3, 0]])), [0, 1e7, 0])
    np.testing.assert_array_equal(compute_local_origin(np.array([[1e308, 0, 0], [-1e308, 0, 0]])), np.zeros(3))
