"""Verify that an archive is unchanged, and that its numbers are reproducible.

All checksums are compared, and the names and options of all runs with those of their configs. Then a random tenth of
the runs is repeated here, each with another solver's run on the same scene and size. Positions after every step, and
all columns except UNREPEATED, must be bitwise identical. A step's time must match the published one within
a factor of SECONDS. The ratio of the two solvers' times is compared step by step
(`harness.base.statistics.changed`). It must match within RATIO on the published
machine type, within ELSEWHERE on others. With another machine, other libraries or other source code, a
difference is inconclusive. So is a run that no config requests.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import random
import shutil
import struct
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.base import columns, machine, rows, shelf, statistics
from harness.base.claim import config_of
from harness.base.errors import InputError, Mistake
from harness.base.progress import Display
from harness.base.stated import stated
from harness.config.load import load_any
from harness.config.options import AUTO
from harness.config.sweep import RunSpec
from harness.experiments.archive.merge import sweeps
from harness.experiments.archive.publish import SUMS
from harness.experiments.core import do_all
from harness.experiments.plan import Files
from harness.experiments.provenance import asked
from harness.experiments.run_unit import RunUnit

RATIO, ELSEWHERE, SECONDS = 1.25, 2.0, 3.0
"""Accepted ratios of times.

Minima of two runs of the same code differ by up to 4 % on an idle machine, ratios far more on busy ones. Another
processor has other vector units and caches. Times themselves depend on the entire load of the machine.
"""

UNREPEATED = frozenset(
    (
        *("seconds", "pass_seconds", "summed_seconds", "cpu_seconds", "interrupted", "adds_up", "estimate_seconds"),
        *("kernel_seconds", "transfer_seconds", "load", "started", "machine", "node", "cpu", "cores", "memory_gib"),
        *("machine_bandwidth", "machine_flops", "machine_step", "system", "versions", "commit", "code", "device"),
        *("device_memory_gib", "device_driver", "device_versions", "sm_clock_mhz"),
        *("memory_clock_mhz", "power_w", "power_limit_w", "performance_state", "temperature_c", "sweep", "recorded"),
        *("time_limit", "memory_limit", "timing", "at_once", "pinned"),
    )
)
"""Columns that a repeated run cannot confirm.

These are times, state and type of the machine, the sweep's name, how the run was limited and timed, and the recording,
which is not repeated.
"""

_MOST_FILES, _MOST_SUMS, _MOST_TIMES = 200_000, 2**26, 200
"""Largest number of files in an archive, of bytes of its checksums, and ratio of unpacked to packed size."""
_MOST_LOADED = 200
"""Largest number of different option sets with which configs are read."""

Row = dict[str, Any]


class Holds(Enum):
    """Verdict on a published claim: pass, fail or inconclusive."""

    YES = "holds"
    NO = "does not hold"
    UNKNOWN = "cannot tell"


@dataclass(frozen=True, slots=True)
class Claim:
    """Published claim with its verdict and an explanation."""

    what: str
    holds: Holds
    why: str

    def __str__(self) -> str:
        return f"{self.what}: {self.holds.value}{f' ({self.why})' if self.why else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class Published:
    """Run of an archive: its rows, and the specification to repeat it."""

    rows: list[Row]
    run: RunSpec

    @property
    def title(self) -> str:
        """Title of the run, for messages."""
        return self.run.title

    @property
    def group(self) -> tuple[str, str, int]:
        """Key of runs whose times are compared: sweep, scene and size."""
        return self.run.sweep, self.run.scene_name, self.run.size

    @property
    def steps(self) -> list[Row]:
        """Rows of the run's steps."""
        return [row for row in self.rows if row["phase"] == "step"]


@contextmanager
def unpacked(archive: Path) -> Generator[Path]:
    """Unpack an archive to a temporary folder. Raises InputError for a damaged or oversized archive."""
    wanted = "wanted an archive that `springbench publish` wrote (.zip)"
    if not archive.is_file():  # a device or a pipe would be read for ever
        raise InputError(Mistake(f"is {'no plain file' if archive.exists() else 'not there'}; {wanted}", archive))
    with TemporaryDirectory() as scratch:
        try:
            with zipfile.ZipFile(archive) as packed:
                if why := _excess(packed.infolist(), archive.stat().st_size, shutil.disk_usage(scratch).free):
                    raise InputError(Mistake(f"{why}; {wanted}", archive))
                packed.extractall(scratch)  # names that lead out of the folder are made to stay in it
        except (*_DAMAGE, OSError) as error:
            raise InputError(Mistake(f"cannot be unpacked ({error}); {wanted}", archive)) from error
        yield Path(scratch)


_DAMAGE = (zipfile.BadZipFile, RuntimeError, NotImplementedError, ValueError, EOFError, zlib.error, struct.error)
"""Errors that zipfile raises for damaged or forged archives."""


def _excess(files: Sequence[zipfile.ZipInfo], size: int, free: int) -> str:
    """Return why an archive is not unpacked; empty if it is.

    Args:
        files: entries of the archive.
        size: size of the archive [B].
        free: free space on the disk [B].
    """
    unpacked = sum(info.file_size for info in files)
    if len(files) > _MOST_FILES:
        return f"holds {len(files):,} files, and at most {_MOST_FILES:,} are unpacked"
    if unpacked > free:
        return f"takes {unpacked:,} bytes unpacked; there are {free:,}"
    if unpacked > _MOST_TIMES * size or sum(info.compress_size for info in files) > size:
        return f"takes {unpacked:,} bytes unpacked of {size:,}, which no results do"
    if any(info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for info in files):
        return "is compressed by another method"
    return ""


def checksums(folder: Path) -> list[Claim]:
    """Return a failed claim for each file that differs from the published one.

    The result is empty if all match. Raises InputError if there are no checksums.
    """
    sums = folder / SUMS
    if not sums.is_file() or sums.stat().st_size > _MOST_SUMS:
        raise InputError(Mistake(f"holds no {SUMS}; wanted an archive that `springbench publish` wrote", folder))
    lines = [line.partition("  ") for line in os.fsdecode(sums.read_bytes()).splitlines()]
    stated = {name: digest for digest, _, name in lines if name}
    there = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    del there[SUMS]
    wrong = dict.fromkeys(stated.keys() - there.keys(), "missing")
    wrong |= dict.fromkeys(there.keys() - stated.keys(), "was not published")
    wrong |= {n: "was changed" for n in there.keys() & stated.keys() if _digest(there[n]) != stated[n]}
    return [Claim(name, Holds.NO, why) for name, why in sorted(wrong.items())]


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def published(folder: Path, say: Callable[[str], None], *, own_code: bool) -> tuple[list[Published], list[Claim]]:
    """Load the runs of an archive that can be repeated, according to its configs.

    Args:
        folder: the unpacked archive.
        say: prints a remark.
        own_code: whether to include runs that need code from the archive.

    Returns: the runs, and failed or inconclusive claims on the names of runs.
    """
    runs: list[Published] = []
    claims: list[Claim] = []
    _LOADED.clear()
    for sweep in sweeps(folder / "results"):
        config = config_of(sweep)
        if config and not config.is_relative_to(folder.resolve()):
            raise InputError(Mistake("leads out of the archive; nothing of it was run", sweep / ".config"))
        by_run: dict[str, list[Row]] = defaultdict(list)
        for row in _rows(sweep):
            by_run[row["run_id"]].append(row)
        specs = {name: _spec(config, of_run, own_code=own_code) if config else None for name, of_run in by_run.items()}
        found = [Published(by_run[name], spec) for name, spec in specs.items() if spec]
        claims += [claim for one in found if (claim := _names(one))]
        if unknown := len(specs) - len(found):
            why = "the config asks for none such" if config else "there is no config"
            claims.append(Claim(f"{unknown} of {len(specs)} runs of {sweep.name}", Holds.UNKNOWN, why))
        repeated = [one for one in found if all(row["status"] in _REPEATED for row in one.rows)]
        if left := len(found) - len(repeated):
            say(f"{sweep.name}: {left} runs failed, which depends on more than their config: they are not done again")
        safe = [one for one in repeated if own_code or not one.run.own()]
        if left := len(repeated) - len(safe):
            say(f"{sweep.name}: {left} runs need code from the archive: read it, then give --own-code")
        runs += safe
    return runs, claims


_REPEATED = ("ok", "unsupported", "diverged", "disputed")
"""Statuses that depend on the config of a run only."""


def _rows(sweep: Path) -> list[Row]:
    """Return the rows of a sweep. Raises InputError if they need too much memory."""
    units = shelf.units(sweep / "rows")
    with rows.memory_for(units):
        return rows.read(units, needed=("run_id", "status")).to_pylist()


def _spec(config: Path, of_run: Sequence[Row], *, own_code: bool) -> RunSpec | None:
    """Find the run specification that produced these rows.

    The run id is a hash of its content.

    The result is None where the config requests no such run.
    """
    steps = [row for row in of_run if row["phase"] == "step"]
    first = (steps or of_run)[0]
    names = {"iterations": "max_iterations"} | {n: n for n in ("tolerance", "integrator", "time_step", "first_guess")}
    options = {name: first[column] for name, column in names.items()}
    options |= {"frames": _largest(steps, "frame"), "rounds": 1 + _largest(steps, "round")}
    options["tolerance"] = AUTO if options["tolerance"] == 0.0 else options["tolerance"]
    if first["asked"] is not None:
        options = {name: options[name] for name in ("time_step", "frames", "rounds")} | {"accuracy": first["asked"]}
    sizes = [first["size"]] if first["size"] else []
    scene = {"solvers": [first["solver"]], "sizes": sizes, **options}
    for given in ({}, scene | {"threads": "auto"}, scene | {"threads": first["threads"]}):
        for opens in (False, True) if own_code else (False,):
            for run in _runs(config, json.dumps(given, sort_keys=True), opens):
                if run.run_id(str(first["machine"])) == first["run_id"] and (opens or not own_code or not run.own()):
                    return run
    return None


def _largest(steps: Sequence[Row], name: str) -> int:
    return max((row[name] for row in steps if row[name] is not None), default=0)


def _runs(config: Path, given: str, opens: bool) -> list[RunSpec]:
    """Load the runs of a config with options, given as JSON.

    The result is empty if they are invalid.

    `opens` states whether code that the config names is imported.
    """
    key = config, given, opens
    if key not in _LOADED:
        if len(_LOADED) >= _MOST_LOADED:
            return []
        try:
            _LOADED[key] = load_any(config, opens=opens, **json.loads(given)).runs()
        except InputError:
            _LOADED[key] = []
    return _LOADED[key]


_LOADED: dict[tuple[Path, str, bool], list[RunSpec]] = {}


def _names(one: Published) -> Claim | None:
    """Return a failed claim if a run's names or options differ from its config."""
    left_out = {"threads", *stated(one.run.solver.name)}  # of the machine, and of the code
    if one.run.accuracy is not None:
        left_out |= {"integrator", "time_step", "tolerance", "max_iterations", "first_guess"}  # are chosen
    asked_for = {name: value for name, value in asked(one.run).items() if name not in left_out}
    wrong = _differing([(row, asked_for) for row in one.rows], asked_for)
    return Claim(f"{one.title}, names and options", Holds.NO, _listed(wrong)) if wrong else None


def chosen(runs: Sequence[Published], seed: int, part: float = 0.1) -> list[Published]:
    """Select a random fraction of the runs, at least one.

    A second solver on the same scene and size is added to each where possible.

    Args:
        runs: runs of the archive.
        seed: seed of the selection.
        part: fraction of the runs.
    """
    chance = random.Random(seed)
    taken = chance.sample(list(runs), max(1, math.ceil(part * len(runs)))) if runs else []
    for one in list(taken):
        rivals = [run for run in runs if run.group == one.group and run not in taken]
        if rivals and sum(run.group == one.group for run in taken) == 1:
            taken.append(chance.choice(rivals))
    return taken


def again(runs: Sequence[Published], folder: Path, display: Display) -> list[list[Row]]:
    """Repeat runs in a folder, and return the rows of each. Raises InputError."""
    for part in ("rows", "recordings", "pictures"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    bare = [one.run.but(record=False, pictures=False) for one in runs]
    units = [RunUnit(run, Files.of(run, folder)) for run in bare]
    do_all(units, display)
    return [rows.read([unit.files.rows]).to_pylist() for unit in units]


def compare(runs: Sequence[Published], new: Sequence[list[Row]]) -> list[Claim]:
    """Verify repeated runs, and return the claims.

    Args:
        runs: published runs.
        new: rows of the repetition of each.
    """
    claims: list[Claim] = []
    for one, here in zip(runs, new, strict=True):
        claims += _repeated(one, here)
    for k, one in enumerate(runs):
        for j in range(k):
            ended = (runs[j].rows, one.rows, new[j], new[k])
            if runs[j].group == one.group and all(row["status"] == "ok" for found in ended for row in found):
                claims.append(_ratio((runs[j], one), (new[j], new[k])))
                break
    return claims


def _repeated(old: Published, new: list[Row]) -> list[Claim]:
    """Verify the end, the positions, the other columns and the times of a repeated run."""
    ended, here = ({(row["status"], row["reason"]) for row in found} for found in (old.rows, new))
    if {status for status, _ in here} != {status for status, _ in ended}:
        status, reason = next(iter(here - ended), next(iter(here)))
        return [Claim(f"{old.title}, end", Holds.NO, f"here it ended as {status}: {reason}")]
    if {status for status, _ in here} != {"ok"}:
        return [Claim(f"{old.title}, end", Holds.YES, f"here it ended as {next(iter(here))[0]}, too")]
    return [_positions(old, new), _columns(old, new), *_seconds_hold(old, new)]


def _positions(old: Published, new: list[Row]) -> Claim:
    what = f"{old.title}, positions"
    now = {row["frame"]: row["digest"] for row in new if row["phase"] == "step"}
    others = {row["frame"] for row in old.steps if row["digest"] != now.get(row["frame"])}
    others |= now.keys() - {row["frame"] for row in old.steps}
    if not others:
        return Claim(what, Holds.YES, f"{len(now)} steps, to the bit")
    first = min(others, key=lambda frame: -1 if frame is None else frame)
    return _refuted(what, f"they differ from step {first} of {len(now)} on", old, new)


def _columns(old: Published, new: list[Row]) -> Claim:
    """Verify the columns that a repetition determines; an empty published column claims nothing."""
    what = f"{old.title}, other columns"
    of_place = {_place(row): row for row in new}
    if lost := [_place(row) for row in old.rows if _place(row) not in of_place]:
        phase, frame, round = lost[0]
        return _refuted(what, f"a repeat has no {phase} of step {frame} in round {round}", old, new)
    if fewer := {place for place in of_place if place[0] == "step"} - {_place(row) for row in old.steps}:
        return _refuted(what, f"{len(fewer)} steps are missing", old, new)
    names = [name for name in columns.SCHEMA.names if name not in UNREPEATED | {"digest"}]
    wrong = _differing([(row, of_place[_place(row)]) for row in old.rows], names)
    filled = [name for name in names if any(row[name] is not None for row in old.rows)]
    return (
        _refuted(what, _listed(wrong), old, new)
        if wrong
        else Claim(what, Holds.YES, f"{len(filled)} in {len(old.rows)} rows, to the bit")
    )


def _place(row: Row) -> tuple[Any, ...]:
    return row["phase"], row["frame"], row["round"]


def _differing(pairs: Sequence[tuple[Row, Row]], names: Iterable[str]) -> dict[str, tuple[Row, Any, Any]]:
    """Return the columns whose published values differ: the first such row, and both values."""
    wrong: dict[str, tuple[Row, Any, Any]] = {}
    for row, here in pairs:
        for name in names:
            was, now = row[name], here[name]
            if was is not None and was != now and not (was != was and now != now):  # what is no number equals itself
                wrong.setdefault(name, (row, was, now))
    return wrong


def _listed(wrong: Mapping[str, tuple[Row, Any, Any]]) -> str:
    told = [f"{name} is {was!r:.60}, here {now!r:.60}" for name, (_, was, now) in list(wrong.items())[:5]]
    more = f", and {len(wrong) - len(told)} more columns" if len(wrong) > len(told) else ""
    return "; ".join(told) + more


def _refuted(what: str, why: str, old: Published, new: list[Row]) -> Claim:
    """Build the claim for a difference.

    It is a failure only with the same source code on such a machine.
    """
    if elsewhere := _elsewhere(old.rows[0], new[0]):
        return Claim(what, Holds.UNKNOWN, f"{why}; {elsewhere}")
    return Claim(what, Holds.NO, why)


def _seconds_hold(old: Published, new: list[Row]) -> list[Claim]:
    """Verify the time of a step; no claim where another machine may explain the difference."""
    what = f"{old.title}, time of a step"
    was, now = _seconds(old.rows), _seconds(new)
    if was.keys() != now.keys():
        return [_refuted(what, "a step has no time", old, new)]
    times = statistics.changed(now, was).middle
    why = f"here {times:.3g} times as long"
    elsewhere = _elsewhere(old.rows[0], new[0])
    if 1 / SECONDS <= times <= SECONDS:
        return [Claim(what, Holds.YES, why)]
    if elsewhere and 1 / _OTHER_MACHINE <= times <= _OTHER_MACHINE:
        return []
    if not elsewhere and (share := _interrupted([*old.rows, *new])) > 0.1:
        return [Claim(what, Holds.UNKNOWN, f"{why}; {100 * share:.0f} % of the steps were interrupted")]
    return [_refuted(what, why, old, new)]


_OTHER_MACHINE = 20.0
"""Ratio of speeds that is plausible between two machines."""


def _interrupted(found: Sequence[Row]) -> float:
    """Compute the fraction of steps that were preempted."""
    steps = [row for row in found if row["phase"] == "step"]
    return sum(bool(row["interrupted"]) for row in steps) / len(steps)


def _elsewhere(old: Row, new: Row) -> str:
    """Describe the differences of machine, libraries, source code and threads."""
    differ = [f"{told}" for name, told in _WHERE.items() if old[name] != new[name]]
    return f"other {' and '.join(differ)}" if differ else ""


_WHERE = {"machine": "machine", "versions": "libraries", "code": "code", "threads": "threads"}


def _ratio(old: tuple[Published, Published], new: tuple[list[Row], list[Row]]) -> Claim:
    was, now = ([_seconds(run) for run in pair] for pair in ((old[0].rows, old[1].rows), new))
    what = f"{old[0].title} beside {old[1].run.solver.name}, ratio of times"
    if not was[0].keys() & was[1].keys() & now[0].keys() & now[1].keys():
        return Claim(what, Holds.UNKNOWN, "they have no step in common that has a time")
    published, here = (statistics.changed(*pair).middle for pair in (was, now))
    apart = statistics.changed(*(_ratios(*pair) for pair in (now, was))).middle
    what = f"{old[0].title} takes {published:.3g} times as long as {old[1].run.solver.name}"
    why = f"here {here:.3g} times"
    elsewhere = _elsewhere(old[0].rows[0], new[0][0])
    limit = ELSEWHERE if elsewhere else RATIO
    if 1 / limit <= apart <= limit:
        return Claim(what, Holds.YES, why)
    share = _interrupted([row for found in (old[0].rows, old[1].rows, *new) for row in found])
    if elsewhere or share > 0.1:
        return Claim(what, Holds.UNKNOWN, f"{why}; {elsewhere or f'{100 * share:.0f} % of the steps were interrupted'}")
    return Claim(what, Holds.NO, why)


def _seconds(run: Sequence[Row]) -> dict[int, float]:
    """Read the times of a run's steps by frame, where there are any [s]."""
    timed = [row for row in run if row["phase"] == "step" and row["frame"] is not None and row["seconds"] is not None]
    return statistics.least((row["frame"], row["seconds"]) for row in timed if 0.0 < row["seconds"] < math.inf)


def _ratios(ours: Mapping[int, float], theirs: Mapping[int, float]) -> dict[int, float]:
    """Compute the ratio of the two times of each frame."""
    return {frame: taken / theirs[frame] for frame, taken in ours.items() if frame in theirs}


def possible(runs: Sequence[Published], say: Callable[[str], None]) -> list[Published]:
    """Return the runs for which this machine has enough cores."""
    usable = machine.describe().cores
    found = [one for one in runs if machine.threads(one.run.threads).number <= usable]
    if left := len(runs) - len(found):
        say(f"{left} of {len(runs)} runs need more cores than this machine has: they are not done again")
    return found
