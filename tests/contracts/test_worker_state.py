"""What a worker did before leaves no trace in what is timed next, nor in the memory of the process that asks."""

from __future__ import annotations

from functools import partial
from statistics import median

import psutil
import pytest

from harness.base.crew import Task, done_by
from harness.base.worker import Limits, Tick
from harness.base.workers import Workers
from harness.simulation.measure import Settings, measure
from solvers.problem import StopRule
from solvers.registry import SOLVERS, load
from tests.scenes import cloth

TURNS, OTHERS, NOISE = 12, 100, 1.08
"""The least time of identical runs moves by 4 %: twice that, in the median of some turns."""


def quiet(said: str) -> None:
    pass


def least(size: int, solver: str, rounds: int, tick: Tick) -> float:
    """The least wall time [s] of a step of a cloth."""
    settings = Settings(StopRule(50, None), "current", 20, rounds)
    found = measure(cloth(size), load(SOLVERS[solver])(), settings, tick)
    return min(timing.seconds for timing in found.timings if timing.phase == "step")


@pytest.mark.long
def test_a_run_takes_as_long_after_a_hundred_others_as_first():
    """In turns, so that the machine's load is the same for both; ends as soon as they agree."""
    run, ratios = partial(least, 12, "numba", 20), list[float]()
    used = Workers()
    for number in range(OTHERS):
        used.do(partial(least, 4 + number % 13, ("sparse", "numba", "vbd", "lbfgs")[number % 4], 1), quiet, Limits())
    for _ in range(TURNS):
        new = Workers()
        new.do(partial(least, 4, "numba", 1), quiet, Limits())  # loads the kernels, as the other has
        first, after = new.do(run, quiet, Limits()), used.do(run, quiet, Limits())
        new.end()
        ratios.append(after / first)
        if len(ratios) >= 3 and 1.0 / NOISE < median(ratios) < NOISE:
            break
    used.end()
    assert 1.0 / NOISE < median(ratios) < NOISE, ratios


def answer(tick: Tick) -> bytes:
    tick("answering")
    return bytes(2**16)


@pytest.mark.long
def test_the_memory_of_the_process_that_asks_stays_flat():
    """64 KiB an answer: kept, the second thousand would be 64 MiB."""
    sizes = list[int]()
    for _ in range(2):
        for _ in done_by(2, int, [None] * 1000, lambda number: Task(answer, quiet, Limits())):
            pass
        sizes.append(psutil.Process().memory_info().rss)
    assert sizes[1] - sizes[0] < 16 * 2**20
