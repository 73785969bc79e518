"""What every test shares: the libraries' settings, and properties that are the same in every run."""

from __future__ import annotations

import functools
import gc
import math
import os
import tempfile
from collections.abc import Generator
from typing import Any

import pytest
import springbench  # noqa: F401  sets what Numba and OpenMP read when they load
import typer.testing
from hypothesis import settings
from springbench.harness.atomic_files import get_user_cache_dir

from tests import slow_tests

# Two processes run tests on two cores: threads of OpenBLAS in each would spin while they wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A test with a cache folder of its own does not compile all kernels for it.
os.environ.setdefault("NUMBA_CACHE_DIR", str(get_user_cache_dir("kernels")))

# What commands time in tests waits for no other's.
_LOCK_FOLDER = tempfile.TemporaryDirectory(prefix="springbench-locks-")
os.environ["SPRINGBENCH_LOCKS"] = _LOCK_FOLDER.name

# Of an app, all whose commands hundreds of tests invoke, Typer's runner makes Click's again each time, in 40 ms.
_TYPER_TESTING: Any = typer.testing
_TYPER_TESTING._get_command = functools.cache(_TYPER_TESTING._get_command)

# derandomize: the same examples in every run; no deadline: a slow machine fails no test.
settings.register_profile("suite", derandomize=True, deadline=None, max_examples=40, database=None)
# `pytest --hypothesis-profile=search tests/stability` looks for examples that fail, for an hour; keep them as cases.
settings.register_profile("search", deadline=None, max_examples=2000, database=None, print_blob=True)
settings.load_profile("suite")


_COMPILING_FILE = "solver_contract.py"
"""It calls nearly all kernels, and has them compiled where they are not there yet, which is before the slow tests."""
_KERNEL_FREE_PREFIXES = (
    *("worker", "user_code", "hostile_plugins", "shared_folders", "reproduce", "publish", "device.py", "new_study"),
    *("kill_and_resume", "page.py", "accuracy.py", "bare_", "stale", "damaged", "full_disk", "plugins", "hostile"),
    *("regress", "pytest_plugin", "abba"),
)
"""Files that need few of them: what runs meanwhile, so that no kernel is compiled twice at once. The first ones start
workers, which are forks of this process as long as no thread of Numba or Rerun runs in it, and else import everything
again. Long ones follow, which should not be the last."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--find-slow", type=float, metavar="SECONDS", help="write tests/slow.txt: what takes longer")
    parser.addoption(
        "--find-long", type=float, default=math.inf, metavar="SECONDS", help="add to tests/long.txt what takes longer"
    )


def pytest_configure(config: pytest.Config) -> None:
    limit: float | None = config.getoption("--find-slow")
    if limit and not hasattr(config, "workerinput"):  # the test runner's processes report to the first
        config.pluginmanager.register(slow_tests.SlowTestFinder(limit, config.getoption("--find-long")))


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files go to the test runner's processes in this order, which its `--no-loadscope-reorder` preserves."""
    compiles = config.option.markexpr != "slow"

    def order(item: pytest.Item) -> int:
        name = item.path.name.removeprefix("test_")
        if compiles and name == _COMPILING_FILE:
            return -1
        return next(
            (rank for rank, start in enumerate(_KERNEL_FREE_PREFIXES) if name.startswith(start)),
            len(_KERNEL_FREE_PREFIXES),
        )

    items.sort(key=order)
    slow_tests.mark_slow_tests(items)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection() -> Generator[None, object, object]:
    """Hardly anything that is made while tests are collected is garbage."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish() -> None:
    """What is there now stays: collections of garbage, automatic or requested, need not look at it again."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs, and their pictures, are made in this process: for tests whose subject is no worker, which takes seconds."""
    from springbench.harness.execution import isolated_worker

    monkeypatch.setattr(isolated_worker, "can_isolate_processes", lambda: False)
