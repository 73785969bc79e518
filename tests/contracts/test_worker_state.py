"""What a worker did before leaves no trace in what is timed next, nor in the memory of the process that starts it."""

from __future__ import annotations

from functools import partial
from statistics import median

import psutil
import pytest
from springbench.harness.execution.isolated_worker import IsolatedWorker
from springbench.harness.execution.worker_pool import PoolTask, run_tasks
from springbench.harness.execution.worker_process import ProgressCallback, TaskLimits
from springbench.harness.simulation.timing_pass import SteppingSettings, measure_run
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.scene_builders import build_cloth

NUM_BLOCKS, OTHERS, NOISE = 12, 100, 1.08
"""The least time of identical runs moves by 4 %: twice that, in the median of some turns."""


def quiet(said: str) -> None:
    pass


def least(size: int, solver: str, rounds: int, tick: ProgressCallback) -> float:
    """The least wall time [s] of a step of a cloth."""
    settings = SteppingSettings(StopRule(50, None), "previous", 20, rounds)
    found = measure_run(build_cloth(size), load_target(SOLVERS[solver])(), settings, tick)
    return min(timing.seconds for timing in found.timings if timing.phase == "step")


@pytest.mark.long
def test_a_run_takes_as_long_after_a_hundred_others_as_first():
    """In turns, so that the machine's load is the same for both; ends as soon as they agree."""
    run, ratios = partial(least, 12, "numba", 20), list[float]()
    used = IsolatedWorker()
    for number in range(OTHERS):
        used.run_task(
            partial(least, 4 + number % 13, ("sparse", "numba", "vbd", "lbfgs")[number % 4], 1), quiet, TaskLimits()
        )
    for _ in range(NUM_BLOCKS):
        new = IsolatedWorker()
        new.run_task(partial(least, 4, "numba", 1), quiet, TaskLimits())  # loads the kernels, as the other has
        first, after = new.run_task(run, quiet, TaskLimits()), used.run_task(run, quiet, TaskLimits())
        new.stop_worker()
        ratios.append(after / first)
        if len(ratios) >= 3 and 1.0 / NOISE < median(ratios) < NOISE:
            break
    used.stop_worker()
    assert 1.0 / NOISE < median(ratios) < NOISE, ratios


def return_bytes(tick: ProgressCallback) -> bytes:
    tick("answering")
    return bytes(2**16)


@pytest.mark.long
def test_the_memory_of_the_parent_process_stays_constant():
    """64 KiB an answer: if stored, the second thousand would be 64 MiB."""
    sizes = list[int]()
    for _ in range(2):
        for _ in run_tasks(2, int, [None] * 1000, lambda number: PoolTask(return_bytes, quiet, TaskLimits())):
            pass
        sizes.append(psutil.Process().memory_info().rss)
    assert sizes[1] - sizes[0] < 16 * 2**20
