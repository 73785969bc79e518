"""Lists of the tests that take long: `slow.txt`, which the CI runs after the quick ones, and `long.txt`, run on demand.

    pytest -n 2 --dist loadfile -m 'not long' --find-slow 0.5 --find-long 5     on an idle machine, all kernels compiled

rewrites `slow.txt` and adds to `long.txt`. A line names a test, with or without its parameters, or a whole file. It
names a file where its tests share an expensive fixture, because the next of them would set it up. `compiling.txt` names
files of slow tests that are quick once their kernels, of rare methods and effects, are compiled: nothing rewrites it.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

TESTS_FOLDER = Path(__file__).parent
SLOW_LIST, LONG_LIST, COMPILING_LIST = (TESTS_FOLDER / f"{name}.txt" for name in ("slow", "long", "compiling"))

COMPILING_NAME_PARTS = (
    *("float16", "float32", "eigen", "cholmod"),  # kernels of their own, and programs in C++
    "cuda/",  # in a simulator, which is Python
    *("newton, absolute", "newton, trust-region", "newton, progressive"),  # what `newton, clamp` does, but for a rule
    *("test_a_balloon_of_a_thousand", "test_gas_is_minimised_where_its_sparse", "test_a_factor_in_single_precision"),
    "stability/test_properties",
)
"""Parts of names of slow tests in other files that are quick once their kernels are compiled."""


def read_names(path: Path) -> frozenset[str]:
    """Read the lines of a list."""
    return frozenset(path.read_text(encoding="utf-8").split("\n")) - {""}


def mark_slow_tests(items: list[pytest.Item]) -> None:
    """Mark tests `long` or `slow` by the lists; what is marked `long` in its file remains so."""
    slow, long = read_names(SLOW_LIST) | read_names(COMPILING_LIST), read_names(LONG_LIST)
    find_compiling = re.compile("|".join(map(re.escape, COMPILING_NAME_PARTS))).search
    for item in items:
        if item.get_closest_marker("long"):
            continue
        name = item.nodeid
        lines = {name, name.partition("[")[0], name.partition("::")[0]}
        if long & lines:
            item.own_markers[:] = [mark for mark in item.own_markers if mark.name != "slow"]  # marked so in its file
            item.add_marker(pytest.mark.long)
        elif slow & lines or find_compiling(name):
            item.add_marker(pytest.mark.slow)


class SlowTestFinder:
    """Sums the seconds of each test, and writes the lists in the end."""

    def __init__(self, slow_limit: float, long_limit: float) -> None:
        self._slow_limit, self._long_limit = slow_limit, long_limit
        self._tests: dict[str, float] = {}
        self._files: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        name = report.nodeid
        if report.when == "setup" and report.duration > self._slow_limit:
            self._files.add(name.partition("::")[0])
        self._tests[name] = self._tests.get(name, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        long = {name for name, seconds in self._tests.items() if seconds > self._long_limit}
        slow = {name for name, seconds in self._tests.items() if seconds > self._slow_limit}
        compiling = read_names(COMPILING_LIST)
        alone = {name for name in slow if name.partition("::")[0] not in self._files | compiling}
        write_names(SLOW_LIST, (self._files - compiling) | (alone - long))
        write_names(LONG_LIST, read_names(LONG_LIST) | long)


def write_names(path: Path, names: frozenset[str] | set[str]) -> None:
    """Write a list."""
    path.write_text("\n".join(sorted(names)) + "\n", encoding="utf-8")
