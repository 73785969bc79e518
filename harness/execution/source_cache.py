"""Cache of texts that depend only on the sources of this project.

A text is valid until a source changes. Building one imports all solvers, which takes a second or more.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version

from springbench.harness.atomic_files import WriteError, atomic_write, get_user_cache_dir
from springbench.solvers.jit import source_digest

_LIBRARIES = ("pydantic",)
"""Libraries that the text depends on."""
_MAX_STATES = 8
"""Number of stored texts of one name, so that several checkouts can use the cache."""


def read_cached_text(name: str, build_text: Callable[[], str], *inputs: str) -> str:
    """Return a text from the cache, or build it and store it if possible.

    Args:
        name: name of the text; the newest of this name are stored.
        build_text: builds it.
        inputs: what it depends on, besides the sources.
    """
    state = [source_digest.stamp_sources(), sys.version, *map(version, _LIBRARIES), *inputs]
    path = get_user_cache_dir("derived") / f"{name}-{hashlib.sha256(repr(state).encode()).hexdigest()[:16]}.txt"
    with suppress(OSError, UnicodeDecodeError):
        return path.read_text(encoding="utf-8")
    text = build_text()
    with suppress(OSError, WriteError):
        path.parent.mkdir(parents=True, exist_ok=True)
        stored = sorted(path.parent.glob(f"{name}-*.txt"), key=lambda text: text.stat().st_mtime)
        for older in stored[: max(0, len(stored) + 1 - _MAX_STATES)]:
            older.unlink(missing_ok=True)
        with atomic_write(path) as partial:
            partial.write_text(text, encoding="utf-8")
    return text
