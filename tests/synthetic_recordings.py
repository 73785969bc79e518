"""Small recordings for the tests: meshes that wave."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from springbench.harness.recording.recorder_interface import RecordedFrame, RecordingInfo
from springbench.harness.recording.rerun_recorder import RerunRecorder
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh

TIME_STEP = 0.01
MESHES_BY_KIND = {
    "chain": ChainMesh().build_mesh(9),
    "cloth": GridMesh().build_mesh(6),
    "block": BlockMesh().build_mesh(4),
}


def build_recording_info(mesh: str = "cloth", **changes: Any) -> RecordingInfo:
    """What does not change in the recording of one of MESHES."""
    made = MESHES_BY_KIND[mesh]
    plain = RecordingInfo(
        title=f"{mesh} - test",
        run_id=f"id-{mesh}",
        mesh=made,
        springs=made.springs,
        rest_lengths=made.rest_lengths,
        pinned_vertices=np.array([0, 2]),
        time_step=TIME_STEP,
        strain_range=0.1,
        has_self_contact=False,
        properties={"scene": mesh, "size": 6, "solver": "test", "exact": True, "cpu": "a, b [c]", "note": ""},
    )
    return replace(plain, **changes)


def generate_waves(recording_info: RecordingInfo, count: int, amplitude: float = 0.1) -> Iterator[RecordedFrame]:
    """Frames 0 to count - 1 of a mesh on which waves travel; its first vertex stays in place."""
    rest = recording_info.mesh.rest_positions
    for k in range(count):
        wave = amplitude * np.sin(5 * (rest[:, [1, 2, 0]] - rest[0, [1, 2, 0]]) + 0.1 * k) - amplitude * np.sin(0.1 * k)
        energies = {"springs": 2.0 * k, "inertia": 0.5 * k} if k else {}
        yield RecordedFrame(k, k * TIME_STEP, rest + wave, energies, 10.0**-k if k else np.nan, k)


def write_recording(
    path: Path, recording_info: RecordingInfo | None = None, frame_count: int = 12, amplitude: float = 0.1
) -> Path:
    """A complete recording, with the convergence of frame 3 and the milliseconds of two phases."""
    recording_info = recording_info or build_recording_info()
    recorder = RerunRecorder(path, recording_info)
    for frame in generate_waves(recording_info, frame_count, amplitude):
        recorder.record_frame(frame)
        if frame.index == 3:
            recorder.record_convergence(3, [1.0, 0.1, 0.0], [5.0, 4.0, 4.0])
    steps = np.arange(1.0, frame_count)
    return recorder.finish_recording({"step": list(steps), "local": list(steps / 2)})


def write_foreign_recording(path: Path) -> None:
    """A recording of Rerun that is none of ours."""
    stream = rr.RecordingStream("other", recording_id="other")
    stream.save(path)
    stream.log("/points", rr.Points3D([[0, 0, 0]]))
    stream.flush()
    stream.disconnect()
