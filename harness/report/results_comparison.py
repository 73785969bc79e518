"""Comparison of two stored results, folders or archives of rows.

It finds regressions in time, and other changes. Runs are paired by their inputs, and compared step by step
(`springbench.harness.results.bootstrap_statistics.estimate_slowdown`). The load of the machine may have differed
between the two results, and statistics cannot detect that. Therefore the interval is extended by a margin; smaller
changes need `springbench regress --baseline REVISION`. Times of two machines are not comparable; their ratios to a
reference solver that both machines ran are.
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
from springbench.harness.atomic_files import explain_unreadable_file
from springbench.harness.console import split_wide_table
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results import bootstrap_statistics, parquet_rows, row_store
from springbench.harness.results.regression_verdict import RegressionVerdict, combine_verdicts, describe_counts

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


def compare_results(
    baseline: Path, new: Path, console: Console, reference_solver: str | None = None
) -> RegressionVerdict:
    """Print what changed from `baseline` to `new`.

    Args:
        baseline: folder or archive of the old results.
        new: folder or archive of the new results.
        console: console that the table is printed on.
        reference_solver: times are divided by those of this solver, so that they are comparable between machines.

    Returns:
        The verdict of all runs that both have. A run that became slower, or that fails now, fails.

    Raises:
        InputError: if there are no results, or none of the reference solver.
    """
    before, after = read_stored_runs(baseline), read_stored_runs(new)
    for path, runs in ((baseline, before), (new, after)):
        if reference_solver is not None and all(run.row["solver"] != reference_solver for run in runs.values()):
            problem = f"{path} has no runs of {reference_solver}; expected a solver of both results"
            raise InputError(InputMistake(problem, key="--relative-to"))
    if not before.keys() & after.keys():
        console.print(f"inconclusive: {baseline} and {new} have no run in common", markup=False)
        return RegressionVerdict.INCONCLUSIVE
    table = Table(
        *("run", "baseline", "new", "change", "verdict", "iterations", "residual", "error", "last positions"),
        box=SIMPLE_HEAD,
    )
    reasons, verdicts = dict[str, str](), list[RegressionVerdict]()
    for key in before | after:
        if key not in before or key not in after:
            remark, run = ("new", after[key]) if key not in before else ("missing", before[key])
            table.add_row(escape(run.run_label), "", "", "", remark)
            continue
        old, now = before[key], after[key]
        units = (1e3, 1e3)
        if reference_solver is not None:
            units = tuple(_reference_scale(runs, key, reference_solver) for runs in (before, after))
        reason = _incomparable_reason(old, now, reference_solver)
        if not reason and None in units:
            reason = f"{reference_solver} was not run on the same scene in both"
        if reason:
            reasons[old.run_label] = reason
        figures, verdict, remark = _classify_change(old, now, units, is_comparable=not reason)
        verdicts.append(verdict)
        words = ": ".join(filter(None, (verdict, remark)))
        table.add_row(escape(old.run_label), *figures, words, *_compare_other_quantities(old, now))
    console.print(split_wide_table(table))
    for name, reason in reasons.items():
        console.print(f"not compared: {name}: {reason}", markup=False)
    if reference_solver:
        console.print(f"times are relative to those of {reference_solver}", markup=False)
    verdict = combine_verdicts(verdicts)
    console.print(f"{verdict}: {describe_counts(verdicts)}")
    return verdict


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
            raise InputError(InputMistake("has no rows (rows/*.parquet); expected results of `springbench run`", path))
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
    expected = "expected a folder of results, an archive of one (.zip, .tar.*), or pytest-benchmark's (.json)"
    if not path.is_file():  # reading a device or a pipe would not end
        raise InputError(InputMistake(f"{'is not a file' if path.exists() else 'does not exist'}; {expected}", path))
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
                raise InputError(InputMistake(explain_unreadable_file(path) or expected, path))
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
            InputMistake(f"its rows take {unpacked:,} bytes unpacked; expected {_MAX_UNPACKED_BYTES:,} at most", path)
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


def _incomparable_reason(old: StoredRun, new: StoredRun, reference_solver: str | None) -> str:
    """Return why two times are not comparable; empty if they are."""
    if old.status != "ok":
        return f"the baseline has no time: {old.status}"
    if old.row["machine_id"] != new.row["machine_id"] and reference_solver is None:
        machines = [f"{run.row['cpu']}, {run.row['cores']} cores" for run in (old, new)]
        return f"other machines ({machines[0]}; {machines[1]}); --relative-to SOLVER compares ratios to one of both"
    return ""


def _reference_scale(runs: Mapping[RunKey, StoredRun], key: RunKey, reference_solver: str) -> float | None:
    """Return 1 / (median step time of the reference solver [s]).

    Its run has the same scene, size and steps; None if there is none.
    """
    same = {name: key[PAIRING_COLUMNS.index(name)] for name in ("scene", "size", "time_step", "integrator", "threads")}
    same["solver"] = reference_solver
    for run in runs.values():
        is_same = all(run.row[name] == value for name, value in same.items())
        if is_same and run.status == "ok" and run.seconds_by_frame:
            return 1 / float(np.median(list(run.seconds_by_frame.values())))
    return None


def _classify_change(
    old: StoredRun, new: StoredRun, units: Sequence[float | None], *, is_comparable: bool
) -> tuple[tuple[str, str, str], RegressionVerdict, str]:
    """Return both times and their change with its interval, the verdict, and a remark."""
    if not is_comparable:
        return ("", "", ""), RegressionVerdict.INCONCLUSIVE, ""
    if new.status != "ok":
        return ("", "", ""), RegressionVerdict.FAIL, f"run {new.status}"
    frames = sorted(set(old.seconds_by_frame) & set(new.seconds_by_frame))
    was, now = (
        {f: run.seconds_by_frame[f] * (unit or 1) for f in frames} for run, unit in zip((old, new), units, strict=True)
    )
    ratio, low, high = bootstrap_statistics.estimate_slowdown(now, was)
    slower, faster = low > 1 + REGRESSION_MARGIN, high * (1 + REGRESSION_MARGIN) < 1
    medians = [f"{float(np.median([*times.values()])):.4g}" for times in (was, now)]
    change = f"{100 * (ratio - 1):+.1f} % [{100 * (low - 1):+.1f}, {100 * (high - 1):+.1f}]"
    verdict = RegressionVerdict.FAIL if slower else RegressionVerdict.PASS
    return (medians[0], medians[1], change), verdict, "slower" if slower else "faster" if faster else ""


def _compare_other_quantities(old: StoredRun, new: StoredRun) -> tuple[str, str, str, str]:
    """Compare iterations, residual, stationarity error and last positions."""
    cells: list[str] = []
    for name in ("num_iterations", "last_residual", "last_stationarity"):
        was, now = getattr(old, name), getattr(new, name)
        same = was == now or was is None or now is None
        cells.append(("" if now is None else f"{now:.4g}") if same else f"{was:.4g} -> {now:.4g}")
    is_known = old.positions_digest is not None and new.positions_digest is not None
    is_equal = old.positions_digest == new.positions_digest
    return cells[0], cells[1], cells[2], ("equal" if is_equal else "different") if is_known else ""
