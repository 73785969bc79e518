"""Rerun file with a temporary name until it is complete.

A kill therefore leaves no truncated file under the final name. The stream has no batching thread of its own, which
would slow down concurrent work and lose its last batch in a kill. Logged data is written to disk by `flush_stream`.

The library has no public call to end the threads of a destroyed stream, to write a layout without leaving threads
running, or to release a stream whose writer has died. `tests/contracts/test_rerun_gaps.py` fails once it has one.
"""

from __future__ import annotations

import ctypes
import os
import re
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
import rerun_bindings
from springbench.harness.atomic_files import WriteError, build_partial_path, build_write_error
from springbench.harness.execution import isolated_worker
from springbench.harness.recording.recording_integrity import mark_verified, scan_messages

_FLUSH_TIMEOUT = 30
"""Timeout of a flush [s]."""

_PROBE_BYTES = 2**16
"""Number of bytes in a test write, which fails if the disk is full."""

_broken_streams: list[rr.RecordingStream] = []
"""Streams whose writing thread has died."""
_first_pid = 0
"""Process that opened the first stream, here or before a fork; streams do not survive a fork."""


class PartialFile:
    """An open recording stream into a partial file in the folder of the final file.

    Raises:
        WriteError: from any method, if the file cannot be written or is incomplete at the end.
    """

    def __init__(self, path: Path, application: str, recording_id: str, title: str) -> None:
        global _first_pid
        self._path, self._broken = path, False
        self._partial = build_partial_path(path)
        _first_pid = _first_pid or os.getpid()
        isolated_worker.FORK_BLOCKERS.add("Rerun's streams")
        if not _broken_streams and os.getpid() == _first_pid:  # otherwise the call would wait forever or fail
            rerun_bindings.flush_and_cleanup_orphaned_recordings()  # ends the two threads of each destroyed stream
        rr.set_strict_mode(True)  # otherwise data of a wrong shape are dropped without an error
        self.stream = rr.RecordingStream(
            re.sub(r"[^\w .-]", "-", application),  # the viewer warns of other characters
            recording_id=recording_id,
            batcher_config=rr.ChunkBatcherConfig.NEVER(),
            send_properties=False,
        )
        self.stream.set_log_time_enabled(False)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.stream.save(self._partial)
        except (OSError, RuntimeError) as error:
            raise self._build_write_error(error) from error
        self.stream.send_recording_name(title)

    def flush_stream(self) -> None:
        """Wait until all logged data is in the file."""
        try:
            self.stream.flush(timeout_sec=_FLUSH_TIMEOUT)
        except Exception as error:
            raise self._build_write_error(error) from error

    def write_blueprint(self, layout: rrb.Blueprint) -> None:
        """Write the viewer layout; the last layout written takes effect.

        Equals the library's `send_blueprint` plus a disconnection. Without it two threads never end, since the stream
        and its storage refer to each other.
        """
        name = self.stream.get_application_id() or ""
        sketch = rr.RecordingStream._from_native(  # pyright: ignore[reportPrivateUsage]
            rerun_bindings.new_blueprint(name, False, False, True)
        )
        sketch.set_time("blueprint", sequence=0)
        layout._log_to_stream(sketch)  # pyright: ignore[reportPrivateUsage]
        storage = sketch.memory_recording().storage
        rerun_bindings.send_blueprint(storage, True, True, recording=self.stream.to_native())
        sketch.disconnect()

    def finish_file(self, layout: rrb.Blueprint) -> Path:
        """Close the file, check that it is complete, and give it its final name.

        Returns:
            The final path.
        """
        try:
            self.write_blueprint(layout)
            self.flush_stream()
            self.stream.disconnect()
            if not scan_messages(self._partial)[0]:
                raise OSError("its end is missing")
            os.replace(self._partial, self._path)
            mark_verified(self._path)
        except (OSError, RuntimeError, ValueError) as error:
            raise self._build_write_error(error) from error
        finally:
            self.abandon_file()
        return self._path

    def abandon_file(self) -> None:
        """Stop and remove the partial file if it still exists."""
        if not self._broken:
            self.stream.disconnect()
        self._partial.unlink(missing_ok=True)

    def _build_write_error(self, error: Exception) -> WriteError:
        if not self._broken:
            # The library's writing thread has died (the disk is full). Disconnecting, the clean-up at exit and the
            # stream's destructor may then wait forever for it, so all of them are disabled.
            self._broken = True
            _broken_streams.append(self.stream)
            rr.unregister_shutdown()
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(self.stream))
        return build_write_error(self._path, self._find_cause() or error)

    def _find_cause(self) -> OSError | None:
        """Find why the library's writer died.

        The library does not report the cause, so a test write to the file repeats the error.
        """
        try:
            with self._partial.open("ab") as file:
                file.write(bytes(_PROBE_BYTES))
                os.fsync(file.fileno())
        except OSError as error:
            return error
        return None
