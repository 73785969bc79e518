"""Without the system calls that Linux alone has, a sweep runs in the command's process and gives the same positions."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from springbench.harness.execution.isolated_worker import IsolatedWorker, TaskFailure, TaskLimits
from springbench.harness.execution.sandbox import CallLimits, SandboxError, call_in_sandbox, prepare_call
from springbench.harness.simulation import stopwatch
from springbench.solvers import platform_calls
from springbench.solvers.jit import kernel_cache

ABSENT_CALLS = """
import multiprocessing.popen_fork, os, psutil, signal, subprocess, sys, tempfile, time  # what uses these calls itself
for name in ("fcntl", "resource"):
    sys.modules[name] = None
for name in ("sched_getaffinity", "sched_setaffinity", "getloadavg", "fork", "pidfd_open", "waitid", "setsid",
             "register_at_fork", "sysconf", "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_DIRECTORY"):
    delattr(os, name)
for name in ("SIGKILL", "SIGUSR1"):
    delattr(signal, name)
for name in ("CLOCK_MONOTONIC_RAW", "clock_gettime"):
    delattr(time, name)
"""
"""What Windows lacks; macOS lacks less."""

SCENE = """
mesh: {kind: file, path: square.obj}
mass: 1
time_step: 1/30
frames: 2
effects: [{kind: springs, stretch: 300}, {kind: gravity}, {kind: "./drag.py:Drag", coefficient: 0.1}]
"""
SWEEP = """
scenes: [scene.yaml]
solvers: [sparse]
options: {rounds: 1, max_iterations: 20, pictures: false}
"""
SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"
DRAG = """
from typing import Literal
import springbench
class Drag(springbench.ConfigModel):
    kind: Literal["drag"] = "drag"
    coefficient: float
    def build_contribution(self, mesh, mass, time_step):
        return springbench.EffectContribution(forces=(lambda p, v, t: -self.coefficient * v,))
"""
PROGRAM = """
import json, sys
from springbench.harness.cli.main import app
from typer.testing import CliRunner
answer = CliRunner().invoke(app, ["run", "sweep.yaml", "--results", sys.argv[1]])
assert answer.exit_code == 0, answer.output
from springbench.harness.results.parquet_rows import read_rows
from springbench.harness.results.row_store import list_units
from pathlib import Path
rows = read_rows(list_units(Path(sys.argv[1]) / "sweep" / "rows"))
print("\\n" + json.dumps([rows["status"].to_pylist(), rows["positions_digest"].to_pylist()]))
"""


@pytest.mark.slow
def test_a_sweep_runs_and_gives_the_same_positions(tmp_path: Path):
    for name, text in (("scene.yaml", SCENE), ("sweep.yaml", SWEEP), ("square.obj", SQUARE), ("drag.py", DRAG)):
        (tmp_path / name).write_text(text)
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(ABSENT_CALLS)
    found = dict[str, object]()
    for results, path in (("here", ""), ("elsewhere", str(tmp_path / "site"))):
        environment = {**os.environ, "PYTHONPATH": path}
        command = [sys.executable, "-c", PROGRAM, results]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        found[results] = json.loads(done.stdout.splitlines()[-1])
    assert found["here"] == found["elsewhere"]


@pytest.fixture
def no_isolation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "pidfd_open")


@pytest.mark.usefixtures("no_isolation")
def test_a_task_that_raises_is_reported_as_a_worker_does():
    def fail(tick: object) -> None:
        raise KeyError("lost")

    assert not platform_calls.can_isolate_processes()
    with pytest.raises(TaskFailure, match="raised KeyError: 'lost'"):
        IsolatedWorker().run_task(fail, lambda message: None, TaskLimits())
    assert IsolatedWorker().run_task(lambda tick: os.getpid(), lambda message: None, TaskLimits()) == os.getpid()


@pytest.mark.usefixtures("no_isolation")
def test_a_reader_that_raises_is_reported_as_the_sandbox_does():
    with pytest.raises(SandboxError, match="invalid literal"):
        call_in_sandbox(int, "a", limits=CallLimits(1.0, 2**30))
    assert call_in_sandbox(int, "7", limits=CallLimits(1.0, 2**30)) == 7
    prepare_call("builtins:int")
    assert call_in_sandbox("builtins:int", "8", limits=CallLimits(1.0, 2**30)) == 8


def test_locks_of_files_always_succeed_without_fcntl(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    path = tmp_path / "lock"
    path.touch()
    first, second = (os.open(path, os.O_RDWR) for _ in range(2))
    assert platform_calls.try_lock_file(first, platform_calls.LockMode.EXCLUSIVE)
    assert not platform_calls.try_lock_file(second, platform_calls.LockMode.SHARED)
    monkeypatch.setattr(platform_calls, "fcntl", None)
    assert platform_calls.try_lock_file(second, platform_calls.LockMode.SHARED)
    assert platform_calls.try_lock_byte(second, 3)
    for handle in (first, second):
        os.close(handle)


def test_cores_are_counted_without_affinity(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delattr(os, "sched_getaffinity")
    assert platform_calls.list_usable_cores() == list(range(os.cpu_count() or 1))


def test_the_raw_clock_advances_on_all_platforms(monkeypatch: pytest.MonkeyPatch):
    start = stopwatch.read_raw_clock()
    assert stopwatch.read_raw_clock() >= start
    monkeypatch.delattr(time, "CLOCK_MONOTONIC_RAW")
    monkeypatch.delattr(time, "clock_gettime")
    start = stopwatch.read_raw_clock()
    assert stopwatch.read_raw_clock() >= start


def test_a_kernel_is_stored_without_locks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(platform_calls, "fcntl", None)
    monkeypatch.delattr(os, "O_CLOEXEC")
    with kernel_cache._lock_entry(tmp_path / "kernel"), kernel_cache._lock_entry(tmp_path / "kernel"):
        assert (tmp_path / ".kernel.lock").exists()
    assert not list(tmp_path.iterdir())


def test_the_memory_is_measured_without_sysconf(monkeypatch: pytest.MonkeyPatch):
    import psutil  # it needs sysconf itself, on Linux

    known = platform_calls.measure_memory()
    monkeypatch.delattr(os, "sysconf")
    assert platform_calls.measure_memory() == psutil.virtual_memory().total == pytest.approx(known, rel=1e-6)


UNIX_MODULES = re.compile(r"^\s*(?:import|from) (?:fcntl|resource|grp|pwd|termios)\b", re.M)
UNIX_CALLS = re.compile(
    r"\bos\.(?:fork|setsid|killpg|getpgid|sched_\w+|sysconf|waitid|pidfd_open|geteuid|getuid|mkfifo|uname|getloadavg|"
    r"O_NOFOLLOW|O_NONBLOCK|O_CLOEXEC|O_DIRECTORY|WNOHANG)\b|\bsignal\.(?:SIGKILL|SIGALRM|SIGXCPU|SIGCONT|SIGUSR\d|"
    r"pthread_sigmask|setitimer)\b|\b(?:CLOCK_MONOTONIC_RAW|clock_gettime)\b|\bselect\.poll\b|[\"']/proc/"
)
"""What Windows lacks."""
GUARDED_CALLS = {
    "harness/execution/interrupts.py": "sys.platform",
    "harness/experiments/archive/compaction.py": 'hasattr(os, "O_DIRECTORY")',
    "harness/simulation/stopwatch.py": 'hasattr(time, "CLOCK_MONOTONIC_RAW")',
    **dict.fromkeys(
        (f"harness/execution/{name}.py" for name in ("isolated_worker", "sandbox")), "can_isolate_processes()"
    ),
    "harness/execution/worker_supervisor.py": "",
    "harness/execution/worker_process.py": "",
}
"""Modules with such calls, and how they check for them; the last two run only in processes of `isolated_worker`."""


@pytest.mark.slow
def test_one_module_has_what_only_unix_has():
    root = Path(__file__).resolve().parents[2]
    sources = {
        path.relative_to(root).as_posix(): path.read_text()
        for folder in ("harness", "solvers")
        for path in (root / folder).rglob("*.py")
    }
    importing = {name for name, text in sources.items() if UNIX_MODULES.search(text)}
    assert importing == {"solvers/platform_calls.py"}
    calling = {name for name, text in sources.items() if UNIX_CALLS.search(text)} - importing
    assert calling == set(GUARDED_CALLS)
    assert all(guard in sources[name] for name, guard in GUARDED_CALLS.items())
