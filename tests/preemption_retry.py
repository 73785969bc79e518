"""Runs whose clocks are to be believed or not: what a busy machine took is done again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

MAX_ATTEMPTS = 50

RunResult = TypeVar("RunResult")


def retry_if_preempted(
    run: Callable[[], tuple[list[dict[str, Any]], RunResult]],
) -> tuple[list[dict[str, Any]], RunResult]:
    """What a run gives, rows first, once it was not interrupted, or failed: where much time was lost, clocks may
    differ by as much, and only the mark shows a false report. Raises AssertionError for a machine too busy."""
    for _ in range(MAX_ATTEMPTS):
        found = run()
        if not any(row.get("preempted") for row in found[0]):
            return found
    raise AssertionError(f"interrupted in each of {MAX_ATTEMPTS} attempts: another process took this one's time")
