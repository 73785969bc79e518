"""Update of the results page: changed sweeps first, then the index."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

from harness.base import shelf
from harness.base.errors import InputError
from harness.base.files import replacing
from harness.report.site import script
from harness.report.site.assets import place
from harness.report.site.folders import KINDS, Folder, folder_of, folders, stored
from harness.report.site.overview import Overview, overview

SUMMARY = "summary.json"
"""File with a sweep's entry in the index, stored next to its data."""


def update(
    results: Path,
    *,
    only: Collection[Path] | None = None,
    recorded: bool = False,
    viewer: bool = False,
    say: Callable[[str], None] = lambda words: None,
) -> Path:
    """Update the results page, and return the path of `index.html`.

    Args:
        results: folder of results, or the folder of one sweep.
        only: folders of sweeps with new data; None for all.
        recorded: whether recordings, and meshes drawn from them, are converted to scripts.
        viewer: whether Rerun's viewer is added.
        say: prints a remark.
    Raises:
        InputError: if there are no rows.
        CannotWrite: if a file cannot be written.
    """
    found = folders(results) if only is None else [folder_of(path, results) for path in only]
    data, code = results / "site" / "data", place(results)
    for folder in found:
        home = data / folder.slug
        state = _state(folder, code, recorded)
        if _known(home).get("state") != state:
            _write(home, folder, overview(folder, home, recorded=recorded, say=say), state)
    if viewer and any(True for folder in found for _ in (data / folder.slug / "recordings").glob("*.js")):
        from harness.report.site.viewer import write_viewer

        write_viewer(results / "site")
    _index(results, data)
    return results / "index.html"


def keep(results: Path, folder: Path, say: Callable[[str], None], *, quiet: bool = False) -> None:
    """Update the page of all results with the new data of a sweep.

    It prints the path of the page unless `quiet`. If rows are damaged, it prints a remark instead of raising: the
    measured data is stored in any case.

    Args:
        results: folder of results.
        folder: folder of the sweep.
        say: prints a remark.
        quiet: whether to omit the path of the page.
    """
    try:
        page = update(results, only=[folder])
        if not quiet:
            say(f"all results are on one page: {page}")
    except InputError as error:
        say(f"the page of all results stays as it was: {error}")


def _write(home: Path, folder: Folder, found: Overview, state: str) -> None:
    for name, value in found.scripts.items():
        script.write(home / f"{name}.js", f"{folder.slug}/{name}", value)
    for old in home.glob("*.js"):
        if old.stem not in found.scripts:
            old.unlink()
    home.mkdir(parents=True, exist_ok=True)
    with replacing(home / SUMMARY) as partial:
        partial.write_text(json.dumps(found.summary | {"state": state}, allow_nan=False), encoding="utf-8")


def _known(home: Path) -> dict[str, Any]:
    """Read the summary written by the last update of a sweep.

    It is empty if the file is missing or incomplete.
    """
    try:
        return json.loads((home / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _state(folder: Folder, code: str, recorded: bool) -> str:
    """Return a hash of the state of a sweep's data.

    It changes with new data, or if this program would present them differently.
    """
    told: list[Any] = [code, recorded]
    for kind in KINDS:
        home = folder.path / kind
        own = [(home / f"{unit}.parquet").stat().st_mtime_ns for unit in shelf.own_files(home)]
        packed = shelf.packed_file(home)
        told += [len(own), max(own, default=0), packed.stat().st_mtime_ns if packed.exists() else 0]
    of_gates = [path.stat().st_mtime_ns for path in stored(folder.path)]
    told += [len(of_gates), max(of_gates, default=0)]
    for part in ("pictures", "recordings", "report"):
        told.append(sum(1 for _ in (folder.path / part).glob("*")))
    return sha256(repr(told).encode()).hexdigest()[:16]


def _called(results: Path) -> str:
    """Return the folder's path relative to the current directory.

    If the folder is elsewhere, only its name is returned.
    """
    there, here = results.resolve(), Path.cwd()
    return there.relative_to(here).as_posix() if there.is_relative_to(here) else there.name


def _index(results: Path, data: Path) -> None:
    """Write the index of all existing sweeps with a summary.

    The others are listed as absent.
    """
    there = {folder.slug: folder for folder in folders(results)}
    known = {slug: _known(data / slug) for slug in there}
    told = sorted((summary for summary in known.values() if summary), key=lambda s: s["to"] or "", reverse=True)
    value = {
        "title": results.resolve().name,
        "place": _called(results),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "sweeps": [{key: part for key, part in summary.items() if key != "state"} for summary in told],
        "absent": [there[slug].name for slug, summary in known.items() if not summary],
    }
    script.write(data / "index.js", "index", value)
