"""Several workers do tasks at once: each is done once, a loss costs its task alone, groups stay together."""

from __future__ import annotations

from functools import partial
from time import sleep

import pytest
from numba.core import event
from springbench.harness.errors import InputError
from springbench.harness.execution.isolated_worker import IsolatedWorker, ProgressCallback, TaskFailure, TaskLimits
from springbench.harness.execution.progress_events import (
    COMPILING,
    WAITING,
    parse_activity_end,
    parse_activity_start,
    report_activity,
    report_compilation,
)
from springbench.harness.execution.worker_pool import PoolTask, run_tasks

from tests import worker_tasks as does


def quiet(said: str) -> None:
    pass


def refuse(tick: ProgressCallback) -> None:
    raise InputError("no")


def report_waiting(tick: ProgressCallback) -> str:
    with report_activity(tick, WAITING):
        sleep(3.0)
    return "done"


def test_each_task_is_done_once_and_a_loss_costs_its_own():
    pieces = [does.crash_process if n in (1, 4) else partial(does.double_number, n) for n in range(6)]
    found = dict(run_tasks(2, int, [None] * 6, lambda number: PoolTask(pieces[number], quiet, TaskLimits())))
    assert sorted(found) == list(range(6))
    for number, outcome in found.items():
        assert isinstance(outcome, TaskFailure) if number in (1, 4) else outcome == 2 * number


def test_what_is_done_already_is_left_out():
    found = dict(
        run_tasks(
            2,
            int,
            [None] * 4,
            lambda n: PoolTask(partial(does.double_number, n), quiet, TaskLimits()) if n % 2 else None,
        )
    )
    assert found == {1: 2, 3: 6}


def test_a_group_is_left_to_one_worker_as_long_as_the_others_have_something_to_do():
    groups = ["a", "b", "a", "b", "a", "b"]
    found = dict(run_tasks(2, int, groups, lambda number: PoolTask(does.worker_pid, quiet, TaskLimits())))
    assert len({(found[number], group) for number, group in enumerate(groups)}) <= 3  # of four that there may be


def test_an_error_that_ends_an_experiment_ends_it():
    with pytest.raises(InputError):
        list(run_tasks(2, int, [None] * 4, lambda number: PoolTask(refuse, quiet, TaskLimits())))


def test_the_time_that_a_task_waits_for_others_does_not_count_for_its_limit():
    workers = IsolatedWorker()
    assert workers.run_task(report_waiting, quiet, TaskLimits(wall_seconds=2.5)) == "done"
    workers.stop_worker()


def test_compiling_is_reported_once_whatever_is_compiled_within():
    heard: list[str] = []
    with report_compilation(heard.append), event.trigger_event("numba:compile"), event.trigger_event("numba:compile"):
        assert len(heard) == 1
    assert [parse_activity_start(heard[0]), parse_activity_end(heard[1])] == [COMPILING] * 2
    with event.trigger_event("numba:compile"):
        assert len(heard) == 2
