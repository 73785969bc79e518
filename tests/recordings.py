"""Small recordings for the tests: meshes that wave."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from harness.record.base import Frame, RecordingInfo
from harness.record.rerun import RerunRecorder
from harness.scenes.mesh.chain import Chain
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.solids import Block

TIME_STEP = 0.01
MESHES = {"chain": Chain().build(9), "cloth": Grid().build(6), "block": Block().build(4)}


def info(mesh: str = "cloth", **changes: Any) -> RecordingInfo:
    """What does not change in the recording of one of MESHES."""
    made = MESHES[mesh]
    plain = RecordingInfo(
        title=f"{mesh} - test",
        run_id=f"id-{mesh}",
        mesh=made,
        springs=made.springs,
        rest_lengths=made.rest_lengths,
        pinned=np.array([0, 2]),
        time_step=TIME_STEP,
        strain_range=0.1,
        properties={"scene": mesh, "size": 6, "solver": "test", "exact": True, "cpu": "a, b [c]", "note": ""},
    )
    return replace(plain, **changes)


def waving(of: RecordingInfo, count: int, amplitude: float = 0.1) -> Iterator[Frame]:
    """Frames 0 to count - 1 of a mesh on which waves travel; its first vertex stays in place."""
    rest = of.mesh.rest
    for k in range(count):
        wave = amplitude * np.sin(5 * (rest[:, [1, 2, 0]] - rest[0, [1, 2, 0]]) + 0.1 * k) - amplitude * np.sin(0.1 * k)
        energies = {"springs": 2.0 * k, "inertia": 0.5 * k} if k else {}
        yield Frame(k, k * TIME_STEP, rest + wave, energies, 10.0**-k if k else np.nan, k)


def record(path: Path, of: RecordingInfo | None = None, count: int = 12, amplitude: float = 0.1) -> Path:
    """A complete recording, with the convergence of frame 3 and the milliseconds of two phases."""
    of = of or info()
    recorder = RerunRecorder(path, of)
    for frame in waving(of, count, amplitude):
        recorder.frame(frame)
        if frame.index == 3:
            recorder.convergence(3, [1.0, 0.1, 0.0], [5.0, 4.0, 4.0])
    steps = np.arange(1.0, count)
    return recorder.close({"step": list(steps), "local": list(steps / 2)})


def foreign(path: Path) -> None:
    """A recording of Rerun that is none of ours."""
    stream = rr.RecordingStream("other", recording_id="other")
    stream.save(path)
    stream.log("/points", rr.Points3D([[0, 0, 0]]))
    stream.flush()
    stream.disconnect()
