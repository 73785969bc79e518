"""Garbage collection of a command: rare, except while units are executed.

Imports create 10^5 objects that stay, which each full collection examines again.
"""

from __future__ import annotations

import gc

_USUAL_THRESHOLD = gc.get_threshold()
_RARE_THRESHOLD = 300_000
"""Number of new objects that start a collection."""


def postpone_collections() -> None:
    """Collect garbage rarely from here on."""
    gc.set_threshold(_RARE_THRESHOLD)


def resume_collections() -> None:
    """Collect garbage as often as before `postpone_collections`."""
    if gc.get_threshold()[0] == _RARE_THRESHOLD:
        gc.set_threshold(*_USUAL_THRESHOLD)


def skip_final_collections() -> None:
    """Exclude all objects from the collections at the end of the process."""
    gc.freeze()
