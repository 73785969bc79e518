"""Update of the results page: changed sweeps first, then the index."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from springbench.harness.atomic_files import atomic_write
from springbench.harness.errors import InputError
from springbench.harness.execution.optional_parts import RECORDINGS
from springbench.harness.report.site import data_scripts
from springbench.harness.report.site.page_assets import install_assets
from springbench.harness.report.site.sweep_folders import (
    ROW_FOLDERS,
    SweepFolder,
    find_benchmark_files,
    find_folders,
    locate_folder,
)
from springbench.harness.results import row_store

if TYPE_CHECKING:
    from springbench.harness.report.site.sweep_overview import SweepOverview

SUMMARY_FILE = "summary.json"
"""File with a sweep's entry in the index, stored next to its data."""


def update_page(
    results: Path,
    *,
    changed_folders: Collection[Path] | None = None,
    with_recordings: bool = False,
    with_viewer: bool = False,
    print_message: Callable[[str], None] = lambda words: None,
) -> Path:
    """Update the results page, and return the path of `index.html`.

    Args:
        results: folder of results, or the folder of one sweep.
        changed_folders: folders of sweeps with new data; None for all.
        with_recordings: whether recordings, and meshes drawn from them, are converted to scripts.
        with_viewer: whether Rerun's viewer is added.
        print_message: prints a remark.

    Raises:
        InputError: if there are no rows.
        WriteError: if a file cannot be written.
    """
    found = (
        find_folders(results) if changed_folders is None else [locate_folder(path, results) for path in changed_folders]
    )
    data, code = results / "site" / "data", install_assets(results)
    for folder in found:
        home = data / folder.slug
        state = _sweep_state(folder, code, with_recordings)
        if _read_summary(home).get("fingerprint") != state:
            from springbench.harness.report.site.sweep_overview import (
                build_overview,  # takes half a second to load, with all charts
            )

            _write_sweep(
                home,
                folder,
                build_overview(folder, home, with_recordings=with_recordings, print_message=print_message),
                state,
            )
    replays = (path for folder in found for path in (data / folder.slug / "recordings").glob("*.js"))
    if with_viewer and RECORDINGS.is_installed() and any(replays):
        from springbench.harness.report.site.rerun_viewer import write_viewer

        write_viewer(results / "site")
    _write_index(results, data)
    return results / "index.html"


def refresh_results_page(
    results: Path, folder: Path, print_message: Callable[[str], None], *, is_quiet: bool = False
) -> None:
    """Update the page of all results with the new data of a sweep.

    It prints the path of the page unless `is_quiet`. If rows are damaged, it prints a remark instead of raising: the
    measured data is stored in any case.

    Args:
        results: folder of results.
        folder: folder of the sweep.
        print_message: prints a remark.
        is_quiet: whether to omit the path of the page.
    """
    try:
        page = update_page(results, changed_folders=[folder])
        if not is_quiet:
            print_message(f"all results are on one page: {page}")
    except InputError as error:
        print_message(f"the page of all results was not changed: {error}")


def _write_sweep(data_folder: Path, folder: SweepFolder, content: SweepOverview, state: str) -> None:
    for name, value in content.scripts.items():
        data_scripts.write_script(data_folder / f"{name}.js", f"{folder.slug}/{name}", value)
    for old in data_folder.glob("*.js"):
        if old.stem not in content.scripts:
            old.unlink()
    data_folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(data_folder / SUMMARY_FILE) as partial:
        partial.write_text(json.dumps(content.summary | {"fingerprint": state}, allow_nan=False), encoding="utf-8")


def _read_summary(data_folder: Path) -> dict[str, Any]:
    """Read the summary written by the last update of a sweep.

    It is empty if the file is missing or incomplete.
    """
    try:
        return json.loads((data_folder / SUMMARY_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _sweep_state(folder: SweepFolder, code: str, with_recordings: bool) -> str:
    """Return a hash of the state of a sweep's data.

    It changes with new data, or if this program would present them differently.
    """
    state: list[Any] = [code, with_recordings]
    for kind in ROW_FOLDERS:
        home = folder.path / kind
        own = [(home / f"{unit}.parquet").stat().st_mtime_ns for unit in row_store.list_unit_files(home)]
        packed = row_store.build_packed_path(home)
        state += [len(own), max(own, default=0), packed.stat().st_mtime_ns if packed.exists() else 0]
    of_benchmarks = [path.stat().st_mtime_ns for path in find_benchmark_files(folder.path)]
    state += [len(of_benchmarks), max(of_benchmarks, default=0)]
    for part in ("pictures", "recordings", "report"):
        state.append(sum(1 for _ in (folder.path / part).glob("*")))
    return sha256(repr(state).encode()).hexdigest()[:16]


def _command_path(results: Path) -> str:
    """Return the folder's path relative to the current directory.

    If the folder is elsewhere, only its name is returned.
    """
    there, here = results.resolve(), Path.cwd()
    return there.relative_to(here).as_posix() if there.is_relative_to(here) else there.name


def _write_index(results: Path, data: Path) -> None:
    """Write the index of all existing sweeps with a summary.

    The others are listed as absent.
    """
    there = {folder.slug: folder for folder in find_folders(results)}
    known = {slug: _read_summary(data / slug) for slug in there}
    entries = sorted(
        (summary for summary in known.values() if summary), key=lambda s: s["last_started_at"] or "", reverse=True
    )
    value = {
        "title": results.resolve().name,
        "results_path": _command_path(results),
        "written_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "sweeps": [{key: part for key, part in summary.items() if key != "fingerprint"} for summary in entries],
        "unwritten_sweeps": [there[slug].name for slug, summary in known.items() if not summary],
    }
    data_scripts.write_script(data / "index.js", "index", value)
