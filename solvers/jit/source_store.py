"""What was read from the sources of this project, stored for the user until one of them changes.

The store is valid for one state: time, time of change, size and number of every file. No edit leaves all of these.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_MAX_STATES = 8
"""Number of stored states, which serve as many checkouts."""
_SETTLING_NS = 2 * 10**9
"""Age [ns] from which a file is stored: two edits of a younger one can have the same time."""


class SourceFacts(NamedTuple):
    """Content digest of a source, in hexadecimal digits, and the paths of the sources that it imports or compiles."""

    digest: str
    imports: list[str]


def read_facts(states: Mapping[str, os.stat_result]) -> dict[str, SourceFacts]:
    """Return the stored facts by path, for this state of all sources; empty if there are none."""
    with suppress(OSError, ValueError, TypeError, IndexError):
        paths, facts = json.loads(_find_file(states).read_text(encoding="utf-8"))
        return {
            path: SourceFacts(digest, [paths[k] for k in imports])
            for path, (digest, imports) in zip(paths, facts, strict=True)
        }
    return {}


def store_facts(states: Mapping[str, os.stat_result], facts: Mapping[str, SourceFacts]) -> None:
    """Store the facts of all sources if possible.

    Args:
        states: state of each source before it was read.
        facts: facts of each of these sources.
    """
    import tempfile  # takes 10 ms, and is rarely needed

    path, paths = _find_file(states), sorted(facts)
    numbers = {name: k for k, name in enumerate(paths)}
    text = json.dumps([paths, [(facts[name].digest, [numbers[one] for one in facts[name].imports]) for name in paths]])
    youngest = max(max(found.st_mtime_ns, found.st_ctime_ns) for found in states.values())
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        number, partial = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(text)
        is_settled = youngest < os.stat(partial).st_mtime_ns - _SETTLING_NS
        if not is_settled or _find_file({name: os.stat(name) for name in states}) != path:  # edited while it was read
            os.unlink(partial)
            return
        os.replace(partial, path)
        stored = sorted(path.parent.glob("*.json"), key=lambda one: one.stat().st_mtime)
        for older in stored[:-_MAX_STATES]:
            older.unlink(missing_ok=True)


def _find_file(states: Mapping[str, os.stat_result]) -> Path:
    described = [(path, *_describe_state(found)) for path, found in sorted(states.items())]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench" / "sources"
    return folder / f"{hashlib.sha256(repr(described).encode()).hexdigest()[:32]}.json"


def _describe_state(found: os.stat_result) -> tuple[int, ...]:
    return found.st_mtime_ns, found.st_ctime_ns, found.st_size, found.st_ino
