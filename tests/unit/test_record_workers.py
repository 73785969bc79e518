"""Recordings made in a worker, one after the other: the library's threads go with each."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.mutations.base import ROOT

SCRIPT = """
import sys
from functools import partial
from pathlib import Path
from springbench.harness.execution.isolated_worker import IsolatedWorker, TaskLimits
from tests.synthetic_recordings import write_recording
from tests.worker_tasks import count_threads_after_recording

if __name__ == "__main__":
    folder, before = Path(sys.argv[1]), sys.argv[2] == "True"
    if before:
        write_recording(folder / "parent.rrd", frame_count=2)
    worker = IsolatedWorker()
    for k in range(4):
        print(worker.run_task(partial(count_threads_after_recording, folder / f"{k}.rrd"), print, TaskLimits()))
    worker.stop_worker()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="counts threads in /proc")
@pytest.mark.parametrize("before", [False, True], ids=["the first", "after its parent"])
def test_a_worker_that_records_leaves_no_threads(tmp_path: Path, before: bool) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, script, tmp_path, str(before)], cwd=ROOT, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    found = [int(line) for line in done.stdout.splitlines() if line.isdigit()]
    assert len(found) == 4
    assert len(set(found)) == 1, found
