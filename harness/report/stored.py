"""Comparison of two stored results, folders or archives of rows.

It finds regressions in time, and other changes. Runs are paired by their inputs, and compared step by step
(`harness.base.statistics.changed`). The load of the machine may have differed between the two
results, and statistics cannot detect that: hence a margin beyond the interval, and `springbench gate --against` for
smaller changes. Times of two machines are not comparable; with a baseline solver that both ran, the ratios to it are.
"""

from __future__ import annotations

import shutil
import tarfile
import zipfile
from collections import defaultdict
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from harness.base import rows, shelf, statistics
from harness.base.console import narrow
from harness.base.errors import InputError, Mistake

CANNOT_TELL = 3
"""Exit code if valid results have nothing comparable: 2 would mean an invalid file, and 0 or 1 would be untrue."""

MARGIN = 0.10
"""Margin beyond the interval: minima of two runs of the same code differ by up to 4 % on an idle machine, more on
others.
"""

ASKED = (
    *("scene", "size", "solver", "parameters", "time_step", "integrator", "first_guess", "max_iterations"),
    *("tolerance", "threads"),
)
"""Columns that identify the same run in two results."""

_ROWS, _MOST = ".parquet", 2**31
"""Suffix of the files that are unpacked from an archive, and their maximum total size [bytes]."""

Row = Mapping[str, Any]
Key = tuple[Any, ...]


@dataclass(frozen=True, slots=True, eq=False)
class StoredRun:
    """The rows of a run in summary.

    Attributes:
        row: first row of the run.
        status: "ok", or the first other status.
        seconds: time of each frame's step [s], the minimum over its rounds.
        iterations: total over all frames.
        residual: residual of the last frame, if known.
        error: stationarity of the last frame, if known.
        digest: digest of the last positions, if known.
    """

    row: Row
    status: str
    seconds: dict[int, float]
    iterations: int | None
    residual: float | None
    error: float | None
    digest: str | None

    @property
    def name(self) -> str:
        """Scene, size, solver and parameters of the run."""
        size = f" {self.row['size']}" if self.row["size"] else ""
        given = "" if self.row["parameters"] in (None, "{}") else f" {self.row['parameters']}"
        return f"{self.row['scene']}{size} {self.row['solver']}{given}"


def compare(old: Path, new: Path, console: Console, yardstick: str | None = None) -> int:
    """Print what changed from `old` to `new`.

    Args:
        old: folder or archive of the old results.
        new: folder or archive of the new results.
        console: console that the table is printed on.
        yardstick: times are divided by those of this solver, so that they are comparable between machines.
    Returns: 1 if a run became slower or fails now; CANNOT_TELL, after the reasons, if nothing is comparable;
        otherwise 0.
    Raises:
        InputError: if there are no results, or none of the baseline solver.
    """
    was, now = read(old), read(new)
    for path, runs in ((old, was), (new, now)):
        if yardstick is not None and all(run.row["solver"] != yardstick for run in runs.values()):
            raise InputError(Mistake(f"{yardstick} was not run in {path}; wanted a solver of both", key="--yardstick"))
    table = Table(
        "run", "old", "new", "change", "verdict", "iterations", "residual", "error", "last positions", box=SIMPLE_HEAD
    )
    refused, bad, compared = dict[str, str](), 0, 0
    for key in was | now:
        if key not in was or key not in now:
            side, lone = ("new", now[key]) if key not in was else ("vanished", was[key])
            table.add_row(escape(lone.name), *("", "", "", side))
            continue
        before, after = was[key], now[key]
        reason = _incomparable(before, after, yardstick)
        units = (1e3, 1e3) if yardstick is None else tuple(_unit(runs, key, yardstick) for runs in (was, now))
        if not reason and None in units:
            reason = f"{yardstick} was not run beside it in both"
        if reason:
            refused[before.name] = reason
            continue
        compared += 1
        figures, verdict = _judged(before, after, units)
        bad += verdict in ("slower", "fails now")
        table.add_row(escape(before.name), *figures, verdict, *_beside(before, after))
    if not compared:
        said = "; ".join(dict.fromkeys(refused.values())) or "they have no run in common"
        console.print(f"cannot tell: {old} and {new} cannot be compared: {said}", markup=False)
        return CANNOT_TELL
    console.print(narrow(table))
    for name, reason in refused.items():
        console.print(f"not compared: {name}: {reason}", markup=False)
    if yardstick:
        console.print(f"times are multiples of those of {yardstick}", markup=False)
    console.print(f"{bad} of {compared} became slower or fail now" if bad else f"nothing of {compared} became slower")
    return 1 if bad else 0


def read(path: Path) -> dict[Key, StoredRun]:
    """Read the runs in a folder or archive of results, by their inputs.

    Raises:
        InputError: if there are no rows or they cannot be read.
    """
    with _folder(path) as folder:
        files = [unit for of_rows in shelf.folders(folder, "rows") for unit in shelf.units(of_rows)]
        if not files:
            raise InputError(
                Mistake("holds no rows (rows/*.parquet); wanted results that `springbench run` left", path)
            )
        with rows.memory_for(files):
            found = rows.read(files).to_pylist()
    runs: dict[Key, list[Row]] = defaultdict(list)
    for row in found:
        runs[tuple(row[name] for name in ASKED)].append(row)
    return {key: _run(of) for key, of in runs.items()}


@contextmanager
def _folder(path: Path) -> Generator[Path]:
    """Yield the folder itself, or a temporary folder with the unpacked archive."""
    if path.is_dir():
        yield path
        return
    wanted = "wanted a folder of results, an archive of one (.zip, .tar.*), or pytest-benchmark's (.json)"
    if not path.is_file():  # a device or a pipe would be read for ever
        raise InputError(Mistake(f"is {'no file' if path.exists() else 'not there'}; {wanted}", path))
    with TemporaryDirectory() as scratch:
        try:
            if zipfile.is_zipfile(path):
                with zipfile.ZipFile(path) as packed:
                    members = [info for info in packed.infolist() if info.filename.endswith(_ROWS)]
                    _require_room(path, sum(info.file_size for info in members))
                    packed.extractall(scratch, members)  # names that lead out of the folder are made to stay in it
            elif tarfile.is_tarfile(path):
                with tarfile.open(path) as packed:
                    inside = [info for info in packed if info.isfile() and info.name.endswith(_ROWS)]
                    _require_room(path, sum(info.size for info in inside))
                    for info in inside:  # not `extractall`: its safe filter is not in every Python 3.11
                        _unpack(packed, info, Path(scratch))
            else:
                raise InputError(Mistake(wanted, path))
        except (OSError, zipfile.BadZipFile, tarfile.TarError) as error:
            raise InputError(Mistake(f"cannot be unpacked: {error}", path)) from error
        yield Path(scratch)


def _unpack(packed: tarfile.TarFile, info: tarfile.TarInfo, folder: Path) -> None:
    """Unpack a regular file of an archive, always inside the folder, whatever its name."""
    inside = [part for part in PurePosixPath(info.name).parts if part not in ("/", "..")]
    target, source = folder.joinpath(*inside), packed.extractfile(info)
    assert source is not None, "only links and folders have no content"
    target.parent.mkdir(parents=True, exist_ok=True)
    with source, target.open("wb") as copy:
        shutil.copyfileobj(source, copy)


def _require_room(path: Path, unpacked: int) -> None:
    if unpacked > _MOST:
        raise InputError(Mistake(f"its rows take {unpacked:,} bytes unpacked; wanted {_MOST:,} at most", path))


def _run(found: Sequence[Row]) -> StoredRun:
    steps = [row for row in found if row["phase"] == "step" and row["frame"] is not None]
    once = {row["frame"]: row for row in steps}
    last: Row = once[max(once)] if once else {}
    counted = [row["iterations"] for row in once.values() if row["iterations"] is not None]
    return StoredRun(
        found[0],
        next((row["status"] for row in found if row["status"] != "ok"), "ok"),
        statistics.least((row["frame"], row["seconds"]) for row in steps),
        sum(counted) if counted else None,
        *(last.get(name) for name in ("residual", "stationarity", "digest")),
    )


def _incomparable(old: StoredRun, new: StoredRun, yardstick: str | None) -> str:
    """Return why two times are not comparable; empty if they are."""
    if old.status != "ok":
        return f"there is no old time: {old.status}"
    if old.row["machine"] != new.row["machine"] and yardstick is None:
        where = [f"{run.row['cpu']}, {run.row['cores']} cores" for run in (old, new)]
        return f"other machines ({where[0]}; {where[1]}); --yardstick SOLVER compares ratios to one that both ran"
    return ""


def _unit(runs: Mapping[Key, StoredRun], key: Key, yardstick: str) -> float | None:
    """Return 1 / (median step time of the baseline [s]).

    The baseline has the same scene, size and steps; None if it was not run.
    """
    at = {name: key[ASKED.index(name)] for name in ("scene", "size", "time_step", "integrator", "threads")}
    found = [run for run in runs.values() if run.row["solver"] == yardstick and run.status == "ok" and run.seconds]
    found = [run for run in found if all(run.row[name] == value for name, value in at.items())]
    return 1 / float(np.median(list(found[0].seconds.values()))) if found else None


def _judged(old: StoredRun, new: StoredRun, units: Sequence[float | None]) -> tuple[tuple[str, str, str], str]:
    """Return both times, their change with its interval, and its class.

    Classes are slower, faster, unchanged and fails now.
    """
    if new.status != "ok":
        return ("", "", ""), "fails now"
    frames = sorted(set(old.seconds) & set(new.seconds))
    was, now = ({f: run.seconds[f] * (unit or 1) for f in frames} for run, unit in zip((old, new), units, strict=True))
    ratio, low, high = statistics.changed(now, was)
    slower, faster = low > 1 + MARGIN, high * (1 + MARGIN) < 1
    told = [f"{float(np.median([*x.values()])):.4g}" for x in (was, now)]
    change = f"{100 * (ratio - 1):+.1f} % [{100 * (low - 1):+.1f}, {100 * (high - 1):+.1f}]"
    return (told[0], told[1], change), "slower" if slower else "faster" if faster else "unchanged"


def _beside(old: StoredRun, new: StoredRun) -> tuple[str, str, str, str]:
    """Compare iterations, residual, stationarity error and last positions."""
    told: list[str] = []
    for name in ("iterations", "residual", "error"):
        was, now = getattr(old, name), getattr(new, name)
        same = was == now or was is None or now is None
        told.append(("" if now is None else f"{now:.4g}") if same else f"{was:.4g} -> {now:.4g}")
    known = old.digest is not None and new.digest is not None
    return told[0], told[1], told[2], ("the same" if old.digest == new.digest else "others") if known else ""
