"""Verify that an archive is unchanged, and that its numbers are reproducible.

All checksums are compared, and the names and options of all runs with those of their configs. Then a random tenth of
the runs is repeated on this machine, each with another solver's run on the same scene and size. Positions after every
step, and all columns except IRREPRODUCIBLE_COLUMNS and the times in `solver_phases`, must be bitwise identical. A
step's time must match the published one within a factor of MAX_SECONDS_RATIO. The ratio of the two solvers' times is
compared step by step (`springbench.harness.results.bootstrap_statistics.estimate_slowdown`). It must match within
MAX_RATIO_SAME_MACHINE on the published machine type, and within OTHER_MACHINE_FACTOR on others. With another machine,
or other libraries, source code or numbers of threads, a difference is inconclusive. So is a run that no config
requests.
"""

from __future__ import annotations

import json
import math
import os
import random
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from springbench.harness.config.config_loader import load_config
from springbench.harness.config.run_options import AUTO, RUN_OPTIONS
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import machine_info
from springbench.harness.execution.progress_display import ProgressDisplay
from springbench.harness.experiments.archive.publication import CHECKSUM_FILE
from springbench.harness.experiments.archive.result_merge import list_sweep_folders
from springbench.harness.experiments.experiment_units import execute_units
from springbench.harness.experiments.provenance import build_specification_columns
from springbench.harness.experiments.run_unit import RunUnit
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.results import bootstrap_statistics, parquet_rows, row_store, run_schema
from springbench.harness.results.folder_ownership import read_owner
from springbench.harness.results.published_set import QUICK_SHARE, compute_file_digest
from springbench.harness.results.solver_metadata import read_solver_metadata
from springbench.harness.results.solver_phases import SECONDS_PATTERN
from springbench.harness.results.time_ratios import OTHER_MACHINE_FACTOR

MAX_RATIO_SAME_MACHINE, MAX_SECONDS_RATIO = 1.25, 3.0
"""Accepted ratios of times.

Minima of two runs of the same code differ by up to 4 % on an idle machine, ratios far more on busy ones. Another
processor has other vector units and caches. Times themselves depend on the entire load of the machine.
"""

IRREPRODUCIBLE_COLUMNS = frozenset(
    (
        *(
            "seconds",
            "wall_seconds_check",
            "wall_seconds_sum",
            "cpu_seconds",
            "preempted",
            "phases_consistent",
            "search_seconds",
        ),
        *(
            "kernel_seconds",
            "transfer_seconds",
            "load_average",
            "started_at",
            "machine_id",
            "node_id",
            "cpu",
            "cores",
            "memory_gib",
        ),
        *(
            "machine_bandwidth",
            "machine_flops_per_second",
            "machine_step_seconds",
            "operating_system",
            "versions",
            "commit",
            "source_fingerprint",
            "device",
        ),
        *("device_memory_gib", "device_driver", "device_versions", "sm_clock_mhz"),
        *(
            "memory_clock_mhz",
            "power_w",
            "power_limit_w",
            "performance_state",
            "temperature_c",
            "sweep",
            "recording_digest",
        ),
        *("time_limit", "memory_limit", "timing", "num_concurrent_runs", "pinned_cores"),
    )
)
"""Columns that a repeated run cannot confirm.

These are times, state and type of the machine, the sweep's name, how the run was limited and timed, and the recording,
which is not repeated.
"""

_MAX_CHECKSUM_BYTES = 2**26
"""Largest size of the checksums of an archive."""
_MAX_LOADED_CONFIGS = 200
"""Largest number of different option sets with which configs are read."""

ResultRow = dict[str, Any]


class ClaimVerdict(Enum):
    """Verdict on a published claim: pass, fail or inconclusive."""

    PASS = "confirmed"
    FAIL = "refuted"
    INCONCLUSIVE = "undecided"


@dataclass(frozen=True, slots=True)
class VerifiedClaim:
    """Published claim with its verdict and an explanation."""

    subject: str
    verdict: ClaimVerdict
    explanation: str

    def __str__(self) -> str:
        return f"{self.subject}: {self.verdict.value}{f' ({self.explanation})' if self.explanation else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class PublishedRun:
    """Run of an archive: its rows, and the specification to repeat it."""

    rows: list[ResultRow]
    run: RunSpec

    @property
    def title(self) -> str:
        """Title of the run, for messages."""
        return self.run.title

    @property
    def comparison_group(self) -> tuple[str, str, int]:
        """Key of runs whose times are compared: sweep, scene and size."""
        return self.run.sweep, self.run.scene_name, self.run.size

    @property
    def step_rows(self) -> list[ResultRow]:
        """Rows of the run's steps."""
        return [row for row in self.rows if row["phase"] == "step"]


def verify_checksums(folder: Path) -> list[VerifiedClaim]:
    """Return a failed claim for each file that differs from the published one.

    The result is empty if all match. Raises InputError if there are no checksums.
    """
    sums = folder / CHECKSUM_FILE
    if not sums.is_file() or sums.stat().st_size > _MAX_CHECKSUM_BYTES:
        raise InputError(
            InputMistake(f"contains no {CHECKSUM_FILE}; expected an archive that `springbench publish` wrote", folder)
        )
    lines = [line.partition("  ") for line in os.fsdecode(sums.read_bytes()).splitlines()]
    stated = {name: digest for digest, _, name in lines if name}
    there = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    del there[CHECKSUM_FILE]
    wrong = dict.fromkeys(stated.keys() - there.keys(), "missing")
    wrong |= dict.fromkeys(there.keys() - stated.keys(), "was not published")
    wrong |= {n: "was changed" for n in there.keys() & stated.keys() if compute_file_digest(there[n]) != stated[n]}
    return [VerifiedClaim(name, ClaimVerdict.FAIL, why) for name, why in sorted(wrong.items())]


def load_published_runs(
    folder: Path, print_message: Callable[[str], None], *, with_user_code: bool
) -> tuple[list[PublishedRun], list[VerifiedClaim]]:
    """Load the runs of an archive that can be repeated, according to its configs.

    Args:
        folder: the unpacked archive.
        print_message: prints a remark.
        with_user_code: whether to include runs that need code from the archive.

    Returns:
        The runs, and failed or inconclusive claims on the names of runs.
    """
    runs: list[PublishedRun] = []
    claims: list[VerifiedClaim] = []
    _LOADED_RUNS.clear()
    for sweep in list_sweep_folders(folder / "results"):
        config = read_owner(sweep)
        if config and not config.is_relative_to(folder.resolve()):
            raise InputError(
                InputMistake("points to a file outside of the archive; no run was repeated", sweep / ".config")
            )
        by_run: dict[str, list[ResultRow]] = defaultdict(list)
        for row in _read_rows(sweep):
            by_run[row["run_id"]].append(row)
        specs = {
            name: _find_run_spec(config, of_run, with_user_code=with_user_code) if config else None
            for name, of_run in by_run.items()
        }
        found = [PublishedRun(by_run[name], spec) for name, spec in specs.items() if spec]
        claims += [claim for one in found if (claim := _verify_options(one))]
        if unknown := len(specs) - len(found):
            why = "the config expands to no such run" if config else "there is no config"
            claims.append(
                VerifiedClaim(f"{unknown} of {len(specs)} runs of {sweep.name}", ClaimVerdict.INCONCLUSIVE, why)
            )
        repeated = [one for one in found if all(row["status"] in _REPRODUCIBLE_STATUSES for row in one.rows)]
        if left := len(found) - len(repeated):
            print_message(
                f"{sweep.name}: {left} failed runs are not repeated, because failures depend on more than the config"
            )
        safe = [one for one in repeated if with_user_code or not one.run.find_plugins()]
        if left := len(repeated) - len(safe):
            print_message(
                f"{sweep.name}: {left} runs need code from the archive; review it, then give --with-user-code"
            )
        runs += safe
    return runs, claims


_REPRODUCIBLE_STATUSES = ("ok", "unsupported", "diverged", "wrong-gradient")
"""Statuses that depend on the config of a run only."""


def _read_rows(sweep: Path) -> list[ResultRow]:
    """Return the rows of a sweep. Raises InputError if they need too much memory."""
    units = row_store.list_units(sweep / "rows")
    with parquet_rows.limit_read_memory(units):
        return parquet_rows.read_rows(units, required_columns=("run_id", "status")).to_pylist()


def _find_run_spec(config: Path, run_rows: Sequence[ResultRow], *, with_user_code: bool) -> RunSpec | None:
    """Find the run specification that produced these rows.

    The run id is a hash of its content. The result is None where the config requests no such run.
    """
    steps = [row for row in run_rows if row["phase"] == "step"]
    first = (steps or run_rows)[0]
    names = ("max_iterations", "rtol", "integrator", "time_step", "initial_guess")
    options = {name: first[RUN_OPTIONS[name].column] for name in names}
    options |= {"frames": _find_max(steps, "frame"), "rounds": 1 + _find_max(steps, "round")}
    options["rtol"] = AUTO if options["rtol"] == 0.0 else options["rtol"]
    if first["error_requested"] is not None:
        options = {name: options[name] for name in ("time_step", "frames", "rounds")} | {
            "error_target": first["error_requested"]
        }
    sizes = [first["size"]] if first["size"] else []
    scene = {"solvers": [first["solver"]], "sizes": sizes, **options}
    # The config as it is, then with the options of the rows, which the command line may have set.
    for given in ({}, scene | {"threads": "auto"}, scene | {"threads": first["threads"]}):
        for opens in (False, True) if with_user_code else (False,):
            for run in _load_runs(config, json.dumps(given, sort_keys=True), opens):
                if run.compute_run_id(str(first["machine_id"])) == first["run_id"] and (
                    opens or not with_user_code or not run.find_plugins()
                ):
                    return run
    return None


def _find_max(steps: Sequence[ResultRow], name: str) -> int:
    return max((row[name] for row in steps if row[name] is not None), default=0)


def _load_runs(config: Path, options_json: str, imports_code: bool) -> list[RunSpec]:
    """Load the runs of a config with options, given as JSON.

    The result is empty if they are invalid. `imports_code` states whether code that the config names is imported.
    """
    key = config, options_json, imports_code
    if key not in _LOADED_RUNS:
        if len(_LOADED_RUNS) >= _MAX_LOADED_CONFIGS:
            return []
        try:
            _LOADED_RUNS[key] = load_config(config, imports_code=imports_code, **json.loads(options_json)).list_runs()
        except InputError:
            _LOADED_RUNS[key] = []
    return _LOADED_RUNS[key]


_LOADED_RUNS: dict[tuple[Path, str, bool], list[RunSpec]] = {}


def _verify_options(published_run: PublishedRun) -> VerifiedClaim | None:
    """Return a failed claim if a run's names or options differ from its config."""
    left_out = {"threads", *read_solver_metadata(published_run.run.solver.name)}  # of the machine and the code
    if published_run.run.error_target is not None:
        left_out |= {"integrator", "time_step", "residual_rtol", "max_iterations", "initial_guess"}  # found by a search
    requested = {
        name: value for name, value in build_specification_columns(published_run.run).items() if name not in left_out
    }
    wrong = _find_differences([(row, requested) for row in published_run.rows], requested)
    return (
        VerifiedClaim(f"{published_run.title}, names and options", ClaimVerdict.FAIL, _format_differences(wrong))
        if wrong
        else None
    )


def sample_runs(runs: Sequence[PublishedRun], seed: int) -> list[PublishedRun]:
    """Select a random share of the runs, `QUICK_SHARE` and at least one.

    A second solver on the same scene and size is added to each where possible.

    Args:
        runs: runs of the archive.
        seed: seed of the selection.
    """
    chance = random.Random(seed)
    taken = chance.sample(list(runs), max(1, math.ceil(QUICK_SHARE * len(runs)))) if runs else []
    for one in list(taken):
        rivals = [run for run in runs if run.comparison_group == one.comparison_group and run not in taken]
        if rivals and sum(run.comparison_group == one.comparison_group for run in taken) == 1:
            taken.append(chance.choice(rivals))
    return taken


def rerun_published(runs: Sequence[PublishedRun], folder: Path, display: ProgressDisplay) -> list[list[ResultRow]]:
    """Repeat runs in a folder, without recordings and pictures.

    Args:
        runs: published runs.
        folder: folder for the rows, which is created if missing.
        display: shows progress.

    Returns:
        Rows of each run, in the order of the runs.

    Raises:
        InputError: the input of a run is invalid.
    """
    for part in ("rows", "recordings", "pictures"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    bare = [one.run.replace_options(record=False, pictures=False) for one in runs]
    units = [RunUnit(run, RunFiles.for_run(run, folder)) for run in bare]
    execute_units(units, display)
    return [parquet_rows.read_rows([unit.files.rows_path]).to_pylist() for unit in units]


def verify_reruns(runs: Sequence[PublishedRun], rerun_rows: Sequence[list[ResultRow]]) -> list[VerifiedClaim]:
    """Verify repeated runs, and return the claims.

    Args:
        runs: published runs.
        rerun_rows: rows of the repetition of each.
    """
    claims: list[VerifiedClaim] = []
    for one, here in zip(runs, rerun_rows, strict=True):
        claims += _verify_rerun(one, here)
    for k, one in enumerate(runs):
        for j in range(k):
            ended = (runs[j].rows, one.rows, rerun_rows[j], rerun_rows[k])
            if runs[j].comparison_group == one.comparison_group and all(
                row["status"] == "ok" for found in ended for row in found
            ):
                claims.append(_verify_time_ratio((runs[j], one), (rerun_rows[j], rerun_rows[k])))
                break
    return claims


def _verify_rerun(original: PublishedRun, rerun_rows: list[ResultRow]) -> list[VerifiedClaim]:
    """Verify the end, the positions, the other columns and the times of a repeated run."""
    ended, here = ({(row["status"], row["reason"]) for row in found} for found in (original.rows, rerun_rows))
    if {status for status, _ in here} != {status for status, _ in ended}:
        status, reason = next(iter(here - ended), next(iter(here)))
        return [VerifiedClaim(f"{original.title}, end", ClaimVerdict.FAIL, f"here it ended as {status}: {reason}")]
    if {status for status, _ in here} != {"ok"}:
        return [
            VerifiedClaim(f"{original.title}, end", ClaimVerdict.PASS, f"here it ended as {next(iter(here))[0]}, too")
        ]
    return [
        _verify_positions(original, rerun_rows),
        _verify_columns(original, rerun_rows),
        *_verify_seconds(original, rerun_rows),
    ]


def _verify_positions(original: PublishedRun, rerun_rows: list[ResultRow]) -> VerifiedClaim:
    what = f"{original.title}, positions"
    now = {row["frame"]: row["positions_digest"] for row in rerun_rows if row["phase"] == "step"}
    others = {row["frame"] for row in original.step_rows if row["positions_digest"] != now.get(row["frame"])}
    others |= now.keys() - {row["frame"] for row in original.step_rows}
    if not others:
        return VerifiedClaim(what, ClaimVerdict.PASS, f"{len(now)} steps, to the bit")
    first = min(others, key=lambda frame: -1 if frame is None else frame)
    return _build_failed_claim(what, f"they differ from step {first} of {len(now)} on", original, rerun_rows)


def _verify_columns(original: PublishedRun, rerun_rows: list[ResultRow]) -> VerifiedClaim:
    """Verify the columns that a repetition determines; null published values are not compared."""
    what = f"{original.title}, other columns"
    of_place = {_row_key(row): row for row in rerun_rows}
    if lost := [_row_key(row) for row in original.rows if _row_key(row) not in of_place]:
        phase, frame, round = lost[0]
        return _build_failed_claim(
            what, f"a repeat has no {phase} of step {frame} in round {round}", original, rerun_rows
        )
    if fewer := {place for place in of_place if place[0] == "step"} - {_row_key(row) for row in original.step_rows}:
        return _build_failed_claim(what, f"{len(fewer)} steps are missing", original, rerun_rows)
    verified = {"positions_digest", "run_id"}  # the config confirms the id, which differs without a recording
    names = [name for name in run_schema.RUN_SCHEMA.names if name not in IRREPRODUCIBLE_COLUMNS | verified]
    wrong = _find_differences([(row, of_place[_row_key(row)]) for row in original.rows], names)
    filled = [name for name in names if any(row[name] is not None for row in original.rows)]
    return (
        _build_failed_claim(what, _format_differences(wrong), original, rerun_rows)
        if wrong
        else VerifiedClaim(what, ClaimVerdict.PASS, f"{len(filled)} in {len(original.rows)} rows, to the bit")
    )


def _row_key(row: ResultRow) -> tuple[Any, ...]:
    return row["phase"], row["frame"], row["round"]


def _get_confirmable(row: ResultRow, name: str) -> Any:
    """Return the value of a column, for `solver_phases` without the times."""
    value = row[name]
    return re.sub(SECONDS_PATTERN, "", value) if name == "solver_phases" and value else value


def _find_differences(
    pairs: Sequence[tuple[ResultRow, ResultRow]], names: Iterable[str]
) -> dict[str, tuple[ResultRow, Any, Any]]:
    """Return the columns whose published values differ: the first such row, and both values."""
    wrong: dict[str, tuple[ResultRow, Any, Any]] = {}
    for row, here in pairs:
        for name in names:
            was, now = _get_confirmable(row, name), _get_confirmable(here, name)
            if was is not None and was != now and not (was != was and now != now):  # NaN equals NaN here
                wrong.setdefault(name, (row, was, now))
    return wrong


def _format_differences(differences: Mapping[str, tuple[ResultRow, Any, Any]]) -> str:
    descriptions = [f"{name} is {was!r:.60}, here {now!r:.60}" for name, (_, was, now) in list(differences.items())[:5]]
    more = f", and {len(differences) - len(descriptions)} more columns" if len(differences) > len(descriptions) else ""
    return "; ".join(descriptions) + more


def _build_failed_claim(
    subject: str, explanation: str, original: PublishedRun, rerun_rows: list[ResultRow]
) -> VerifiedClaim:
    """Build the claim for a difference.

    It is a failure only with the same machine type, libraries, source code and number of threads. Otherwise it is
    inconclusive.
    """
    if elsewhere := _describe_environment_change(original.rows[0], rerun_rows[0]):
        return VerifiedClaim(subject, ClaimVerdict.INCONCLUSIVE, f"{explanation}; {elsewhere}")
    return VerifiedClaim(subject, ClaimVerdict.FAIL, explanation)


def _verify_seconds(original: PublishedRun, rerun_rows: list[ResultRow]) -> list[VerifiedClaim]:
    """Verify the time of a step; no claim where another machine may explain the difference."""
    what = f"{original.title}, time of a step"
    was, now = _read_step_seconds(original.rows), _read_step_seconds(rerun_rows)
    if was.keys() != now.keys():
        return [_build_failed_claim(what, "a step has no time", original, rerun_rows)]
    times = bootstrap_statistics.estimate_slowdown(now, was).estimate
    why = f"here {times:.3g} times as long"
    elsewhere = _describe_environment_change(original.rows[0], rerun_rows[0])
    if 1 / MAX_SECONDS_RATIO <= times <= MAX_SECONDS_RATIO:
        return [VerifiedClaim(what, ClaimVerdict.PASS, why)]
    if elsewhere and 1 / _MAX_MACHINE_RATIO <= times <= _MAX_MACHINE_RATIO:
        return []
    if not elsewhere and (share := _compute_preempted_share([*original.rows, *rerun_rows])) > 0.1:
        return [
            VerifiedClaim(what, ClaimVerdict.INCONCLUSIVE, f"{why}; {100 * share:.0f} % of the steps were interrupted")
        ]
    return [_build_failed_claim(what, why, original, rerun_rows)]


_MAX_MACHINE_RATIO = 20.0
"""Ratio of speeds that is plausible between two machines."""


def _compute_preempted_share(result_rows: Sequence[ResultRow]) -> float:
    """Compute the fraction of steps that were preempted."""
    steps = [row for row in result_rows if row["phase"] == "step"]
    return sum(bool(row["preempted"]) for row in steps) / len(steps)


def _describe_environment_change(old: ResultRow, new: ResultRow) -> str:
    """Describe the differences of machine, libraries, source code and threads."""
    differ = [f"{description}" for name, description in _ENVIRONMENT_COLUMNS.items() if old[name] != new[name]]
    return f"other {' and '.join(differ)}" if differ else ""


_ENVIRONMENT_COLUMNS = {
    "machine_id": "machine",
    "versions": "libraries",
    "source_fingerprint": "source code",
    "threads": "threads",
}


def _verify_time_ratio(
    old: tuple[PublishedRun, PublishedRun], new: tuple[list[ResultRow], list[ResultRow]]
) -> VerifiedClaim:
    was, now = ([_read_step_seconds(run) for run in pair] for pair in ((old[0].rows, old[1].rows), new))
    what = f"{old[0].title} relative to {old[1].run.solver.name}, ratio of times"
    if not was[0].keys() & was[1].keys() & now[0].keys() & now[1].keys():
        return VerifiedClaim(what, ClaimVerdict.INCONCLUSIVE, "they have no step in common that has a time")
    published, here = (bootstrap_statistics.estimate_slowdown(*pair).estimate for pair in (was, now))
    apart = bootstrap_statistics.estimate_slowdown(*(_compute_step_ratios(*pair) for pair in (now, was))).estimate
    what = f"{old[0].title} takes {published:.3g} times as long as {old[1].run.solver.name}"
    why = f"here {here:.3g} times"
    elsewhere = _describe_environment_change(old[0].rows[0], new[0][0])
    limit = OTHER_MACHINE_FACTOR if elsewhere else MAX_RATIO_SAME_MACHINE
    if 1 / limit <= apart <= limit:
        return VerifiedClaim(what, ClaimVerdict.PASS, why)
    share = _compute_preempted_share([row for found in (old[0].rows, old[1].rows, *new) for row in found])
    if elsewhere or share > 0.1:
        return VerifiedClaim(
            what,
            ClaimVerdict.INCONCLUSIVE,
            f"{why}; {elsewhere or f'{100 * share:.0f} % of the steps were interrupted'}",
        )
    return VerifiedClaim(what, ClaimVerdict.FAIL, why)


def _read_step_seconds(run: Sequence[ResultRow]) -> dict[int, float]:
    """Read the times of a run's steps by frame, where there are any [s]."""
    timed = [row for row in run if row["phase"] == "step" and row["frame"] is not None and row["seconds"] is not None]
    return bootstrap_statistics.compute_min_seconds(
        (row["frame"], row["seconds"]) for row in timed if 0.0 < row["seconds"] < math.inf
    )


def _compute_step_ratios(ours: Mapping[int, float], theirs: Mapping[int, float]) -> dict[int, float]:
    """Compute the ratio of the two times of each frame."""
    return {frame: taken / theirs[frame] for frame, taken in ours.items() if frame in theirs}


def select_runnable(runs: Sequence[PublishedRun], print_message: Callable[[str], None]) -> list[PublishedRun]:
    """Return the runs for which this machine has enough cores.

    Args:
        runs: published runs.
        print_message: called with the number of the other runs, if there are any.
    """
    usable = machine_info.describe_machine().cores
    found = [one for one in runs if machine_info.choose_threads(one.run.threads).count <= usable]
    if left := len(runs) - len(found):
        print_message(
            f"{left} of {len(runs)} runs are not repeated, because they need more cores than this machine has"
        )
    return found
