"""Settings in which runs of one solver differ: labels state these alone."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any


def find_varying_keys(settings: Iterable[Mapping[str, Any]]) -> set[str]:
    """Find the keys whose values differ among settings.

    Args:
        settings: settings of each run; a missing one has its default value, as one that is None.
    """
    listed = list(settings)
    keys = {key for one in listed for key in one}
    return {key for key in keys if any(one.get(key) != listed[0].get(key) for one in listed)}


def find_varying_by_solver(settings: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, set[str]]:
    """Find the keys whose values differ among the settings of each solver.

    Args:
        settings: name of the solver and settings of each run.
    """
    by_solver: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for solver, own in settings:
        by_solver[solver].append(own)
    return {solver: find_varying_keys(some) for solver, some in by_solver.items()}
