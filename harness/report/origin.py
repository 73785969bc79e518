"""Provenance of rows in words: code version and machine, for pictures, figures and the page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from harness.record.base import Replay
from harness.report.page import shorten, text
from harness.report.style import MUTED, WIDTH

_DIRTY = "-dirty"
NEEDED = ("cpu", "threads", "commit", "code")
"""The columns that `measured_on` reads."""


def abridged(commit: str) -> str:
    """Abbreviate a commit.

    A suffix marks modified files, because no checkout contains the code that was run.
    """
    return f"{commit:.7}{_DIRTY if commit.endswith(_DIRTY) else ''}"


def commits(known: Iterable[object]) -> list[str]:
    """Return the common commit in words, or the number of commits.

    The result is empty if none is known.
    """
    found = sorted({str(commit) for commit in known if commit})
    return [f"commit {abridged(found[0])}" if len(found) == 1 else f"{len(found)} commits"] if found else []


def processors(known: Iterable[object]) -> list[str]:
    """Describe the processors, or their number if there are more than two."""
    found = sorted({str(cpu) for cpu in known if cpu})
    return [shorten(cpu, 60) for cpu in found] if len(found) <= 2 else [f"{len(found)} kinds of processors"]


def machine_and_commit(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Describe processor and commit of rows, or of the properties of recordings."""
    return [*processors(row.get("cpu") for row in rows), *commits(row.get("commit") for row in rows)]


def measured_on(rows: Sequence[Mapping[str, Any]]) -> str:
    """Describe processor, threads, commit and source fingerprint of rows."""
    threads, codes = (sorted({row[key] for row in rows if row.get(key)}) for key in ("threads", "code"))
    words = [*processors(row.get("cpu") for row in rows)]
    words += [f"{', '.join(map(str, threads))} thread{'s' if threads != [1] else ''}"] if threads else []
    words += commits(row.get("commit") for row in rows)
    words += [f"code {', '.join(codes)}" if len(codes) <= 2 else f"{len(codes)} codes"] if codes else []
    return ", ".join(words)


def made_by(page: Figure, replays: Iterable[Replay], y: float) -> None:
    """Draw machine and code version of recordings, right-aligned.

    Args:
        page: figure to draw on.
        replays: recordings.
        y: distance of the baseline from the top [pixels].
    """
    words = machine_and_commit([replay.properties for replay in replays])
    text(page, WIDTH - 36, y, "   ·   ".join(words), size=9, color=MUTED, ha="right")
