"""Ratios of times to a reference method on the same scene: what may be compared between machines.

A ratio has an interval. Of runs it is the 95 % interval over the steps (`bootstrap_statistics.estimate_slowdown`), of
whole simulations the range over the rounds. Both are widened by OTHER_MACHINE_FACTOR, because another processor has
other vector units and caches.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple

from springbench.harness.results import bootstrap_statistics
from springbench.harness.results.published_set import RUN_KEYS

OTHER_MACHINE_FACTOR = 2.0
"""Factor by which a ratio may differ on another machine; archives are verified with the same one."""

REFERENCE_SOLVERS = ("numba", "sparse", "hybrid", "newton")
"""Solvers that serve as reference, the first that a scene has."""

MethodKey = tuple[Any, ...]


class MethodTimeRatio(NamedTuple):
    """Time of a method over that of the reference method, with the interval in which a repetition must lie.

    Attributes:
        scene, size: the scene.
        method: values of `published_set.RUN_KEYS` after scene and size.
        reference: those of the reference method.
    """

    scene: str
    size: int
    method: MethodKey
    reference: MethodKey
    ratio: float
    low: float
    high: float

    @property
    def title(self) -> str:
        """Scene, size, solver and reference solver, for messages."""
        return f"{self.scene} {self.size or ''}: {self.method[0]} over {self.reference[0]}"


def compute_time_ratios(rows: Iterable[Mapping[str, Any]]) -> list[MethodTimeRatio]:
    """Compute the ratio of each method of a scene and size to the reference method there.

    Args:
        rows: rows of timed runs, or rows of the kind `work` of accuracy studies.
    """
    times: dict[tuple[str, int], dict[MethodKey, dict[int, float]]] = {}
    for row in rows:
        method = tuple(row.get(name) for name in RUN_KEYS[2:])
        steps = times.setdefault((row["scene"], row["size"]), {}).setdefault(method, {})
        for key, seconds in _list_times(row):
            steps[key] = min(seconds, steps.get(key, seconds))
    found: list[MethodTimeRatio] = []
    for (scene, size), methods in times.items():
        timed = {method: steps for method, steps in methods.items() if steps}
        reference = _choose_reference(list(timed))
        found += [
            _build_ratio(scene, size, (method, steps), (reference, timed[reference]))
            for method, steps in timed.items()
            if reference is not None and method != reference and steps.keys() & timed[reference].keys()
        ]
    return found


def _list_times(row: Mapping[str, Any]) -> list[tuple[int, float]]:
    """List the times of a row by step, or by round of a whole simulation [s]."""
    found: list[tuple[int, float]] = []
    if row.get("kind") == "work":
        found = list(enumerate(row["seconds"] or ()))
    elif row.get("phase") == "step" and row["frame"] is not None and row["seconds"] is not None:
        found = [(row["frame"], row["seconds"])]
    return [(key, seconds) for key, seconds in found if 0.0 < seconds < math.inf]


def _choose_reference(methods: Sequence[MethodKey]) -> MethodKey | None:
    for solver in REFERENCE_SOLVERS:
        if own := [method for method in methods if method[0] == solver]:
            return min(own, key=str)
    return min(methods, key=str, default=None)


def _build_ratio(
    scene: str, size: int, ours: tuple[MethodKey, dict[int, float]], theirs: tuple[MethodKey, dict[int, float]]
) -> MethodTimeRatio:
    found = bootstrap_statistics.estimate_slowdown(ours[1], theirs[1])
    if len(ours[1].keys() & theirs[1].keys()) < 2:
        middle = median(ours[1].values()) / median(theirs[1].values())
        found = bootstrap_statistics.ConfidenceInterval(middle, middle, middle)
    low, high = found.low / OTHER_MACHINE_FACTOR, found.high * OTHER_MACHINE_FACTOR
    return MethodTimeRatio(scene, size, ours[0], theirs[0], found.estimate, low, high)
