"""What every test shares: the libraries' settings, and properties that are the same in every run."""

from __future__ import annotations

from hypothesis import settings

import harness  # noqa: F401  sets what Numba and OpenMP read when they load

# derandomize: the same examples in every run; no deadline: a slow machine fails no test.
settings.register_profile("suite", derandomize=True, deadline=None, max_examples=40, database=None)
settings.load_profile("suite")
