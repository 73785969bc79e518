"""Two clocks: what a second one sees go by decides whether times are believed, and what was lost is no lie."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from time import sleep
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from springbench.harness.errors import RunFailed
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.simulation.stopwatch import (
    CALL_OVERHEAD_SECONDS,
    CLOCK_ATOL_SECONDS,
    CLOCK_RTOL,
    ClockMismatch,
    PhaseWatch,
    check_phases,
    retry_on_mismatch,
)

from tests.scene_builders import build_first_problem, build_test_scene

SECOND = PhaseWatch(wall_seconds=1.0, num_entries=100, process_seconds=1.0, thread_seconds=1.0)
"""A second in which one thread computed all the time."""

HALF_LOST = PhaseWatch(wall_seconds=1.0, num_entries=100, process_seconds=0.5, thread_seconds=0.5)

MOSTLY_LOST = PhaseWatch(wall_seconds=1.0, num_entries=100, process_seconds=0.05, thread_seconds=0.05)
"""A second in which others had the core 19 times as long."""

FALSE_TIMES = {
    "the solve is left out": (SECOND, 0.05),
    "times are scaled": (SECOND, 1e-3),
    "times are scaled up": (SECOND, 1.5),
    "a twentieth is left out": (SECOND, 0.95),
    "a time is not a number": (SECOND, np.nan),
    "times are scaled on a busy machine": (HALF_LOST, 1e-3),
    "times are scaled on a very busy machine": (MOSTLY_LOST, 1e-3),
    "times are longer than the wall's on a busy machine": (HALF_LOST, 1.05),
}


@pytest.mark.parametrize(("watch", "reported"), FALSE_TIMES.values(), ids=FALSE_TIMES)
def test_times_that_another_clock_does_not_confirm_are_refused(watch: PhaseWatch, reported: float) -> None:
    with pytest.raises(RunFailed, match="the times of step add up to"):
        watch.build_columns("step", [reported / 4] * 4)


@pytest.mark.parametrize("lies", [0, 1, 2])
def test_a_false_report_is_measured_again_and_a_second_one_is_a_failure(lies: int) -> None:
    times = iter([1e-3] * lies + [1.0] * 3)

    @retry_on_mismatch
    def measure(what: str) -> float:
        return SECOND.build_columns(what, [next(times)])["wall_seconds_sum"]

    if lies == 2:
        with pytest.raises(ClockMismatch, match="the times of step"):
            measure("step")
    else:
        assert measure("step") == 1.0
    assert len(list(times)) == 3 - (lies < 2)


TRUE_TIMES = {
    "to the last bit": (SECOND, 1.0),
    "within three hundredths": (SECOND, 1.0 - 0.9 * CLOCK_RTOL),
    "within a millisecond": (
        PhaseWatch(wall_seconds=2e-3, num_entries=1, process_seconds=2e-3, thread_seconds=2e-3),
        2e-3 - 0.9 * CLOCK_ATOL_SECONDS,
    ),
    "within what reading a clock takes": (
        PhaseWatch(wall_seconds=0.03, num_entries=1000, process_seconds=0.03, thread_seconds=0.03),
        0.03 - 900 * CALL_OVERHEAD_SECONDS,
    ),
    "a delay between two steps": (HALF_LOST, 0.6),
    "delays between two steps on a very busy machine": (MOSTLY_LOST, 0.06),
    "clocks that are read with cold caches, which only the CPU time has": (
        PhaseWatch(wall_seconds=0.0176, num_entries=60, process_seconds=0.0184, thread_seconds=0.0184),
        0.0173,
    ),
    "two threads that take turns": (
        PhaseWatch(num_threads=2, wall_seconds=1.0, num_entries=1, process_seconds=1.1, thread_seconds=0.99),
        1.0,
    ),
}


@pytest.mark.parametrize(("watch", "reported"), TRUE_TIMES.values(), ids=TRUE_TIMES)
def test_times_that_another_clock_confirms_are_accepted_and_both_are_reported(
    watch: PhaseWatch, reported: float
) -> None:
    columns = watch.build_columns("step", [reported / 2] * 2)
    assert columns == {
        "wall_seconds_check": watch.wall_seconds,
        "wall_seconds_sum": reported,
        "cpu_seconds": watch.process_seconds,
        "preempted": watch in (HALF_LOST, MOSTLY_LOST),
    }


def test_both_of_two_threads_stopped_for_half_the_time_are_detected() -> None:
    assert PhaseWatch(num_threads=2, wall_seconds=1.0, process_seconds=1.0, thread_seconds=0.5).build_columns(
        "step", [1.0]
    )["preempted"]


def test_a_background_thread_does_not_hide_a_preemption() -> None:
    watch = PhaseWatch(wall_seconds=1.0, num_entries=1, process_seconds=1.0, thread_seconds=0.9)
    assert watch.build_columns("step", [0.9])["preempted"]
    elsewhere = PhaseWatch(wall_seconds=1.0, num_entries=1, process_seconds=1.0, thread_seconds=0.01)
    assert not elsewhere.build_columns("step", [1.0])["preempted"], "an engine may compute in a thread of its own"


def test_a_watch_adds_up_what_is_done_within_it_and_nothing_in_between() -> None:
    watch = PhaseWatch()
    for _ in range(2):
        with watch:
            sleep(0.01)
        sleep(0.2)
    assert watch.num_entries == 2
    assert watch.wall_seconds >= 0.02
    # A thread that sleeps takes hardly any CPU time; others of this process may take some.
    assert watch.thread_seconds <= 0.5 * watch.wall_seconds
    busy = watch.thread_seconds, max(watch.thread_seconds, watch.process_seconds)
    assert watch.preempted_seconds in [max(0.0, watch.wall_seconds - seconds) for seconds in busy]


STOPPED_PROGRAM = """
import os, signal
from springbench.harness.simulation.stopwatch import PhaseWatch
watch = PhaseWatch()
with watch:
    os.kill(os.getpid(), signal.SIGSTOP)
print(watch.build_columns("step", [watch.wall_seconds])["preempted"], watch.preempted_seconds)
"""


def test_a_process_that_was_stopped_is_reported() -> None:
    child = subprocess.Popen([sys.executable, "-c", STOPPED_PROGRAM], stdout=subprocess.PIPE, text=True)
    _, status = os.waitpid(child.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status)
    sleep(0.1)
    child.send_signal(signal.SIGCONT)
    said, _ = child.communicate()
    preempted, lost = said.split()
    assert preempted == "True"
    assert float(lost) >= 0.09  # of 0.1: CPU time is known to some milliseconds, where a host counts it


PROBLEM = build_first_problem(
    build_test_scene(ChainMesh(), GravityEffect(), PinsEffect(parts=("first",), weight=1e4), size=4)
)
FILLED_ARRAY, UNCHANGED_ARRAY = np.ones((2, 4, 3))


def fill_array() -> np.ndarray:
    FILLED_ARRAY[:] = 1.0
    return FILLED_ARRAY


WORKING_PHASES = {
    "it writes to its array": fill_array,
    "it returns a new array": lambda: np.ones(3),
    "it tells whether it succeeded": lambda: False,
    "it writes what is not a number": lambda: np.full(3, np.nan),
}
IDLE_PHASES = {"it returns nothing": lambda: None, "it returns its array as it is": lambda: UNCHANGED_ARRAY}


def prepare_phases(call: Any) -> Any:
    return SimpleNamespace(iteration_phases=lambda problem: {"local": fill_array, "global": call})


@pytest.mark.parametrize("call", WORKING_PHASES.values(), ids=WORKING_PHASES)
def test_a_phase_that_computes_is_timed(call: Any) -> None:
    assert check_phases(prepare_phases(call), PROBLEM) == {"local": fill_array, "global": call}


@pytest.mark.parametrize("call", IDLE_PHASES.values(), ids=IDLE_PHASES)
def test_a_phase_that_computes_nothing_is_detected(call: Any) -> None:
    with pytest.raises(RunFailed, match="the phase global does nothing"):
        check_phases(prepare_phases(call), PROBLEM)
