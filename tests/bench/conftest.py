"""Configure timed sessions: `pytest tests/bench --benchmark-only` runs the short gates, and prints their ratios.

The times are stored under results/bench. `--all-gates` runs all gates, `-k accuracy` those on accuracy alone.
"""

import os
from time import monotonic
from typing import Any

import pytest
from springbench.harness.execution.machine_info import collect_versions
from springbench.harness.experiments.regression.pytest_plugin import DEFAULT_BUDGET
from threadpoolctl import threadpool_info

from tests.bench.gates import THREADS

SHORT_BUDGET = 30.0
"""Time limit of a gate of the short set [s]: six of them, with their scenes, take four minutes."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all-gates", action="store_true", help="With --benchmark-only: run all gates; takes hours.")


def is_short_set(config: pytest.Config) -> bool:
    """Return whether a timed session selects no gates by name, so that it runs the short ones."""
    arguments = config.invocation_params.args
    is_selective = any(str(one).startswith(("-k", "-m", "--last-failed")) or "::" in str(one) for one in arguments)
    return config.option.benchmark_only and not is_selective


class RemainingTime:
    """Prints after each gate the number of completed ones, and the estimated remaining time."""

    def __init__(self, config: pytest.Config, count: int, budget: float) -> None:
        self.reporter: Any = config.pluginmanager.get_plugin("terminalreporter")
        self.count, self.done, self.start = count, 0, monotonic()
        self.print_line(f"{count} gates, at most {budget:g} s each and a start of some seconds")

    def print_line(self, words: str) -> None:
        self.reporter.ensure_newline()
        self.reporter.write_line(words)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            self.done += 1
            left = (monotonic() - self.start) / self.done * (self.count - self.done)
            self.print_line(f" {self.done} of {self.count} gates, about {left:.0f} s left")


def pytest_configure(config: pytest.Config) -> None:
    # This runs before pytest-benchmark reads its options.
    if config.option.benchmark_only:
        if config.getoption("--all-gates", default=False):
            config.option.markexpr = ""
        elif is_short_set(config):
            config.option.markexpr = "short"
            if config.option.paired_benchmark_budget == DEFAULT_BUDGET:
                config.option.paired_benchmark_budget = SHORT_BUDGET
        config.option.benchmark_enable = True
        config.option.benchmark_storage = f"file://{config.rootpath / 'results' / 'bench'}"
        config.option.benchmark_save = config.option.benchmark_save or "gates"
        config.option.benchmark_save_data = True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print a table of the measured gates."""
    session: Any = getattr(config, "_benchmarksession", None)
    measured = [one for one in session.benchmarks if "max_ratio" in one.extra_info] if session else []
    for one in measured:
        ratio, limit, goal = (one.extra_info.get(key) for key in ("ratio", "max_ratio", "goal"))
        target = goal or limit
        verdict = "pass" if ratio["high"] <= target else "fail" if ratio["low"] > target else "inconclusive"
        and_limit = f", limit {limit:.3g}" if goal else ""
        terminalreporter.write_line(
            f"{one.name.removeprefix('test_the_gate_passes'):48} {ratio['median']:9.3g} [{ratio['low']:.3g}, "
            f"{ratio['high']:.3g}], target {target:.3g}: {verdict}{and_limit}"
        )


def pytest_collection_finish(session: pytest.Session) -> None:
    config = session.config
    if config.option.benchmark_only and session.items and not hasattr(config, "workerinput"):
        remaining = RemainingTime(config, len(session.items), config.option.paired_benchmark_budget)
        config.pluginmanager.register(remaining, "remaining-time")


def pytest_benchmark_update_machine_info(machine_info: dict[str, Any]) -> None:
    # Stored results may be published. They describe the type of the machine without its name, and contain nothing that
    # changes from one run to the next, so that two files are comparable.
    del machine_info["node"]
    machine_info["cpu"] = {key: machine_info["cpu"].get(key) for key in ("brand_raw", "arch", "count")}
    machine_info["affinity"] = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    machine_info["versions"] = collect_versions()
    machine_info["threads"] = THREADS
    machine_info["blas"] = [
        {key: library[key] for key in ("internal_api", "version")}
        for library in threadpool_info()
        if library["user_api"] == "blas"
    ]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect gates on accuracy in sessions without timing: their solves take seconds, and nothing is compared."""
    if config.option.benchmark_disable and not config.option.benchmark_enable:
        accuracy_gates = [item for item in items if item.name.startswith("test_the_gate_passes[accuracy-")]
        config.hook.pytest_deselected(items=accuracy_gates)
        items[:] = [item for item in items if item not in accuracy_gates]
