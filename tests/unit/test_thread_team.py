"""Threads that share tasks: each is done once a phase, phases come one after the other, and no thread is waited for."""

from __future__ import annotations

from threading import Thread

import numpy as np
import pytest
from numba import prange
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_inner_parallel, jit_kernel
from springbench.solvers.linalg.cholesky.thread_team import (
    ThreadTeam,
    call_in_thread,
    complete_task,
    finish_phases,
    raise_thread_error,
    release_phase,
    reset_team,
    try_claim,
    wait_for_phase,
)

begin = jit_kernel(lambda team: reset_team(team))


@jit_kernel
def work(team, first, phases, log, by):
    """A thread that adds the phase to each task's entry of `log`, and one to its own count `by` of tasks."""
    tasks = len(team.task_sums)
    phase = 0
    while phase >= 0:
        for i in range(tasks):
            task = (first + i) % tasks
            if try_claim(team, task, phase):
                log[task] = 3 * log[task] + phase
                by[0] += 1
                if complete_task(team):
                    # All tasks of this phase are done and none of the next one is begun.
                    for other in range(tasks):
                        if log[other] != log[0]:
                            by[1] += 1
                    if phase == phases:
                        finish_phases(team)
                    else:
                        release_phase(team, phase + 1)
        phase = wait_for_phase(team, phase)


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("tasks", [1, 4])
def test_each_task_is_done_once_a_phase_and_phases_do_not_mix(threads, tasks):
    phases = 300
    team, log, counts = ThreadTeam.from_task_count(tasks), np.zeros(tasks, np.int64), np.zeros((threads, 2), np.int64)
    begin(team)
    workers = [Thread(target=work, args=(team, k, phases, log, counts[k])) for k in range(threads)]
    for thread in workers:
        thread.start()
    for thread in workers:
        thread.join()
    assert counts[:, 0].sum() == tasks * (phases + 1)
    assert counts[:, 1].sum() == 0
    expected = np.int64(0)
    with np.errstate(over="ignore"):
        for phase in range(phases + 1):
            expected = np.int64(3) * expected + np.int64(phase)  # in the order of phases, wrapped as the kernel's
    np.testing.assert_array_equal(log, expected)


def test_a_thread_that_arrives_after_the_last_task_does_nothing():
    team, log, counts = ThreadTeam.from_task_count(3), np.zeros(3, np.int64), np.zeros((2, 2), np.int64)
    begin(team)
    for k in range(2):
        work(team, k, 7, log, counts[k])
    assert counts.tolist() == [[24, 0], [0, 0]]


@jit_inner
def process_or_raise(team, failing_task, failing_phase):
    """A thread that raises an exception at one task of one phase; the last phase is 3."""
    phase = 0
    while phase >= 0:
        for task in range(len(team.task_sums)):
            if try_claim(team, task, phase):
                if task == failing_task and phase == failing_phase:
                    raise ValueError("the task that fails")
                if complete_task(team):
                    if phase == 3:
                        finish_phases(team)
                    else:
                        release_phase(team, phase + 1)
        phase = wait_for_phase(team, phase)


@jit_inner_parallel
def run_in_two_threads(team, failing_task, failing_phase):
    for _ in prange(2):
        call_in_thread(team, process_or_raise, (team, failing_task, failing_phase))


@jit_kernel
def run_team(team, failing_task, failing_phase):
    reset_team(team)
    run_in_two_threads(team, failing_task, failing_phase)
    raise_thread_error(team)


@pytest.mark.parametrize("phase", [0, 2])
@pytest.mark.parametrize("task", [0, 3])
def test_an_exception_in_a_thread_ends_all_threads_and_is_raised(task: int, phase: int):
    team = ThreadTeam.from_task_count(4)
    for _ in range(20):  # now in one thread, now in the other
        with pytest.raises(ValueError, match="the task that fails"):
            run_team(team, task, phase)
        run_team(team, -1, phase)  # the team is ready for another run
