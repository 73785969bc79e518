"""Provenance of rows: code version and machine in words, and whether other code measured them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from springbench.harness.execution import machine_info
from springbench.harness.report.number_format import shorten_words

_DIRTY_SUFFIX = "-dirty"
PROVENANCE_COLUMNS = ("cpu", "threads", "commit", "source_fingerprint")
"""The columns that `describe_provenance` reads."""


def is_stale(fingerprint: str | None, newest_fingerprint: str | None = None) -> bool:
    """Return whether other code measured a row; rows without a fingerprint count as current.

    Args:
        fingerprint: source fingerprint of the row; None or "" if it is unknown.
        newest_fingerprint: code of the newest rows, as on the results page; None to compare with the current version.
    """
    return bool(fingerprint) and fingerprint != (
        machine_info.hash_sources() if newest_fingerprint is None else newest_fingerprint
    )


def abbreviate_commit(commit: str) -> str:
    """Abbreviate a commit.

    A suffix marks modified files, because no checkout contains the code that was run.
    """
    return f"{commit:.7}{_DIRTY_SUFFIX if commit.endswith(_DIRTY_SUFFIX) else ''}"


def describe_commits(values: Iterable[object]) -> list[str]:
    """Return the common commit in words, or the number of commits.

    The result is empty if none is known.
    """
    found = sorted({str(commit) for commit in values if commit})
    return [f"commit {abbreviate_commit(found[0])}" if len(found) == 1 else f"{len(found)} commits"] if found else []


def describe_processors(values: Iterable[object]) -> list[str]:
    """Describe the processors, or their number if there are more than two."""
    found = sorted({str(cpu) for cpu in values if cpu})
    return [shorten_words(cpu, 60) for cpu in found] if len(found) <= 2 else [f"{len(found)} kinds of processors"]


def describe_machine_and_commit(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Describe processor and commit of rows, or of the properties of recordings."""
    return [*describe_processors(row.get("cpu") for row in rows), *describe_commits(row.get("commit") for row in rows)]


def describe_provenance(rows: Sequence[Mapping[str, Any]]) -> str:
    """Describe processor, threads, commit and source fingerprint of rows."""
    threads, codes = (sorted({row[key] for row in rows if row.get(key)}) for key in ("threads", "source_fingerprint"))
    words = [*describe_processors(row.get("cpu") for row in rows)]
    words += [f"{', '.join(map(str, threads))} thread{'s' if threads != [1] else ''}"] if threads else []
    words += describe_commits(row.get("commit") for row in rows)
    words += [f"code {', '.join(codes)}" if len(codes) <= 2 else f"{len(codes)} codes"] if codes else []
    return ", ".join(words)
