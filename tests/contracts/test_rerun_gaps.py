"""What Rerun has no public call for, and what `harness/recording` does instead.

Each test fails as soon as a public call works: then the workaround can be removed.
"""

import subprocess
import sys
from pathlib import Path

import pytest
import rerun as rr
from rerun.chunk import RrdReader

STREAM = """
import gc, os, resource, signal, sys, time
import rerun as rr, rerun.blueprint as rrb, rerun_bindings

def write(path, layout=False, clean=False):
    stream = rr.RecordingStream("app", batcher_config=rr.ChunkBatcherConfig.NEVER(), send_properties=False)
    stream.save(path)
    stream.log("a", rr.Scalars(1.0))
    if layout:
        stream.send_blueprint(rrb.Blueprint(auto_views=False))
    stream.flush()
    stream.disconnect()
    del stream
    gc.collect()
    if clean:
        rerun_bindings.flush_and_cleanup_orphaned_recordings()

def left(**how):
    write(sys.argv[1], clean=True)  # what the library keeps for good is there now
    before = len(os.listdir("/proc/self/task"))
    write(sys.argv[1], **how)
    end = time.monotonic() + 2.0  # a thread that was ended may still be listed for a moment
    while (count := len(os.listdir("/proc/self/task")) - before) > 0 and time.monotonic() < end:
        time.sleep(0.02)
    return count
"""

DEAD = """
import os, sys, threading
import numpy as np, rerun as rr

os.mkfifo(sys.argv[1])
reader = os.open(sys.argv[1], os.O_RDONLY | os.O_NONBLOCK)
stream = rr.RecordingStream("app", batcher_config=rr.ChunkBatcherConfig.NEVER(), send_properties=False)
stream.save(sys.argv[1])
for _ in range(20):
    stream.log("a", rr.Scalars(np.random.rand(20_000)))  # more than a pipe holds
os.close(reader)  # from now on its writer meets an error, as on a disk that is full
ending = threading.Thread(target=stream.disconnect, daemon=True)
ending.start()
ending.join(1.0)
print(int(ending.is_alive()), flush=True)
os._exit(0)
"""


def count_threads_left(code: str, path: Path) -> int:
    return run_program(f"{STREAM}\nprint({code})", path)


def run_program(program: str, path: Path) -> int:
    command = [sys.executable, "-c", program, path]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def test_a_stream_that_is_gone_leaves_threads_which_no_public_call_ends(tmp_path: Path):
    # Workaround: `flush_and_cleanup_orphaned_recordings` of the bindings.
    assert count_threads_left("left(clean=True)", tmp_path / "a.rrd") == 0
    assert count_threads_left("left()", tmp_path / "a.rrd") > 0, (
        "streams end their threads by themselves: leave the bindings alone"
    )


def test_the_public_call_for_layouts_leaves_threads_that_nothing_ends(tmp_path: Path):
    # Workaround: `PartialFile.lay_out`.
    found = count_threads_left("left(layout=True, clean=True)", tmp_path / "a.rrd")
    assert found > 0, "send_blueprint leaves no threads any more: call it instead"


def test_no_public_call_releases_a_stream_whose_writer_has_died(tmp_path: Path):
    # Workaround: `PartialFile` retains such a stream, by `Py_IncRef`, and takes back its clean-up at exit.
    assert run_program(DEAD, tmp_path / "a.rrd"), (
        "disconnect does not wait for a dead writer any more: call it, and keep nothing"
    )


def test_a_file_that_was_cut_within_a_message_is_not_read_at_all(tmp_path: Path):
    # Workaround: `whole_messages` finds where the last whole message ends.
    path = tmp_path / "a.rrd"
    stream = rr.RecordingStream("app", batcher_config=rr.ChunkBatcherConfig.NEVER(), send_properties=False)
    stream.save(path)
    for frame in range(20):
        stream.set_time("frame", sequence=frame)
        stream.log("a", rr.Scalars(float(frame)))
    stream.flush()
    middle = path.stat().st_size - 100  # in the last frame, long after the first
    stream.disconnect()
    path.write_bytes(path.read_bytes()[:middle])
    with pytest.warns(Warning, match="no footer"), pytest.raises(RuntimeError, match="decode"):
        RrdReader(path).recordings()
