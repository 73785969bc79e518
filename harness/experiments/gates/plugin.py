"""Plugin for pytest with performance tests, based on pytest-benchmark.

    def test_mine_is_no_slower(race):
        race(mine, theirs, limit=1.03)                                  # two functions of no arguments

    def test_my_solver_is_no_slower(race):
        race.solvers("cloth.yaml", Mine(), "numba", limit=1.0, agree=1e-6)      # on a scene

Both must give the same answer, in every test run. With pytest-benchmark enabled they are then timed in interleaved
blocks, and pytest-benchmark's JSON has the result. An inconclusive test is neither passed nor failed: it is counted as
`undecided`. A session without failures then ends with the exit code 13, because 3 is pytest's code of internal errors.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import pytest

if TYPE_CHECKING:
    from pytest_benchmark.fixture import BenchmarkFixture

    from harness.experiments.gates.abba import Result
    from harness.experiments.gates.scenes import Given, Work

UNDECIDED = pytest.StashKey[bool]()
EXIT_UNDECIDED = 13
MOST = 10**9
"""Number of rounds requested from pytest-benchmark; the benchmark ends earlier."""


class _Decided(BaseException):
    """Ends the rounds of pytest-benchmark; an Exception would mark the benchmark as failed."""


class Race:
    """Fixture that compares two programs, or two solvers on a scene; one comparison per test."""

    def __init__(self, benchmark: BenchmarkFixture, item: pytest.Item) -> None:
        self._benchmark, self._item = benchmark, item
        self._budget: float = item.config.option.race_budget

    def __call__(
        self,
        candidate: Work,
        yardstick: Work,
        *,
        limit: float,
        clock: Literal["cpu", "wall"] = "cpu",
        agree: float | None = 0.0,
        budget: float | None = None,
        error: float | None = None,
        **told: Any,
    ) -> Result | None:
        """Fail the test if the candidate is too slow compared with the baseline.

        It may take at most limit times as long.

        Args:
            candidate: function without arguments.
            yardstick: function without arguments.
            limit: limit of the ratio of times.
            clock: "cpu" for the CPU time of the process, "wall" for elapsed time.
            agree: tolerance of the difference of the answers, relative to their size; None if there are none.
            budget: seconds; --race-budget by default.
            error: probability of a wrong verdict; 0.1 % by default.
            told: stored in the benchmark's JSON.
        Returns: the result, or None if nothing is timed.
        """
        from harness.experiments.gates.abba import playing
        from harness.experiments.gates.agreement import difference
        from harness.experiments.gates.scenes import calls_of, timed
        from harness.experiments.gates.sequential import ALPHA, Rule, Verdict

        rule, benchmark = Rule(limit, error or ALPHA), cast(Any, self._benchmark)
        answer: Any = benchmark.pedantic(candidate) if benchmark.disabled else candidate()
        if agree is not None:
            said = difference(answer, yardstick(), agree)
            if said:
                pytest.fail(f"the answers differ, so nothing was timed: {said}", pytrace=False)
        elif not benchmark.disabled:
            yardstick()
        if benchmark.disabled:
            return None
        calls = calls_of(candidate, yardstick)
        a, b = (timed(work, calls, clock) for work in (candidate, yardstick))
        found: list[Result] = []
        last: list[float] = []
        game = playing(b, rule, budget=budget or self._budget)

        def before() -> None:
            try:
                game.send(last.pop()) if last else next(game)
            except StopIteration as done:
                found.append(done.value)
                raise _Decided from None

        with suppress(_Decided):
            benchmark.pedantic(lambda: last.append(a()), setup=before, rounds=MOST)
        (result,) = found
        benchmark.extra_info |= told | _told(result, calls, clock)
        if result.answer is Verdict.UNDECIDED:
            self._item.stash[UNDECIDED] = True
            pytest.skip(str(result))
        if result.answer is Verdict.FAILS:
            pytest.fail(str(result), pytrace=False)
        return result

    def solvers(
        self,
        scene: str | os.PathLike[str],
        solver: Given,
        against: Given,
        *,
        limit: float,
        agree: float | None = 1e-9,
        clock: Literal["cpu", "wall"] = "cpu",
        budget: float | None = None,
        size: int | None = None,
        **options: Any,
    ) -> Result | None:
        """Compare two solvers on a scene.

        Args:
            scene: file of the scene, relative to the test's file.
            solver: the candidate: a name, a mapping of name and parameters, or a solver object.
            against: solver to compare with, in the same form.
            limit: limit of the ratio of times.
            agree: tolerance of the difference of the positions, relative to the scene's size.
            clock: "cpu" or "wall".
            budget: seconds; --race-budget by default.
            size: mesh size; the scene's default if omitted.
            options: options of a run: iterations, tolerance, frames, integrator, time_step, first_guess.
        Returns: the result, or None if nothing is timed.
        """
        from harness.base.machine import pinned_threads
        from harness.experiments.gates.scenes import pair

        with pinned_threads(1):
            both = pair(self._item.path.parent / Path(scene), solver, against, size=size, **options)
            return self(*both, limit=limit, clock=clock, agree=agree, budget=budget)


def _told(result: Result, calls: int, clock: str) -> dict[str, Any]:
    """Build the entries of the benchmark's `extra_info`."""
    found = result.interval
    return {
        "ratio": {"median": found.ratio, "low": max(found.low, 1e-300), "high": min(found.high, 1e300)},  # no inf
        "limit": result.rule.limit,
        "answer": result.answer.name.lower(),
        "error": result.rule.alpha,
        "turns": len(result.turns),
        "calls": calls,
        "clock": clock,
        "load": round(result.load, 2),
    }


@pytest.fixture
def race(benchmark: BenchmarkFixture, request: pytest.FixtureRequest) -> Race:
    """Compare the times of two programs, or of two solvers on a scene.

    Their answers are checked first.
    """
    return Race(benchmark, request.node)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the plugin's command-line options."""
    group = parser.getgroup("springbench")
    group.addoption("--race-budget", type=float, default=60.0, help="Seconds that a race may take; 60.")


class _Count:
    """Counts inconclusive tests; with xdist in the process that reports."""

    def __init__(self) -> None:
        self.undecided = 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.undecided += getattr(report, "undecided", False)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        if exitstatus == 0 and self.undecided:
            session.exitstatus = EXIT_UNDECIDED


def pytest_configure(config: pytest.Config) -> None:
    """Register the counter of inconclusive tests."""
    config.pluginmanager.register(_Count(), "springbench-undecided")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Mark the report of an inconclusive test."""
    report = yield
    if report.when == "call" and report.skipped and item.stash.get(UNDECIDED, False):
        report.undecided = True  # type: ignore[attr-defined]
    return report


def pytest_report_teststatus(report: pytest.TestReport) -> tuple[str, str, tuple[str, dict[str, bool]]] | None:
    """Report an inconclusive test as `?`."""
    if getattr(report, "undecided", False):
        return "undecided", "?", ("UNDECIDED", {"yellow": True})
    return None


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the inconclusive tests with their reasons."""
    for report in terminalreporter.stats.get("undecided", []):
        said = report.longrepr[2].removeprefix("Skipped: ")
        terminalreporter.write_line(f"UNDECIDED {report.nodeid}: {said}")
