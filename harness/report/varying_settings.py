"""Settings in which runs of one solver differ: labels state these alone."""

from __future__ import annotations

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
