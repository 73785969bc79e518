"""Comparison of two stored results, folders or archives of rows.

It finds regressions in time, and other changes. Runs are paired by their inputs, and compared step by step
(`springbench.harness.results.bootstrap_statistics.estimate_slowdown`). The load of the machine may have differed
between the two
results, and statistics cannot detect that: hence a margin beyond the interval, and `springbench regress --against` for
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
from springbench.harness.console import split_wide_table
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results import bootstrap_statistics, parquet_rows, row_store

INCONCLUSIVE_EXIT_CODE = 3
"""Exit code if valid results have nothing comparable: 2 would mean an invalid file, and 0 or 1 would be untrue."""

REGRESSION_MARGIN = 0.10
"""Margin beyond the interval: minima of two runs of the same code differ by up to 4 % on an idle machine, more on
others.
"""

PAIRING_COLUMNS = (
    *("scene", "size", "solver", "parameters", "time_step", "integrator", "initial_guess", "max_iterations"),
    *("residual_rtol", "threads"),
)
"""Columns that identify the same run in two results."""

_ROWS_SUFFIX, _MAX_UNPACKED_BYTES = ".parquet", 2**31
"""Suffix of the files that are unpacked from an archive, and their maximum total size [bytes]."""

ResultRow = Mapping[str, Any]
RunKey = tuple[Any, ...]


@dataclass(frozen=True, slots=True, eq=False)
class StoredRun:
    """The rows of a run in summary.

    Attributes:
        row: first row of the run.
        status: "ok", or the first other status.
        seconds_by_frame: time of each frame's step [s], the minimum over its rounds.
        num_iterations: total over all frames.
        last_residual: residual of the last frame, if known.
        last_stationarity: stationarity of the last frame, if known.
        positions_digest: digest of the last positions, if known.
    """

    row: ResultRow
    status: str
    seconds_by_frame: dict[int, float]
    num_iterations: int | None
    last_residual: float | None
    last_stationarity: float | None
    positions_digest: str | None

    @property
    def run_label(self) -> str:
        """Scene, size, solver and parameters of the run."""
        size = f" {self.row['size']}" if self.row["size"] else ""
        given = "" if self.row["parameters"] in (None, "{}") else f" {self.row['parameters']}"
        return f"{self.row['scene']}{size} {self.row['solver']}{given}"


def compare_results(old: Path, new: Path, console: Console, baseline_solver: str | None = None) -> int:
    """Print what changed from `old` to `new`.

    Args:
        old: folder or archive of the old results.
        new: folder or archive of the new results.
        console: console that the table is printed on.
        baseline_solver: times are divided by those of this solver, so that they are comparable between machines.
    Returns: 1 if a run became slower or fails now; INCONCLUSIVE_EXIT_CODE, after the reasons, if nothing is comparable;
        otherwise 0.
    Raises:
        InputError: if there are no results, or none of the baseline solver.
    """
    was, now = read_stored_runs(old), read_stored_runs(new)
    for path, runs in ((old, was), (new, now)):
        if baseline_solver is not None and all(run.row["solver"] != baseline_solver for run in runs.values()):
            raise InputError(
                InputMistake(f"{baseline_solver} was not run in {path}; wanted a solver of both", key="--yardstick")
            )
    table = Table(
        "run", "old", "new", "change", "verdict", "iterations", "residual", "error", "last positions", box=SIMPLE_HEAD
    )
    refused, bad, compared = dict[str, str](), 0, 0
    for key in was | now:
        if key not in was or key not in now:
            side, lone = ("new", now[key]) if key not in was else ("vanished", was[key])
            table.add_row(escape(lone.run_label), *("", "", "", side))
            continue
        before, after = was[key], now[key]
        reason = _incomparable_reason(before, after, baseline_solver)
        units = (
            (1e3, 1e3)
            if baseline_solver is None
            else tuple(_baseline_scale(runs, key, baseline_solver) for runs in (was, now))
        )
        if not reason and None in units:
            reason = f"{baseline_solver} was not run beside it in both"
        if reason:
            refused[before.run_label] = reason
            continue
        compared += 1
        figures, verdict = _classify_change(before, after, units)
        bad += verdict in ("slower", "fails now")
        table.add_row(escape(before.run_label), *figures, verdict, *_compare_other_quantities(before, after))
    if not compared:
        said = "; ".join(dict.fromkeys(refused.values())) or "they have no run in common"
        console.print(f"cannot tell: {old} and {new} cannot be compared: {said}", markup=False)
        return INCONCLUSIVE_EXIT_CODE
    console.print(split_wide_table(table))
    for name, reason in refused.items():
        console.print(f"not compared: {name}: {reason}", markup=False)
    if baseline_solver:
        console.print(f"times are multiples of those of {baseline_solver}", markup=False)
    console.print(f"{bad} of {compared} became slower or fail now" if bad else f"nothing of {compared} became slower")
    return 1 if bad else 0


def read_stored_runs(path: Path) -> dict[RunKey, StoredRun]:
    """Read the runs in a folder or archive of results, by their inputs.

    Raises:
        InputError: if there are no rows or they cannot be read.
    """
    with _open_results(path) as folder:
        files = [
            unit for of_rows in row_store.find_row_folders(folder, "rows") for unit in row_store.list_units(of_rows)
        ]
        if not files:
            raise InputError(
                InputMistake("holds no rows (rows/*.parquet); wanted results that `springbench run` left", path)
            )
        with parquet_rows.limit_read_memory(files):
            found = parquet_rows.read_rows(files).to_pylist()
    runs: dict[RunKey, list[ResultRow]] = defaultdict(list)
    for row in found:
        runs[tuple(row[name] for name in PAIRING_COLUMNS)].append(row)
    return {key: _build_stored_run(of) for key, of in runs.items()}


@contextmanager
def _open_results(path: Path) -> Generator[Path]:
    """Yield the folder itself, or a temporary folder with the unpacked archive."""
    if path.is_dir():
        yield path
        return
    wanted = "wanted a folder of results, an archive of one (.zip, .tar.*), or pytest-benchmark's (.json)"
    if not path.is_file():  # a device or a pipe would be read for ever
        raise InputError(InputMistake(f"is {'no file' if path.exists() else 'not there'}; {wanted}", path))
    with TemporaryDirectory() as scratch:
        try:
            if zipfile.is_zipfile(path):
                with zipfile.ZipFile(path) as packed:
                    members = [info for info in packed.infolist() if info.filename.endswith(_ROWS_SUFFIX)]
                    _require_unpacked_size(path, sum(info.file_size for info in members))
                    packed.extractall(scratch, members)  # names that lead out of the folder are made to stay in it
            elif tarfile.is_tarfile(path):
                with tarfile.open(path) as packed:
                    inside = [info for info in packed if info.isfile() and info.name.endswith(_ROWS_SUFFIX)]
                    _require_unpacked_size(path, sum(info.size for info in inside))
                    for info in inside:  # not `extractall`: its safe filter is not in every Python 3.11
                        _unpack_member(packed, info, Path(scratch))
            else:
                raise InputError(InputMistake(wanted, path))
        except (OSError, zipfile.BadZipFile, tarfile.TarError) as error:
            raise InputError(InputMistake(f"cannot be unpacked: {error}", path)) from error
        yield Path(scratch)


def _unpack_member(packed: tarfile.TarFile, info: tarfile.TarInfo, folder: Path) -> None:
    """Unpack a regular file of an archive, always inside the folder, whatever its name."""
    inside = [part for part in PurePosixPath(info.name).parts if part not in ("/", "..")]
    target, source = folder.joinpath(*inside), packed.extractfile(info)
    assert source is not None, "only links and folders have no content"
    target.parent.mkdir(parents=True, exist_ok=True)
    with source, target.open("wb") as copy:
        shutil.copyfileobj(source, copy)


def _require_unpacked_size(path: Path, unpacked: int) -> None:
    if unpacked > _MAX_UNPACKED_BYTES:
        raise InputError(
            InputMistake(f"its rows take {unpacked:,} bytes unpacked; wanted {_MAX_UNPACKED_BYTES:,} at most", path)
        )


def _build_stored_run(run_rows: Sequence[ResultRow]) -> StoredRun:
    steps = [row for row in run_rows if row["phase"] == "step" and row["frame"] is not None]
    once = {row["frame"]: row for row in steps}
    last: ResultRow = once[max(once)] if once else {}
    counted = [row["num_iterations"] for row in once.values() if row["num_iterations"] is not None]
    return StoredRun(
        run_rows[0],
        next((row["status"] for row in run_rows if row["status"] != "ok"), "ok"),
        bootstrap_statistics.compute_min_seconds((row["frame"], row["seconds"]) for row in steps),
        sum(counted) if counted else None,
        *(last.get(name) for name in ("residual", "stationarity", "positions_digest")),
    )


def _incomparable_reason(old: StoredRun, new: StoredRun, baseline: str | None) -> str:
    """Return why two times are not comparable; empty if they are."""
    if old.status != "ok":
        return f"there is no old time: {old.status}"
    if old.row["machine_id"] != new.row["machine_id"] and baseline is None:
        where = [f"{run.row['cpu']}, {run.row['cores']} cores" for run in (old, new)]
        return f"other machines ({where[0]}; {where[1]}); --yardstick SOLVER compares ratios to one that both ran"
    return ""


def _baseline_scale(runs: Mapping[RunKey, StoredRun], key: RunKey, baseline: str) -> float | None:
    """Return 1 / (median step time of the baseline [s]).

    The baseline has the same scene, size and steps; None if it was not run.
    """
    at = {name: key[PAIRING_COLUMNS.index(name)] for name in ("scene", "size", "time_step", "integrator", "threads")}
    found = [
        run for run in runs.values() if run.row["solver"] == baseline and run.status == "ok" and run.seconds_by_frame
    ]
    found = [run for run in found if all(run.row[name] == value for name, value in at.items())]
    return 1 / float(np.median(list(found[0].seconds_by_frame.values()))) if found else None


def _classify_change(old: StoredRun, new: StoredRun, units: Sequence[float | None]) -> tuple[tuple[str, str, str], str]:
    """Return both times, their change with its interval, and its class.

    Classes are slower, faster, unchanged and fails now.
    """
    if new.status != "ok":
        return ("", "", ""), "fails now"
    frames = sorted(set(old.seconds_by_frame) & set(new.seconds_by_frame))
    was, now = (
        {f: run.seconds_by_frame[f] * (unit or 1) for f in frames} for run, unit in zip((old, new), units, strict=True)
    )
    ratio, low, high = bootstrap_statistics.estimate_slowdown(now, was)
    slower, faster = low > 1 + REGRESSION_MARGIN, high * (1 + REGRESSION_MARGIN) < 1
    told = [f"{float(np.median([*x.values()])):.4g}" for x in (was, now)]
    change = f"{100 * (ratio - 1):+.1f} % [{100 * (low - 1):+.1f}, {100 * (high - 1):+.1f}]"
    return (told[0], told[1], change), "slower" if slower else "faster" if faster else "unchanged"


def _compare_other_quantities(old: StoredRun, new: StoredRun) -> tuple[str, str, str, str]:
    """Compare iterations, residual, stationarity error and last positions."""
    told: list[str] = []
    for name in ("num_iterations", "last_residual", "last_stationarity"):
        was, now = getattr(old, name), getattr(new, name)
        same = was == now or was is None or now is None
        told.append(("" if now is None else f"{now:.4g}") if same else f"{was:.4g} -> {now:.4g}")
    known = old.positions_digest is not None and new.positions_digest is not None
    return (
        told[0],
        told[1],
        told[2],
        ("the same" if old.positions_digest == new.positions_digest else "others") if known else "",
    )
