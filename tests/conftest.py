"""What every test shares: the libraries' settings, and properties that are the same in every run."""

from __future__ import annotations

import gc

from hypothesis import settings

import harness  # noqa: F401  sets what Numba and OpenMP read when they load

# derandomize: the same examples in every run; no deadline: a slow machine fails no test.
settings.register_profile("suite", derandomize=True, deadline=None, max_examples=40, database=None)
# `pytest --hypothesis-profile=search tests/stability` looks for examples that fail, for an hour; keep them as cases.
settings.register_profile("search", deadline=None, max_examples=2000, database=None, print_blob=True)
settings.load_profile("suite")


def pytest_collection_finish() -> None:
    """What is there now stays: collections of garbage, automatic or asked for, need not look at it again."""
    gc.collect()
    gc.freeze()
