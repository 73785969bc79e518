"""Folders of results that a page shows."""

from __future__ import annotations

import os
import re
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from springbench.harness.atomic_files import sanitise_name
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results import row_store

ROW_FOLDERS = ("rows", "accuracy", "ablation")
"""Subfolders for rows in a sweep's folder, by the command that produces them."""

_BENCHMARK_GLOB = "*bit/[0-9][0-9][0-9][0-9]_*.json"
"""Benchmark files as pytest-benchmark names them: numbered, in a folder for the system and the Python version."""


class SweepFolder(NamedTuple):
    """The folder of a sweep's results.

    Attributes:
        path: path of the folder.
        name: name that the page shows.
        slug: name of its data that is valid in files and URLs.
        relative_url: escaped URL of the folder relative to the page, with a trailing slash.
    """

    path: Path
    name: str
    slug: str
    relative_url: str


def find_benchmark_files(folder: Path) -> list[Path]:
    """Find the stored benchmark results in a folder."""
    return sorted(folder.glob(_BENCHMARK_GLOB))


def locate_folder(path: Path, results: Path) -> SweepFolder:
    """Return a sweep's folder as the page in `results` refers to it.

    Args:
        path: folder of the sweep, in `results` or equal to it.
        results: folder of the page.

    Raises:
        ValueError: `path` is not in `results`.
    """
    parts = path.relative_to(results).parts
    up = "".join(f"{quote(os.fsencode(part), safe='')}/" for part in parts)
    name = os.fsencode("/".join(parts) or path.resolve().name).decode(errors="replace")
    return SweepFolder(path, name, _make_slug(parts), f"./{up}")


def _make_slug(parts: tuple[str, ...]) -> str:
    """Make a unique name for a folder.

    It consists of its parts joined by ~, or of a hash if that is unsafe or ambiguous.
    """
    joined = "~".join(parts) or "this"
    unique = joined.count("~") == max(len(parts) - 1, 0) and parts != ("this",)
    if unique and re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._~-]{0,99}", joined):
        return joined
    return f"{sanitise_name(joined)[:80]}~~{sha256(os.fsencode('/'.join(parts))).hexdigest()[:12]}"


def find_folders(results: Path) -> list[SweepFolder]:
    """Find all sweep folders in a folder of results, or the folder of one sweep.

    Raises:
        InputError: if there is none.
    """
    if not results.is_dir():
        raise InputError(InputMistake("is no folder; expected a folder of results, or that of one sweep", results))
    found = {
        folder.parent
        for kind in ROW_FOLDERS
        for folder in row_store.find_row_folders(results, kind)
        if row_store.list_units(folder)
    }
    found |= {path.parent.parent for depth in ("", "*/") for path in results.glob(depth + _BENCHMARK_GLOB)}
    seen = [path for path in found if not any(part.startswith(".") for part in path.relative_to(results).parts)]
    if not seen:
        raise InputError(InputMistake("contains no rows; run a sweep first, or name a folder of results", results))
    return [locate_folder(path, results) for path in sorted(seen)]
