"""What starts before it is needed: the process that draws, and the half of a picture that a fork renders."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from springbench.harness.cli import early_drawing
from springbench.harness.cli.early_drawing import start_drawing
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.execution import early_worker, isolated_worker
from springbench.harness.execution.early_worker import run_in_early_worker, start_early_worker, take_early_worker
from springbench.harness.execution.forked_call import start_in_fork
from springbench.harness.report import opengl_probe

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def workers(monkeypatch: pytest.MonkeyPatch) -> list[isolated_worker.IsolatedWorker]:
    """The early workers of a test."""
    found = list[isolated_worker.IsolatedWorker]()
    monkeypatch.setattr(early_worker, "_EARLY_WORKERS", found)
    return found


def report_process(tick: Callable[[str], None]) -> int:
    return os.getpid()


def refuse(tick: Callable[[str], None]) -> None:
    raise InputError("too wide")


def leave(tick: Callable[[str], None]) -> None:
    os._exit(3)


def test_a_task_runs_in_the_early_worker_or_else_here(workers: list[isolated_worker.IsolatedWorker]) -> None:
    assert run_in_early_worker(report_process, print) == os.getpid()
    start_early_worker(int)
    other = run_in_early_worker(report_process, print)
    assert other != os.getpid()
    with pytest.raises(InputError, match="too wide"):
        run_in_early_worker(refuse, print)
    assert run_in_early_worker(report_process, print) == other
    with pytest.raises(RunFailed, match="exit code 3"):
        run_in_early_worker(leave, print)
    workers[0].stop_worker()


def test_the_early_worker_is_taken_once(workers: list[isolated_worker.IsolatedWorker]) -> None:
    start_early_worker(int)
    (early,) = workers
    other = take_early_worker(int), take_early_worker(int)
    assert other[0] is early
    assert other[1] is not early
    for one in other:
        one.stop_worker()


@pytest.mark.parametrize(
    ("command", "starts"),
    [
        ("figure timing results/sweep --width 85mm", True),
        ("figure run results/sweep", False),
        ("figure --help", False),
        ("preview hanging-cloth", True),
        ("run hanging-cloth --rerun", True),
        ("run hanging-cloth", False),
        ("run hanging-cloth --error=1e-4", True),
    ],
)
def test_the_process_that_draws_starts_where_the_command_draws(
    command: str, starts: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = list[object]()
    monkeypatch.setattr(early_worker, "start_early_worker", begun.append)
    monkeypatch.setattr(early_drawing, "list_usable_cores", lambda: [0, 1])
    start_drawing(command.split())
    assert len(begun) == starts


@pytest.fixture
def can_fork(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget what other tests of this process have started."""
    monkeypatch.setattr(isolated_worker, "FORK_BLOCKERS", set[str]())
    monkeypatch.setattr(isolated_worker, "_has_numba_threads", lambda: False)


@pytest.mark.usefixtures("can_fork")
def test_a_fork_returns_the_value_of_its_call() -> None:
    wait = start_in_fork(os.getpid)
    assert wait() != os.getpid()


@pytest.mark.usefixtures("can_fork")
def test_a_call_that_fails_in_a_fork_raises_its_error_here() -> None:
    def fail() -> None:
        raise InputError("a folder is missing")

    wait = start_in_fork(fail)
    with pytest.raises(InputError, match="a folder is missing"):
        wait()


def test_where_a_fork_is_unsafe_the_call_is_made_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated_worker, "FORK_BLOCKERS", {"threads"})
    assert start_in_fork(os.getpid)() == os.getpid()


@pytest.mark.skipif(opengl_probe.find_opengl_problem() is not None, reason="pictures need OpenGL")
def test_frames_are_the_same_whether_a_fork_renders_them(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from tests.unit.test_report_pictures import cloth, draw_run_picture\n"
        "for name in sys.argv[1:]: draw_run_picture(cloth(), Path(name))"  # OpenGL is used once the first is drawn
    )
    paths = [tmp_path / "forked.png", tmp_path / "here.png"]
    subprocess.run([sys.executable, "-c", program, *map(str, paths)], cwd=ROOT, check=True)
    assert paths[0].read_bytes() == paths[1].read_bytes()
