"""A worker may crash, hang, swell or leave: it is told how, and the next piece is done as if nothing had been."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import pytest

from harness.base.errors import InputError, Mistake
from harness.base.files import CannotWrite
from harness.base.workers import Limits, Lost, Piece, Tick, Workers
from tests import workers as does

NONE = Limits()


@pytest.fixture
def workers() -> Iterator[Workers]:
    made = Workers()
    yield made
    made.end()


def quiet(phase: str) -> None:
    pass


class Case(NamedTuple):
    """A piece, what its loss is called, and what is said of it, in parts."""

    piece: Piece
    status: str
    said: tuple[str, ...]
    limits: Limits = NONE


CASES = {
    "a crash": Case(
        does.crash, "failed", ("crashed by SIGSEGV at workers.py", "in crash", "after 2 steps of the crashing")
    ),
    "an abort": Case(does.abort, "failed", ("crashed by SIGABRT at workers.py", "in abort", "it said: I cannot go on")),
    "an exit by the system": Case(does.leave, "failed", ("ended its process with exit code 7, before its first step",)),
    "an exit that says that all is well": Case(does.leave_well, "failed", ("exit code 0",)),
    "an exit by Python": Case(does.leave_by_python, "failed", ("raised SystemExit: I am off (workers.py",)),
    "the end of a generator": Case(does.leave_as_a_generator, "failed", ("raised GeneratorExit (workers.py",)),
    "an interrupt that nobody made": Case(does.interrupt, "failed", ("raised KeyboardInterrupt (workers.py",)),
    "a kill": Case(does.be_killed, "killed", ("SIGKILL",)),
    "a loop": Case(
        does.loop, "time-limit", ("did not end within 1 s; it was at workers.py", "in loop"), Limits(seconds=1.0)
    ),
    "too much memory": Case(does.swell, "failed", ("raised MemoryError (workers.py",), Limits(gib=0.5)),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_what_a_piece_does_to_its_process_is_told_and_the_next_one_is_done(case: Case, workers: Workers):
    for _ in range(2):
        with pytest.raises(Lost) as lost:
            workers.do(case.piece, quiet, case.limits)
        assert lost.value.status == case.status
        for part in case.said:
            assert part in str(lost.value)
        assert workers.do(partial(does.double, 21), quiet, NONE) == 42


def test_a_worker_is_another_process_and_stays(workers: Workers):
    one, two = (workers.do(does.name, quiet, NONE) for _ in range(2))
    assert one == two != os.getpid()


def test_a_worker_that_died_in_between_is_replaced(workers: Workers):
    first = workers.do(does.name, quiet, NONE)
    os.kill(first, 9)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)  # its last thread has gone, and nobody was told yet
    assert workers.do(does.name, quiet, NONE) != first


def test_a_piece_that_leaves_threads_behind_costs_its_worker(workers: Workers):
    first = workers.do(does.leave_a_thread, quiet, NONE)
    assert workers.do(does.name, quiet, NONE) != first


def test_a_piece_that_loses_the_device_costs_its_worker(workers: Workers):
    """A process does not get it back: the next runs on it need another one."""
    first = workers.do(does.lose_the_device, quiet, NONE)
    assert workers.do(does.name, quiet, NONE) != first


def test_a_copy_that_a_piece_makes_of_its_process_answers_nothing(workers: Workers):
    first = workers.do(does.copy, quiet, NONE)
    assert workers.do(does.name, quiet, NONE) == first


def test_memory_is_free_again_after_a_piece(workers: Workers):
    with pytest.raises(Lost):
        workers.do(does.swell, quiet, Limits(gib=0.5))
    assert workers.do(does.swell, quiet, NONE) == 2**11


def refuse(error: Exception, tick: Tick) -> None:
    raise error


@pytest.mark.parametrize(
    "error", [CannotWrite("x: No space left on device"), InputError([Mistake("is odd", key="a"), Mistake("is even")])]
)
def test_errors_that_end_an_experiment_come_back_as_they_were(error: Exception, workers: Workers):
    with pytest.raises(type(error)) as found:
        workers.do(partial(refuse, error), quiet, NONE)
    assert str(found.value) == str(error)
    assert getattr(found.value, "mistakes", None) == getattr(error, "mistakes", None)


def test_all_ticks_arrive_and_what_is_said_is_passed_on(workers: Workers, capsys: pytest.CaptureFixture[str]):
    heard: list[str] = []
    assert workers.do(does.chat, heard.append, NONE) == "said"
    assert [said for said in heard if said] == ["chatting"] * 5000
    assert capsys.readouterr().err.count("x" * 99) == 5000
