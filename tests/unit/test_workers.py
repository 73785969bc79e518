"""A worker may crash, hang, swell or leave: the reason is reported, and the next task is done as usual."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import NamedTuple

import psutil
import pytest
from springbench.harness.atomic_files import WriteError
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.isolated_worker import (
    IsolatedWorker,
    ProgressCallback,
    TaskFailure,
    TaskFunction,
    TaskLimits,
)

from tests import worker_tasks as does

NONE = TaskLimits()


@pytest.fixture
def workers() -> Iterator[IsolatedWorker]:
    made = IsolatedWorker()
    yield made
    made.stop_worker()


def quiet(phase: str) -> None:
    pass


class Case(NamedTuple):
    """A piece, what its loss is called, and what is said of it, in parts."""

    piece: TaskFunction
    status: str
    said: tuple[str, ...]
    limits: TaskLimits = NONE


CASES = {
    "a crash": Case(
        does.crash_process,
        "failed",
        ("crashed by SIGSEGV at worker_tasks.py", "in crash", "after 2 steps of the crashing"),
    ),
    "an abort": Case(
        does.abort_process, "failed", ("crashed by SIGABRT at worker_tasks.py", "in abort", "it said: I cannot go on")
    ),
    "an exit by the system": Case(
        does.exit_with_error, "failed", ("ended its process with exit code 7, before its first step",)
    ),
    "an exit that says that all is well": Case(does.exit_cleanly, "failed", ("exit code 0",)),
    "an exit by Python": Case(does.raise_system_exit, "failed", ("raised SystemExit: I am off (worker_tasks.py",)),
    "the end of a generator": Case(does.raise_generator_exit, "failed", ("raised GeneratorExit (worker_tasks.py",)),
    "an interrupt that nobody made": Case(
        does.raise_keyboard_interrupt, "failed", ("raised KeyboardInterrupt (worker_tasks.py",)
    ),
    "a kill": Case(does.kill_process, "killed", ("SIGKILL",)),
    "a loop": Case(
        does.loop_forever,
        "time-limit",
        ("did not end within 1 s; it was at worker_tasks.py", "in loop"),
        TaskLimits(wall_seconds=1.0),
    ),
    "too much memory": Case(
        does.exhaust_memory, "failed", ("raised MemoryError (worker_tasks.py",), TaskLimits(memory_gib=0.5)
    ),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_failed_process_of_a_task_is_reported_and_the_next_task_is_done(case: Case, workers: IsolatedWorker):
    for _ in range(2):
        with pytest.raises(TaskFailure) as lost:
            workers.run_task(case.piece, quiet, case.limits)
        assert lost.value.status == case.status
        for part in case.said:
            assert part in str(lost.value)
        assert workers.run_task(partial(does.double_number, 21), quiet, NONE) == 42


def test_a_worker_is_another_process_and_stays(workers: IsolatedWorker):
    one, two = (workers.run_task(does.worker_pid, quiet, NONE) for _ in range(2))
    assert one == two != os.getpid()


def test_a_worker_that_died_in_between_is_replaced(workers: IsolatedWorker):
    first = workers.run_task(does.worker_pid, quiet, NONE)
    dying = psutil.Process(first)
    dying.kill()
    psutil.wait_procs([dying], timeout=10.0)
    assert workers.run_task(does.worker_pid, quiet, NONE) != first


def test_a_task_that_leaves_threads_behind_ends_its_worker(workers: IsolatedWorker):
    first = workers.run_task(does.start_daemon_thread, quiet, NONE)
    assert workers.run_task(does.worker_pid, quiet, NONE) != first


def test_a_task_that_loses_the_device_ends_its_worker(workers: IsolatedWorker):
    """A process does not get it back: the next runs on it need another one."""
    first = workers.run_task(does.break_device, quiet, NONE)
    assert workers.run_task(does.worker_pid, quiet, NONE) != first


def test_a_fork_made_by_a_task_returns_nothing(workers: IsolatedWorker):
    first = workers.run_task(does.fork_process, quiet, NONE)
    assert workers.run_task(does.worker_pid, quiet, NONE) == first


def test_memory_is_free_again_after_a_task(workers: IsolatedWorker):
    with pytest.raises(TaskFailure):
        workers.run_task(does.exhaust_memory, quiet, TaskLimits(memory_gib=0.5))
    assert workers.run_task(does.exhaust_memory, quiet, NONE) == 2**11


def refuse(error: Exception, tick: ProgressCallback) -> None:
    raise error


@pytest.mark.parametrize(
    "error",
    [WriteError("x: No space left on device"), InputError([InputMistake("is odd", key="a"), InputMistake("is even")])],
)
def test_errors_that_end_an_experiment_come_back_as_they_were(error: Exception, workers: IsolatedWorker):
    with pytest.raises(type(error)) as found:
        workers.run_task(partial(refuse, error), quiet, NONE)
    assert str(found.value) == str(error)
    assert getattr(found.value, "mistakes", None) == getattr(error, "mistakes", None)


def test_all_ticks_arrive_and_output_is_forwarded(
    workers: IsolatedWorker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    heard: list[str] = []
    assert (
        workers.run_task(does.flood_stderr, heard.append, TaskLimits(log_path=tmp_path / "logs" / "said.txt")) == "said"
    )
    assert [said for said in heard if said] == ["chatting"] * 5000
    shown = capsys.readouterr().err
    assert len(shown) < 10_000
    assert shown.endswith(
        f"[of 500000 bytes of output the first 8192 are shown; all of it is in {tmp_path}/logs/said.txt]\n"
    )
    assert (tmp_path / "logs" / "said.txt").read_text() == 5000 * ("x" * 99 + "\n")


def test_much_output_takes_a_task_little_time(
    workers: IsolatedWorker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """18 kB take 4 us to write; a pipe of 64 kB that is read every 0.1 s makes it 28 ms."""
    assert workers.run_task(does.time_logging, quiet, TaskLimits(log_path=tmp_path / "said.txt")) < 5e-3
    assert (tmp_path / "said.txt").stat().st_size == 200 * 18_001


START_KINDS = ["a child", "a session of its own", "an orphan"]


@pytest.mark.parametrize("how", START_KINDS)
def test_processes_started_by_a_task_end_with_it(how: str, workers: IsolatedWorker):
    first = workers.run_task(partial(does.start_orphans, how), quiet, NONE)
    assert workers.run_task(partial(does.double_number, 21), quiet, NONE) == 42
    assert not psutil.pid_exists(first)


@pytest.mark.parametrize("how", START_KINDS)
def test_processes_started_by_a_task_end_when_it_crashes(how: str, workers: IsolatedWorker, tmp_path: Path):
    with pytest.raises(TaskFailure, match="SIGSEGV"):
        workers.run_task(partial(does.start_orphans_and_crash, how, tmp_path / "pid"), quiet, NONE)
    assert not psutil.pid_exists(int((tmp_path / "pid").read_text()))


def test_the_memory_of_processes_started_by_a_task_counts(workers: IsolatedWorker):
    with pytest.raises(TaskFailure, match=r"took more than 0.5 GiB with the processes it started"):
        workers.run_task(does.exhaust_memory_in_children, quiet, TaskLimits(60.0, 0.5))


def test_a_task_that_closes_all_files_is_lost_alone(workers: IsolatedWorker, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(TaskFailure, match="ended its process"):
        workers.run_task(does.close_file_descriptors, quiet, TaskLimits(20.0))
    assert "Traceback" not in capsys.readouterr().err
    assert workers.run_task(partial(does.double_number, 21), quiet, NONE) == 42


def test_a_changed_folder_is_limited_to_its_task(workers: IsolatedWorker):
    workers.run_task(does.change_folder, quiet, NONE)
    assert workers.run_task(does.current_folder, quiet, NONE) == os.getcwd()


def test_tasks_with_plugin_code_share_no_worker_with_tasks_without(workers: IsolatedWorker):
    def name(*own: str) -> int:
        going = workers.start_task(does.worker_pid, quiet, NONE, frozenset(own))
        while True:
            try:
                wait([next(going)])
            except StopIteration as done:
                return done.value

    first = name()
    assert name("mine.py") == name("mine.py") == first
    assert name() != first
    assert name("mine.py") != name("other.py")
