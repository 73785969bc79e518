"""Whether an archive is what was published, and whether its numbers come out again.

All checksums are compared. Then a random tenth of its runs is done here, each beside another solver's run on the same
scene and size: positions must be equal to the bit after every step, and the ratio of the two solvers' times, step by
step (`harness.base.statistics.changed`), that which was published: within RATIO on the machine type that it was
published from, within ELSEWHERE on others. Where another machine, other libraries or other code ran, positions that
differ, and ratios that do not hold, refute nothing: it cannot be told.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
import shutil
import zipfile
from collections import defaultdict
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from harness.base import machine, rows, shelf, statistics
from harness.base.claim import config_of
from harness.base.errors import InputError, Mistake
from harness.base.progress import Display
from harness.config.load import load_any
from harness.config.options import AUTO
from harness.config.sweep import RunSpec
from harness.experiments.archive.merge import sweeps
from harness.experiments.archive.publish import SUMS
from harness.experiments.core import do_all
from harness.experiments.plan import Files
from harness.experiments.run_unit import RunUnit

RATIO, ELSEWHERE = 1.25, 2.0
"""Minima of two runs of the same code lie up to 4 % apart on an idle machine, ratios far more on busy ones; another
processor has other vectors and caches."""
_BUFFER = 2**20

Row = dict[str, Any]


class Holds(Enum):
    """Of something that was published: it is so here, it is not, or this cannot be told."""

    YES = "holds"
    NO = "does not hold"
    UNKNOWN = "cannot tell"


@dataclass(frozen=True, slots=True)
class Claim:
    """Something that was published, and whether it holds, in words."""

    what: str
    holds: Holds
    why: str

    def __str__(self) -> str:
        return f"{self.what}: {self.holds.value}{f' ({self.why})' if self.why else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class Published:
    """A run of an archive: its rows, and how to do it again."""

    rows: list[Row]
    run: RunSpec

    @property
    def title(self) -> str:
        """The run in words."""
        return self.run.title

    @property
    def group(self) -> tuple[str, str, int]:
        """The runs whose times are compared: of one sweep, scene and size."""
        return self.run.sweep, self.run.scene_name, self.run.size


@contextmanager
def unpacked(archive: Path) -> Generator[Path]:
    """A folder with what an archive holds, for a while. Raises InputError for what is none, or is too large."""
    with TemporaryDirectory() as scratch:
        try:
            with zipfile.ZipFile(archive) as packed:
                size, free = sum(info.file_size for info in packed.infolist()), shutil.disk_usage(scratch).free
                if size > free:
                    raise InputError(Mistake(f"takes {size:,} bytes unpacked; there are {free:,}", archive))
                packed.extractall(scratch)  # names that lead out of the folder are made to stay in it
        except (zipfile.BadZipFile, OSError, RuntimeError, NotImplementedError) as error:
            raise InputError(Mistake(f"is no archive that `springbench publish` wrote: {error}", archive)) from error
        yield Path(scratch)


def checksums(folder: Path) -> list[Claim]:
    """What is not as it was published; empty where all is. Raises InputError where there are no checksums."""
    sums = folder / SUMS
    if not sums.is_file():
        raise InputError(Mistake(f"holds no {SUMS}; wanted an archive that `springbench publish` wrote", folder))
    lines = [line.partition("  ") for line in sums.read_text().splitlines()]
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


def published(folder: Path, say: Callable[[str], None], *, own_code: bool) -> list[Published]:
    """The runs in a folder of results that ended well and can be done again, by the configs beside them.

    own_code: whether those that need code from the archive are among them.
    """
    found: list[Published] = []
    for sweep in sweeps(folder / "results"):
        units = shelf.units(sweep / "rows")
        config = config_of(sweep)
        if config and not config.is_relative_to(folder.resolve()):
            raise InputError(Mistake("leads out of the archive; nothing of it was run", sweep / ".config"))
        by_run: dict[str, list[Row]] = defaultdict(list)
        for row in rows.read(units).to_pylist():
            by_run[row["run_id"]].append(row)
        whole = [of_run for of_run in by_run.values() if all(row["status"] == "ok" for row in of_run)]
        whole = [of_run for of_run in whole if any(row["digest"] for row in of_run)]
        specs = [_spec(config, of_run, own_code) if config else None for of_run in whole]
        found += [Published(of_run, spec) for of_run, spec in zip(whole, specs, strict=True) if spec]
        if left := sum(spec is None for spec in specs):
            why = "their code is in the archive: read it, then give --own-code" if config and not own_code else ""
            say(f"{sweep.name}: {left} of {len(specs)} runs cannot be done again{f'; {why}' if why else ''}")
    return found


def _spec(config: Path, of_run: Sequence[Row], own_code: bool) -> RunSpec | None:
    """The run that left these rows, by its id, which tells its content; None where the config asks for none such."""
    steps = [row for row in of_run if row["phase"] == "step"]
    first = steps[0]
    names = {"iterations": "max_iterations"} | {n: n for n in ("tolerance", "integrator", "time_step", "first_guess")}
    options = {name: first[column] for name, column in names.items()}
    options |= {"frames": max(row["frame"] for row in steps), "rounds": 1 + max(row["round"] for row in steps)}
    options["tolerance"] = AUTO if options["tolerance"] == 0.0 else options["tolerance"]
    if first["asked"] is not None:
        options = {name: options[name] for name in ("time_step", "frames", "rounds")} | {"accuracy": first["asked"]}
    sizes = [first["size"]] if first["size"] else []
    scene = {"solvers": [first["solver"]], "sizes": sizes, **options}
    for asked in ({}, scene | {"threads": "auto"}, scene | {"threads": first["threads"]}):
        try:
            runs = _runs(config, json.dumps(asked, sort_keys=True), own_code)
        except InputError:
            continue
        for run in runs:
            if run.run_id(first["machine"]) == first["run_id"]:
                return run if own_code or not run.own() else None
    return None


def _runs(config: Path, asked: str, own_code: bool) -> list[RunSpec]:
    if (config, asked, own_code) not in _LOADED:
        _LOADED[config, asked, own_code] = load_any(config, opens=own_code, **json.loads(asked)).runs()
    return _LOADED[config, asked, own_code]


_LOADED: dict[tuple[Path, str, bool], list[RunSpec]] = {}


def chosen(runs: Sequence[Published], seed: int, part: float = 0.1) -> list[Published]:
    """A random part of the runs, one at least, and beside each alone another solver's on its scene and size."""
    chance = random.Random(seed)
    taken = chance.sample(list(runs), max(1, math.ceil(part * len(runs)))) if runs else []
    for one in list(taken):
        rivals = [run for run in runs if run.group == one.group and run not in taken]
        if rivals and sum(run.group == one.group for run in taken) == 1:
            taken.append(chance.choice(rivals))
    return taken


def again(runs: Sequence[Published], folder: Path, display: Display) -> list[Claim]:
    """Do runs again, in this folder, and say what holds. Raises InputError."""
    for part in ("rows", "recordings", "pictures"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    bare = [one.run.but(record=False, pictures=False) for one in runs]
    units = [RunUnit(run, Files.of(run, folder)) for run in bare]
    do_all(units, display)
    new = [rows.read([unit.files.rows]).to_pylist() for unit in units]
    claims = [_positions(one, rows_of) for one, rows_of in zip(runs, new, strict=True)]
    for k, one in enumerate(runs):
        for j in range(k):
            if runs[j].group == one.group and all(row["status"] == "ok" for row in (*new[j], *new[k])):
                claims.append(_ratio((runs[j], one), (new[j], new[k])))
                break
    return claims


def _positions(old: Published, new: list[Row]) -> Claim:
    what = f"{old.title}, positions"
    if failed := next((row for row in new if row["status"] != "ok"), None):
        return Claim(what, Holds.NO, f"here it ended as {failed['status']}: {failed['reason']}")
    was, now = ({row["frame"]: row["digest"] for row in found if row["phase"] == "step"} for found in (old.rows, new))
    others = sorted(frame for frame in was if now.get(frame) != was[frame])
    if not others:
        return Claim(what, Holds.YES, f"{len(was)} steps, to the bit")
    why = f"they differ from step {others[0]} of {len(was)} on"
    if elsewhere := _elsewhere(old.rows[0], new[0]):
        return Claim(what, Holds.UNKNOWN, f"{why}; {elsewhere}")
    return Claim(what, Holds.NO, why)


def _elsewhere(old: Row, new: Row) -> str:
    """What else was another, in words."""
    differ = [f"{told}" for name, told in _WHERE.items() if old[name] != new[name]]
    return f"other {' and '.join(differ)}" if differ else ""


_WHERE = {"machine": "machine", "versions": "libraries", "code": "code", "threads": "threads"}


def _ratio(old: tuple[Published, Published], new: tuple[list[Row], list[Row]]) -> Claim:
    was, now = (_seconds(pair) for pair in ((old[0].rows, old[1].rows), new))
    published, here = (statistics.changed(*pair).middle for pair in (was, now))
    apart = statistics.changed(*(_ratios(*pair) for pair in (now, was))).middle
    what = f"{old[0].title} takes {published:.3g} times as long as {old[1].run.solver.name}"
    why = f"here {here:.3g} times"
    elsewhere = _elsewhere(old[0].rows[0], new[0][0])
    limit = ELSEWHERE if elsewhere else RATIO
    if 1 / limit <= apart <= limit:
        return Claim(what, Holds.YES, why)
    disturbed = [row for found in (old[0].rows, old[1].rows, *new) for row in found if row["phase"] == "step"]
    share = sum(bool(row["interrupted"]) for row in disturbed) / len(disturbed)
    if elsewhere or share > 0.1:
        return Claim(what, Holds.UNKNOWN, f"{why}; {elsewhere or f'{100 * share:.0f} % of the steps were interrupted'}")
    return Claim(what, Holds.NO, why)


def _seconds(pair: tuple[Sequence[Row], Sequence[Row]]) -> list[dict[int, float]]:
    """Of the steps of two runs, by frame."""
    return [statistics.least((r["frame"], r["seconds"]) for r in run if r["phase"] == "step") for run in pair]


def _ratios(ours: Mapping[int, float], theirs: Mapping[int, float]) -> dict[int, float]:
    """How many times as long as theirs each frame's step takes."""
    return {frame: taken / theirs[frame] for frame, taken in ours.items() if frame in theirs}


def possible(runs: Sequence[Published]) -> list[Published]:
    """Those that this machine has cores for."""
    usable = machine.describe().cores
    return [one for one in runs if machine.threads(one.run.threads).number <= usable]
