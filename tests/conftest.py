"""What every test shares: idle threads that do not spin, and properties that are the same in every run."""

from __future__ import annotations

import os

# Numba's and BLAS's waiting threads would take the cores from each other; read when their libraries load.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from hypothesis import settings

# derandomize: the same examples in every run; no deadline: a slow machine fails no test.
settings.register_profile("suite", derandomize=True, deadline=None, max_examples=40, database=None)
settings.load_profile("suite")
