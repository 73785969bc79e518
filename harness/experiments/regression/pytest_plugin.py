"""Plugin for pytest with performance tests, based on pytest-benchmark.

    def test_new_code_is_no_slower(paired_benchmark):
        paired_benchmark(new, old, max_ratio=1.03)  # two functions without arguments

    def test_new_solver_is_no_slower(paired_benchmark):
        paired_benchmark.compare_solvers("cloth.yaml", New(), "numba", max_ratio=1.0, agreement_rtol=1e-6)

Both must give the same answer, in every test run. With pytest-benchmark enabled they are then timed in interleaved
blocks, as by `springbench regress gates.yaml`, and pytest-benchmark's JSON has the result. An inconclusive test is
neither passed nor failed: it is counted as `inconclusive`. A session without failures then ends with the exit code 13,
because 3 is pytest's code of internal errors.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal, cast

import pytest

if TYPE_CHECKING:
    from pytest_benchmark.fixture import BenchmarkFixture
    from springbench.harness.experiments.regression.abba_benchmark import BenchmarkResult
    from springbench.harness.experiments.regression.program_pair import WorkFunction
    from springbench.harness.experiments.regression.solver_pair import SolverInput

INCONCLUSIVE_KEY = pytest.StashKey[bool]()
EXIT_INCONCLUSIVE = 13
DEFAULT_BUDGET = 60.0
"""Seconds that a paired benchmark may take."""
MAX_ROUNDS = 10**9
"""Number of rounds requested from pytest-benchmark; the benchmark ends earlier."""


class _BenchmarkDecided(BaseException):
    """Ends the rounds of pytest-benchmark; an Exception would mark the benchmark as failed."""


class PairedBenchmark:
    """Fixture that compares two programs, or two solvers on a scene; one comparison per test."""

    def __init__(self, benchmark: BenchmarkFixture, item: pytest.Item) -> None:
        self._benchmark, self._item = benchmark, item
        self._budget: float = item.config.option.paired_benchmark_budget

    def __call__(
        self,
        candidate: WorkFunction,
        baseline: WorkFunction,
        *,
        max_ratio: float,
        clock: Literal["cpu", "wall"] = "cpu",
        agreement_rtol: float | None = 0.0,
        budget: float | None = None,
        alpha: float | None = None,
        **extra_info: Any,
    ) -> BenchmarkResult | None:
        """Fail the test if the ratio of times, candidate over baseline, exceeds `max_ratio`.

        Args:
            candidate: function without arguments.
            baseline: function without arguments.
            max_ratio: limit of the ratio of times.
            clock: "cpu" for the CPU time of the process, "wall" for elapsed time.
            agreement_rtol: tolerance of the difference of the answers, relative to their size; None if there are none.
            budget: seconds; --paired-benchmark-budget by default.
            alpha: probability of a wrong verdict; 0.1 % by default.
            extra_info: stored in the benchmark's JSON.

        Returns:
            The result, or None if nothing is timed.
        """
        from springbench.harness.experiments.regression.abba_benchmark import iterate_paired_benchmark
        from springbench.harness.experiments.regression.confidence_sequence import DEFAULT_ALPHA, SequentialTest
        from springbench.harness.experiments.regression.program_pair import (
            AnswersDiffer,
            build_program_pair,
            require_agreement,
        )
        from springbench.harness.results.regression_verdict import RegressionVerdict

        sequential_test = SequentialTest(max_ratio, DEFAULT_ALPHA if alpha is None else alpha)
        benchmark = cast(Any, self._benchmark)
        answer: Any = benchmark.pedantic(candidate) if benchmark.disabled else candidate()
        if agreement_rtol is not None:
            try:
                require_agreement(answer, baseline(), agreement_rtol)
            except AnswersDiffer as error:
                pytest.fail(str(error), pytrace=False)
        elif not benchmark.disabled:
            baseline()  # warm-up
        if benchmark.disabled:
            return None
        programs = build_program_pair(candidate, baseline, clock)
        results: list[BenchmarkResult] = []
        seconds: list[float] = []
        blocks = iterate_paired_benchmark(
            programs.b, sequential_test, time_budget=self._budget if budget is None else budget
        )

        def advance_blocks() -> None:
            try:
                blocks.send(seconds.pop()) if seconds else next(blocks)
            except StopIteration as done:
                results.append(done.value)
                raise _BenchmarkDecided from None

        with suppress(_BenchmarkDecided):
            benchmark.pedantic(lambda: seconds.append(programs.a()), setup=advance_blocks, rounds=MAX_ROUNDS)
        (result,) = results
        benchmark.extra_info |= extra_info | _build_extra_info(result, programs.num_calls, clock)
        if result.verdict is RegressionVerdict.INCONCLUSIVE:
            self._item.stash[INCONCLUSIVE_KEY] = True
            pytest.skip(str(result))
        if result.verdict is RegressionVerdict.FAIL:
            pytest.fail(str(result), pytrace=False)
        return result

    def compare_solvers(
        self,
        scene: str | os.PathLike[str],
        solver: SolverInput,
        baseline: SolverInput,
        *,
        max_ratio: float,
        agreement_rtol: float | None = 1e-9,
        clock: Literal["cpu", "wall"] = "cpu",
        budget: float | None = None,
        alpha: float | None = None,
        size: int | None = None,
        **options: Any,
    ) -> BenchmarkResult | None:
        """Compare two solvers on a scene.

        Args:
            scene: file of the scene, relative to the test's file; or name of a shipped scene.
            solver: the candidate: a name, a mapping of name and parameters, or a solver object.
            baseline: solver to compare with, in the same form.
            max_ratio: limit of the ratio of times.
            agreement_rtol: tolerance of the difference of the positions, relative to the scene's size.
            clock: "cpu" or "wall".
            budget: seconds; --paired-benchmark-budget by default.
            alpha: probability of a wrong verdict; 0.1 % by default.
            size: mesh size; the scene's default if omitted.
            options: options of a run: max_iterations, rtol, frames, integrator, time_step, initial_guess.

        Returns:
            The result, or None if nothing is timed.
        """
        from springbench.harness.config.shipped_configs import resolve_scene_path
        from springbench.harness.execution.machine_info import limit_threads
        from springbench.harness.experiments.regression.solver_pair import prepare_solver_pair

        with limit_threads(1):
            path = resolve_scene_path(os.fspath(scene), self._item.path.parent)
            both = prepare_solver_pair(path, solver, baseline, size=size, **options)
            return self(
                *both, max_ratio=max_ratio, clock=clock, agreement_rtol=agreement_rtol, budget=budget, alpha=alpha
            )


def _build_extra_info(result: BenchmarkResult, num_calls: int, clock: str) -> dict[str, Any]:
    """Build the entries of the benchmark's `extra_info`."""
    found = result.interval
    return {
        "ratio": {"median": found.ratio, "low": max(found.low, 1e-300), "high": min(found.high, 1e300)},  # no inf
        "max_ratio": result.sequential_test.max_ratio,
        "verdict": str(result.verdict),
        "alpha": result.sequential_test.alpha,
        "num_blocks": len(result.blocks),
        "num_calls": num_calls,
        "clock": clock,
        "load_average": round(result.load_average, 2),
    }


@pytest.fixture
def paired_benchmark(benchmark: BenchmarkFixture, request: pytest.FixtureRequest) -> PairedBenchmark:
    """Compare the times of two programs, or of two solvers on a scene.

    Their answers are checked first.

    Args:
        benchmark: fixture of pytest-benchmark, which records the times.
        request: request of the test, to whose folder paths of scenes are relative.
    """
    return PairedBenchmark(benchmark, request.node)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the plugin's command-line options."""
    group = parser.getgroup("springbench")
    group.addoption(
        "--paired-benchmark-budget",
        type=float,
        default=DEFAULT_BUDGET,
        help=f"Seconds that a paired benchmark may take; {DEFAULT_BUDGET:g}.",
    )


class _InconclusiveCounter:
    """Counts inconclusive tests; with xdist in the process that reports."""

    def __init__(self) -> None:
        self.num_inconclusive = 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.num_inconclusive += getattr(report, "inconclusive", False)

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        if exitstatus == 0 and self.num_inconclusive:
            session.exitstatus = EXIT_INCONCLUSIVE


def pytest_configure(config: pytest.Config) -> None:
    """Register the counter of inconclusive tests."""
    config.pluginmanager.register(_InconclusiveCounter(), "springbench-inconclusive")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Mark the report of an inconclusive test."""
    report = yield
    if report.when == "call" and report.skipped and item.stash.get(INCONCLUSIVE_KEY, False):
        report.inconclusive = True  # type: ignore[attr-defined]
    return report


def pytest_report_teststatus(report: pytest.TestReport) -> tuple[str, str, tuple[str, dict[str, bool]]] | None:
    """Report an inconclusive test as `?`."""
    if getattr(report, "inconclusive", False):
        return "inconclusive", "?", ("INCONCLUSIVE", {"yellow": True})
    return None


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the inconclusive tests with their reasons."""
    for report in terminalreporter.stats.get("inconclusive", []):
        reason = report.longrepr[2].removeprefix("Skipped: inconclusive: ")
        terminalreporter.write_line(f"INCONCLUSIVE {report.nodeid}: {reason}")
