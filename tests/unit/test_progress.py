"""The time left is shown once it is known, and never from what was compiled; something is printed meanwhile."""

from __future__ import annotations

import io
import random
from collections.abc import Callable

import pytest
from rich.console import Console
from springbench.harness.execution import progress_display
from springbench.harness.execution.progress_display import (
    ProgressBars,
    ProgressDisplay,
    ProgressLines,
    RemainingTime,
    RunCost,
)
from springbench.harness.execution.progress_events import COMPILING, POLL, report_activity

from tests.bench.progress import is_estimate_wrong


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What the clock shows, in its only entry."""
    now = [0.0]
    monkeypatch.setattr(progress_display, "monotonic", lambda: now[0])
    return now


def capture_progress(kind: Callable[[Console], ProgressDisplay], does: Callable[[ProgressDisplay], None]) -> str:
    out = io.StringIO()
    display = kind(Console(file=out, force_terminal=kind is ProgressBars, width=200))
    does(display)
    display.finish_sweep()
    return out.getvalue()


SWEEP = [
    RunCost("fast", 10.0),
    RunCost("slow", 10.0),
    RunCost("fast", 40.0),
    RunCost("slow", 40.0),
    RunCost("fast", 100.0),
]


@pytest.mark.parametrize("kind", [ProgressLines, ProgressBars])
def test_the_time_left_follows_from_the_runs_of_each_kind(kind: Callable[..., ProgressDisplay], clock: list[float]):
    def run_display(display: ProgressDisplay) -> None:
        display.start_sweep(SWEEP)
        for effort, seconds in zip(SWEEP, (3.0, 5.0, 9.0, 35.0), strict=False):
            run = display.start_run("one", 10, effort)
            with report_activity(run.report_tick, COMPILING):
                clock[0] += 3000.0  # is no work
            clock[0] += seconds
            run.finish_run("ok")

    lines = capture_progress(kind, run_display)
    # 3 s come with any run. After the second one: fast 0 s and slow 0.2 s for each of the amount, so 3, 3 + 8 and 3 s.
    # After the third one: fast 0 + 6 s for 10 + 40, so 3 + 8 s and 3 + 12 s. After the fourth one 3 + 12 s.
    for seconds in (17, 26, 15):
        assert f"about {seconds} s left" in lines


@pytest.mark.parametrize("seed", range(3))
def test_the_time_left_is_right_within_a_factor_of_two_from_halfway_on(clock: list[float], seed: int):
    """Runs of some solvers whose times vary by a factor of 1,000, as those of hard cases do."""
    chance = random.Random(seed)
    costs = [RunCost(f"solver {chance.randrange(10)}", chance.choice((9.0, 36.0, 1024.0))) for _ in range(300)]
    seconds = [0.01 * 1000.0 ** chance.random() for _ in costs]
    pace = RemainingTime(costs)
    for k, cost in enumerate(costs):
        clock[0] += seconds[k]
        pace.record_run(cost, seconds[k])
        if is_estimate_wrong(pace.estimate_seconds() or 0.0, clock[0], sum(seconds)):
            pytest.fail(f"after {k} runs {clock[0]:.0f} of {sum(seconds):.0f} s, estimated {pace.estimate_seconds()}")


def test_a_run_that_is_done_elsewhere_is_left_out(clock: list[float]):
    pace = RemainingTime(SWEEP)
    pace.remove_run(SWEEP[-1])
    pace.record_run(SWEEP[0], 3.0)
    pace.record_run(SWEEP[1], 3.0)
    assert pace.estimate_seconds() == 2 * 3.0


def test_a_started_run_is_estimated_by_its_own_pace(clock: list[float]):
    def run_display(display: ProgressDisplay) -> None:
        display.start_sweep([RunCost(), RunCost()])
        display.start_run("one", 10, RunCost()).finish_run("ok")
        run = display.start_run("two", 10, RunCost())
        for _ in range(4):
            clock[0] += 12.0
            run.report_tick("timed pass")

    assert "40 %; about 72 s left" in capture_progress(ProgressLines, run_display)


def test_a_line_comes_though_no_run_ends(clock: list[float]):
    def run_display(display: ProgressDisplay) -> None:
        display.start_sweep([RunCost()])
        run = display.start_run("one", 10, RunCost())
        run.report_tick("timed pass")
        for _ in range(35):
            clock[0] += 1.0
            run.report_tick(POLL)

    lines = capture_progress(ProgressLines, run_display).splitlines()
    assert lines == ["[0/1] starting", *["[0/1] one: timed pass, 10 %"] * 3]


def test_progress_names_what_is_being_compiled(clock: list[float]):
    def run_display(display: ProgressDisplay) -> None:
        display.start_sweep([RunCost()])
        run = display.start_run("one", 10, RunCost())
        with report_activity(run.report_tick, COMPILING):
            clock[0] += 11.0
            run.report_tick(POLL)

    assert "one: compiling (once), 0 %" in capture_progress(ProgressLines, run_display)
