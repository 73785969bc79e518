"""The folders of results that a page is about."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from harness.base import shelf
from harness.base.errors import InputError, Mistake

KINDS = ("rows", "accuracy", "ablation")
"""The folders of rows that a sweep's folder may have, by what made them."""

_STORED = "*bit/[0-9][0-9][0-9][0-9]_*.json"
"""Results of gates, as pytest-benchmark calls them: in a folder for the system and Python, by number."""


class Folder(NamedTuple):
    """A sweep's results. path; name: for people; slug: of its data, a name that files and URLs take; up: the way to it
    from the page, with a slash at its end, or empty where the page lies in it."""

    path: Path
    name: str
    slug: str
    up: str


def stored(folder: Path) -> list[Path]:
    """The stored results of gates in a folder."""
    return sorted(folder.glob(_STORED))


def folder_of(path: Path, results: Path) -> Folder:
    """A sweep's folder as the page in `results` sees it."""
    parts = path.relative_to(results).parts
    up = f"{'/'.join(parts)}/" if parts else ""
    return Folder(path, "/".join(parts) or path.resolve().name, "~".join(parts) or "this", up)


def folders(results: Path) -> list[Folder]:
    """All of them in a folder of results, or that of one sweep. Raises InputError where there is none."""
    if not results.is_dir():
        raise InputError(Mistake("is no folder; wanted a folder of results, or that of one sweep", results))
    found = {folder.parent for kind in KINDS for folder in shelf.folders(results, kind) if shelf.units(folder)}
    found |= {path.parent.parent for depth in ("", "*/") for path in results.glob(depth + _STORED)}
    seen = [path for path in found if not any(part.startswith(".") for part in path.relative_to(results).parts)]
    if not seen:
        raise InputError(Mistake("holds no rows; run a sweep first, or name a folder of results", results))
    return [folder_of(path, results) for path in sorted(seen)]
