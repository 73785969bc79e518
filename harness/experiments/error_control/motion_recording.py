"""Recording of a motion in a separate process.

The process imports Rerun while this one imports the methods; each takes half a second. Methods are timed only when both
imports are complete.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from springbench.harness.execution.isolated_worker import IsolatedWorker, ProgressCallback, TaskLimits
from springbench.harness.execution.optional_parts import RECORDINGS
from springbench.solvers.platform_calls import list_usable_cores

if TYPE_CHECKING:
    from springbench.harness.recording.recorder_interface import RecordingInfo
    from springbench.solvers.model.step_problem import Positions


class MotionRecorder:
    """Context manager that records motions, in a separate process if there is a second core.

    Args:
        has_process: whether a separate process may be started; without one the recorder can be pickled.
    """

    def __init__(self, *, has_process: bool = True) -> None:
        has_process = has_process and RECORDINGS.is_installed() and len(list_usable_cores()) > 1
        self._worker = IsolatedWorker(_import_recorder) if has_process else None

    def __enter__(self) -> MotionRecorder:
        """Start the process, which imports the recorder."""
        if self._worker:
            self._worker.start_worker()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop the process."""
        if self._worker:
            self._worker.stop_worker()

    def wait_for_import(self) -> None:
        """Wait until the process is idle: it would disturb timings."""
        if self._worker:
            self._worker.run_task(_do_nothing, _ignore_progress, TaskLimits())

    def write_recording(self, path: Path, info: RecordingInfo, positions: Positions) -> Path:
        """Write the recording of a motion, and return its path.

        Args:
            path: path of the recording.
            info: scene and properties of the recording.
            positions: positions (frames, n, 3) at the start and after each step [m].

        Raises:
            WriteError: the file cannot be written.
        """
        task = partial(_write_recording, path, info, positions)
        return self._worker.run_task(task, _ignore_progress, TaskLimits()) if self._worker else task(_ignore_progress)


def _import_recorder() -> None:
    import springbench.harness.recording.rerun_recorder  # noqa: F401


def _write_recording(path: Path, info: RecordingInfo, positions: Positions, tick: ProgressCallback) -> Path:
    from springbench.harness.recording.recorder_interface import RecordedFrame
    from springbench.harness.recording.rerun_recorder import RerunRecorder

    path.parent.mkdir(parents=True, exist_ok=True)
    recorder = RerunRecorder(path, info)
    try:
        for k, p in enumerate(positions):
            recorder.record_frame(RecordedFrame(k, k * info.time_step, p, {}, float("nan"), 0))
        return recorder.finish_recording({})
    finally:
        recorder.abandon_recording()


def _do_nothing(tick: ProgressCallback) -> None:
    pass


def _ignore_progress(event: str) -> None:
    pass
