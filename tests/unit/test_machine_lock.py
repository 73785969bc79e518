"""One is timed at a time on a machine, and what is not timed waits for it."""

from __future__ import annotations

import errno
import os
import socket
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from functools import partial
from pathlib import Path
from time import monotonic

import pytest
from springbench.harness.atomic_files import open_lock_file
from springbench.harness.errors import InputError
from springbench.harness.execution.folder_locks import UnitClaims, lock_folder_shared
from springbench.harness.execution.isolated_worker import ProgressCallback, TaskLimits
from springbench.harness.execution.progress_events import WAITING, parse_activity_end, parse_activity_start
from springbench.harness.execution.timing_lock import (
    TimingSession,
    lock_timing_exclusive,
    lock_timing_shared,
    reserve_cores,
)
from springbench.harness.execution.worker_pool import PoolTask, run_tasks

SOON, PATIENCE = 0.1, 60.0


@pytest.fixture(autouse=True)
def _locks_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPRINGBENCH_LOCKS", str(tmp_path / "of" / "ours"))  # they make it


class Other(threading.Thread):
    """Another process that would compute, and has begun once it has the lock."""

    def __init__(self, how: Callable[[ProgressCallback], AbstractContextManager[object]]) -> None:
        super().__init__(daemon=True)
        self.how, self.waits, self.inside, self.leave = how, threading.Event(), threading.Event(), threading.Event()
        self.heard: list[str] = []
        self.start()

    def run(self) -> None:
        def tick(said: str) -> None:
            self.heard.append(said)
            self.waits.set()

        with self.how(tick):
            self.inside.set()
            self.leave.wait(PATIENCE)


def quiet(said: str) -> None:
    pass


@pytest.mark.parametrize(
    ("mine", "others"),
    [
        (lock_timing_exclusive, lock_timing_exclusive),
        (lock_timing_exclusive, lock_timing_shared),
        (lock_timing_shared, lock_timing_exclusive),
    ],
)
def test_a_timed_run_is_exclusive(mine: Callable[..., AbstractContextManager[None]], others: Callable[..., object]):
    with mine(quiet):
        other = Other(others)  # type: ignore[arg-type]
        assert other.waits.wait(PATIENCE)
        assert not other.inside.wait(SOON)
    assert other.inside.wait(PATIENCE)
    other.leave.set()
    other.join(PATIENCE)
    assert parse_activity_start(other.heard[0]) == parse_activity_end(other.heard[-1]) == WAITING


def test_untimed_runs_are_concurrent():
    with lock_timing_shared(quiet):
        other = Other(lock_timing_shared)
        assert other.inside.wait(PATIENCE)
        other.leave.set()


def test_timed_runs_have_priority_over_untimed_ones():
    with lock_timing_shared(quiet):
        timed = Other(lock_timing_exclusive)
        assert timed.waits.wait(PATIENCE)
        untimed = Other(lock_timing_shared)
        assert untimed.waits.wait(PATIENCE)
        assert not untimed.inside.wait(SOON)
    assert timed.inside.wait(PATIENCE)
    assert not untimed.inside.is_set()
    timed.leave.set()
    assert untimed.inside.wait(PATIENCE)
    untimed.leave.set()


def test_preparation_precedes_timed_runs_and_two_preparations_are_concurrent():
    with TimingSession(quiet, exclusive=True) as mine, TimingSession(quiet, exclusive=True) as another:
        looks = Other(lock_timing_shared)
        assert looks.waits.wait(PATIENCE)
        with mine.lock_for_preparation(), another.lock_for_preparation():
            assert not looks.inside.wait(SOON)
        with lock_timing_exclusive(quiet):
            assert not looks.inside.is_set()
    assert looks.inside.wait(PATIENCE)
    looks.leave.set()


def test_a_run_timed_next_to_others_is_reported():
    with TimingSession(quiet, exclusive=True) as mine:
        mine.finish_timing()
        mine.finish_timing()
        with TimingSession(quiet, exclusive=False) as shared, shared.lock_for_preparation():
            timed = Other(lock_timing_exclusive)
            assert timed.waits.wait(PATIENCE)
        assert not timed.inside.wait(SOON)
    assert timed.inside.wait(PATIENCE)
    timed.leave.set()


OBSTRUCTIONS: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a link": lambda path: path.symlink_to("/dev/null"),
    "a folder": Path.mkdir,
    "a socket": lambda path: socket.socket(socket.AF_UNIX).bind(str(path)),
}


@pytest.mark.parametrize("what", OBSTRUCTIONS)
def test_what_prevents_a_lock_is_named_at_once(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)  # the name of a socket may not be long
    monkeypatch.setenv("SPRINGBENCH_LOCKS", "locks")
    Path("locks").mkdir()
    places: dict[str, Callable[[], AbstractContextManager[object]]] = {
        "locks/springbench-wanted.lock": lambda: lock_timing_exclusive(quiet),
        "locks/springbench-used.lock": lambda: lock_timing_shared(quiet),
        f"locks/springbench-core-{min(os.sched_getaffinity(0))}.lock": lambda: reserve_cores(1, quiet),
        ".lock": lambda: lock_folder_shared(Path()),
        ".claims": lambda: closing(UnitClaims(Path(), [])),
    }
    for name, lock in places.items():
        OBSTRUCTIONS[what](Path(name))
        with pytest.raises(InputError, match=f"{name}: is {what}; expected a plain file"), lock():
            pass
        os.rename(name, "elsewhere" + name.replace("/", "-"))


def test_a_lock_that_may_not_be_opened_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse_open(path: Path, *flags: int) -> int:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    (tmp_path / "lock").touch()
    monkeypatch.setattr(os, "open", refuse_open)
    with pytest.raises(InputError, match=r"cannot be opened \(Permission denied\).*, or do so"):
        open_lock_file(tmp_path / "lock", hint=", or do so")


def at_core(tick: ProgressCallback) -> tuple[list[int], set[int], float, float]:
    """The cores that this is bound to, as reported and actual, and from when to when."""
    with reserve_cores(1, tick) as cores:
        began, end = monotonic(), monotonic() + SOON
        while monotonic() < end:
            pass
        return cores, os.sched_getaffinity(0), began, monotonic()


def test_each_run_has_its_own_cores():
    task = PoolTask(partial(at_core), quiet, TaskLimits(PATIENCE))
    found = [value for _, value in run_tasks(3, int, [None] * 3, lambda number: task)]
    for cores, kept_to, began, end in found:
        assert set(cores) == kept_to
        assert len(kept_to) == 1
        meanwhile = [other for other, _, a, b in found if a < end and b > began]
        assert meanwhile.count(cores) == 1


@pytest.mark.parametrize("value", ["/proc", "/dev/null"])
def test_a_folder_for_locks_in_which_no_file_can_be_made_is_refused(value: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SPRINGBENCH_LOCKS", value)
    with (
        pytest.raises(InputError, match=f"SPRINGBENCH_LOCKS: {value}: expected a folder"),
        lock_timing_exclusive(quiet),
    ):
        pass
