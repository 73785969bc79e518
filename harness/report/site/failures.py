"""What did not succeed, by cause: each cause once, in words, with the runs that it stopped."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

_NUMBER = re.compile(r"[-+]?\d+(?:[.,]\d+)*(?:e[-+]?\d+)?", re.IGNORECASE)

MOST = 200
"""So many causes at most: more of them are no overview."""


class Failed(NamedTuple):
    """One run that did not succeed: where and by whom, its status and the reason; run: its id, if it has one."""

    where: str
    solver: str
    status: str
    reason: str
    run: str = ""


def causes(failed: Iterable[Failed]) -> list[dict[str, Any]]:
    """The causes, the most frequent first. Reasons that differ in numbers, or in the names of their scene and solver,
    are one cause, told in the words of its first run."""
    groups: dict[tuple[str, str], list[Failed]] = {}
    for one in failed:
        groups.setdefault((one.status, _cause(one)), []).append(one)
    found = sorted(groups.values(), key=len, reverse=True)[:MOST]
    return [
        {
            "status": group[0].status,
            "reason": group[0].reason,
            "count": len(group),
            "varied": len({one.reason for one in group}) > 1,
            "solvers": Counter(one.solver for one in group).most_common(),
            "where": Counter(one.where for one in group).most_common(),
            "run": group[0].run,
        }
        for group in found
    ]


def _cause(one: Failed) -> str:
    words = one.reason
    for name in sorted({one.where, one.solver, *one.where.split(), one.solver.split(",")[0]}, key=len, reverse=True):
        words = words.replace(name, "…") if len(name) > 2 else words
    return _NUMBER.sub("#", words)
