"""Failed runs grouped by cause: each cause in words, with the runs that it stopped."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

_NUMBER_PATTERN = re.compile(r"[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?", re.IGNORECASE)

MAX_CAUSES = 200
"""Maximum number of causes: more would not be an overview."""


class FailedRun(NamedTuple):
    """One failed run: scene, solver, status, reason and, if known, its id."""

    scene_label: str
    solver: str
    status: str
    reason: str
    run_id: str = ""


def group_failures(failed: Iterable[FailedRun]) -> list[dict[str, Any]]:
    """Group failed runs by cause, the most frequent first.

    Reasons that differ only in numbers, or in the names of their scene and solver, are one cause, described in the
    words of its first run.
    """
    groups: dict[tuple[str, str], list[FailedRun]] = {}
    for one in failed:
        groups.setdefault((one.status, _normalise_reason(one)), []).append(one)
    found = sorted(groups.values(), key=len, reverse=True)[:MAX_CAUSES]
    return [
        {
            "status": group[0].status,
            "reason": group[0].reason,
            "count": len(group),
            "has_varied_reasons": len({one.reason for one in group}) > 1,
            "solvers": Counter(one.solver for one in group).most_common(),
            "scenes": Counter(one.scene_label for one in group).most_common(),
            "run_id": group[0].run_id,
        }
        for group in found
    ]


def _normalise_reason(one: FailedRun) -> str:
    words = one.reason
    for name in sorted(
        {one.scene_label, one.solver, *one.scene_label.split(), one.solver.split(",")[0]}, key=len, reverse=True
    ):
        words = words.replace(name, "…") if len(name) > 2 else words
    return _NUMBER_PATTERN.sub("#", words)
