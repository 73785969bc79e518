"""`pytest tests/bench --benchmark-only` runs the gates, prints their ratios and stores their times under results/bench.
`-k accuracy` runs the goals of accuracy alone."""

import os
from typing import Any

import pytest
from springbench.harness.execution.machine_info import collect_versions
from threadpoolctl import threadpool_info

from tests.bench.gates import THREADS


def pytest_configure(config: pytest.Config) -> None:
    # This runs before pytest-benchmark reads its options.
    if config.option.benchmark_only:
        config.option.benchmark_enable = True
        config.option.benchmark_storage = f"file://{config.rootpath / 'results' / 'bench'}"
        config.option.benchmark_save = config.option.benchmark_save or "gates"
        config.option.benchmark_save_data = True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """The gates that were measured, as a table."""
    session: Any = getattr(config, "_benchmarksession", None)
    measured = [one for one in session.benchmarks if "max_ratio" in one.extra_info] if session else []
    for one in measured:
        ratio, limit, goal = (one.extra_info.get(key) for key in ("ratio", "max_ratio", "goal"))
        target = goal or limit
        verdict = "pass" if ratio["high"] <= target else "fail" if ratio["low"] > target else "inconclusive"
        and_limit = f", limit {limit:.3g}" if goal else ""
        terminalreporter.write_line(
            f"{one.name.removeprefix('test_the_gate_holds'):48} {ratio['median']:9.3g} [{ratio['low']:.3g}, "
            f"{ratio['high']:.3g}], target {target:.3g}: {verdict}{and_limit}"
        )


def pytest_benchmark_update_machine_info(machine_info: dict[str, Any]) -> None:
    # What is stored may be published: it tells of the machine's kind and not whose it is, and holds
    # nothing that changes from one run to the next, so that two files compare.
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
    """Without timing, goals of accuracy have nothing to say: what they solve takes seconds, and nothing is compared."""
    if config.option.benchmark_disable and not config.option.benchmark_enable:
        idle = [item for item in items if item.name.startswith("test_the_gate_holds[accuracy-")]
        config.hook.pytest_deselected(items=idle)
        items[:] = [item for item in items if item not in idle]
