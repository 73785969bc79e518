"""Verdicts of performance regression tests, in rows, messages and exit codes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import StrEnum


class RegressionVerdict(StrEnum):
    """Whether something became slower than allowed."""

    PASS = "pass"
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"

    @property
    def exit_code(self) -> int:
        """Exit code of a command that ends with this verdict.

        It is never 2, the exit code for a mistake of the user.
        """
        return {RegressionVerdict.PASS: 0, RegressionVerdict.FAIL: 1, RegressionVerdict.INCONCLUSIVE: 3}[self]


def combine_verdicts(verdicts: Iterable[RegressionVerdict]) -> RegressionVerdict:
    """Combine the verdicts of several tests.

    The result is FAIL if any test fails, PASS if there are tests and all pass, and INCONCLUSIVE otherwise.
    """
    found = set(verdicts)
    if RegressionVerdict.FAIL in found:
        return RegressionVerdict.FAIL
    return RegressionVerdict.PASS if found == {RegressionVerdict.PASS} else RegressionVerdict.INCONCLUSIVE


def describe_counts(verdicts: Iterable[RegressionVerdict]) -> str:
    """Describe how many of the verdicts are of each kind: `2 pass, 1 inconclusive`."""
    counts = Counter(verdicts)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in RegressionVerdict if counts[verdict])
