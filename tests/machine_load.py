"""How much longer things take because other processes share the cores."""

from __future__ import annotations

import os


def shares_per_core() -> float:
    """The number of processes that want a core, at least 1: wall-clock limits are multiplied by it."""
    return max(1.0, max(os.getloadavg()) / len(os.sched_getaffinity(0)))
