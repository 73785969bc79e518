"""Cases of which some are tried in every run of the tests, and the others with `-m long`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def mark_rare_cases(cases: Iterable[Any], frequent_cases: Sequence[Any]) -> list[Any]:
    """The cases, tuples of several parameters among them, all but the selected ones marked as long.

    Raises ValueError for a selected one that is no case.
    """
    cases = list(cases)
    if unknown := [case for case in frequent_cases if case not in cases]:
        raise ValueError(f"no such cases: {unknown}")
    values = [(case, case if isinstance(case, tuple) else (case,)) for case in cases]
    return [pytest.param(*of, marks=() if case in frequent_cases else pytest.mark.long) for case, of in values]
