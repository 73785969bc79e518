# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# ruptures has no types.
"""What the gates' stored results say over time: where did a gate become slower or faster, and by how much?

The stored results of a gate, on one kind of machine, in the order of their commits, are logarithms y of its ratio to
its yardstick (of its least time, where it has none), with noise of one standard deviation sigma, whose means change at
some commits. The changes are those of the least penalised negative log-likelihood (twice that, less a constant),

    sum over results of (y - mean of its stretch)^2 / sigma^2 + 5 log(n) for each change,

found exactly by PELT (Killick, Fearnhead and Eckley 2012; the library ruptures). Sigma comes from the differences of
neighbours, which a change hardly moves, and is no less than the results' own intervals say.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from harness.base.errors import InputError, Mistake
from harness.report.gate import Benchmark, Stored, read_stored

FEWEST = 6
"""Results of a gate below which nothing is said of changes: two stretches, and their noise."""
SHORTEST = 2
"""Results of a stretch: a single one that lies apart is an outlier."""
PENALTY = 5.0
"""Of a change, in log(n). The modified BIC (Zhang and Siegmund 2007) has about 3; then 14 of 200 series of 30 results
of noise alone show a change, with this 1 of 400, and 99 of 100 steps of five times the noise are placed within a
commit.
"""
FLOOR = 0.005
"""The least noise that is believed, of the logarithm: results are rounded, and repeat by chance."""
CHANGED = "*"
"""Behind a commit whose files were changed."""

_INTERVAL = 2 * 1.96
"""Standard deviations that a 95 % interval spans."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A stored result. value, low, high: the ratio to the yardstick, or the least time [s] alone."""

    commit: str
    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class GateHistory:
    """A gate on one kind of machine, in the order of its commits.

    starts: of its stretches, 0 first, the others are changes; ratio: whether values are ratios, or seconds.
    """

    gate: str
    machine: str
    ratio: bool
    points: tuple[StoredResult, ...]
    starts: tuple[int, ...]

    @property
    def levels(self) -> list[float]:
        """The geometric mean of each stretch."""
        ends = (*self.starts[1:], len(self.points))
        return [
            math.exp(float(np.mean([math.log(p.value) for p in self.points[a:b]])))
            for a, b in zip(self.starts, ends, strict=True)
        ]

    @property
    def changes(self) -> list[tuple[int, float]]:
        """Where the gate changed, and the ratio of its levels there."""
        levels = self.levels
        return [(at, new / old) for at, old, new in zip(self.starts[1:], levels, levels[1:], strict=False)]


def stored_files(places: Iterable[Path]) -> list[Path]:
    """The files of pytest-benchmark in these folders, and those that are named. Raises InputError for what is not
    there."""
    found: list[Path] = []
    for place in places:
        if not place.exists():
            raise InputError(Mistake("is not there; wanted a folder of pytest-benchmark, or a file of it", place))
        found += sorted(place.rglob("*.json")) if place.is_dir() else [place]
    return found


def history(files: Sequence[Path]) -> list[GateHistory]:
    """The gates in stored files and their changes; the largest first. Raises InputError for foreign files."""
    return histories(map(read_stored, files))


def histories(stored: Iterable[Stored]) -> list[GateHistory]:
    """The same of what was read from files."""
    points: dict[tuple[str, str, bool], list[StoredResult]] = defaultdict(list)
    for one in sorted(stored, key=lambda s: (s.commit_info.time or s.datetime, s.datetime)):
        for benchmark in one.benchmarks:
            key = benchmark.fullname.rpartition("::")[2], _machine(one), benchmark.extra_info.ratio is not None
            points[key].append(_point(one, benchmark))
    found = [GateHistory(*key, tuple(of_gate), changes(of_gate)) for key, of_gate in points.items()]
    return sorted(found, key=lambda s: (-max((abs(math.log(r)) for _, r in s.changes), default=0.0), s.gate))


def _machine(stored: Stored) -> str:
    cpu, cores, usable = stored.machine
    return f"{cpu or 'unknown processor'}, {usable or cores or '?'} cores"


def _point(stored: Stored, benchmark: Benchmark) -> StoredResult:
    commit = stored.commit_info.id[:7] + (CHANGED if stored.commit_info.dirty else "")
    ratio, least = benchmark.extra_info.ratio, benchmark.stats.min
    return (
        StoredResult(commit, ratio.median, ratio.low, ratio.high)
        if ratio
        else StoredResult(commit, least, least, least)
    )


def changes(points: Sequence[StoredResult]) -> tuple[int, ...]:
    """The starts of the stretches of results that belong together; 0 alone where nothing changed or little is known."""
    if len(points) < FEWEST:
        return (0,)
    from ruptures import Pelt

    y: Array = np.log([p.value for p in points])
    sigma = max(noise(y), float(np.median([math.log(p.high / p.low) for p in points])) / _INTERVAL)
    fitted: Any = Pelt(model="l2", min_size=SHORTEST, jump=1).fit(y / sigma)
    found: list[int] = fitted.predict(pen=PENALTY * math.log(len(y)))
    return (0, *found[:-1])


def noise(y: Array) -> float:
    """The standard deviation of results about their stretch's mean, by the median difference of neighbours."""
    apart = np.abs(np.diff(y))
    return max(float(np.median(apart)) / (0.6745 * math.sqrt(2)), FLOOR)


def history_table(found: Sequence[GateHistory]) -> Table:
    """The gates, their last level, and their changes in words."""
    table = Table("gate", "results", "now", "changes", box=SIMPLE_HEAD)
    for series in found:
        told = [f"{100 * (r - 1):+.1f} % at {series.points[k].commit}" for k, r in series.changes]
        few = f"too few to tell; wanted {FEWEST}" if len(series.points) < FEWEST else "none"
        now = f"{series.levels[-1]:.3g}" if series.ratio else f"{1e3 * series.levels[-1]:.3g} ms"
        table.add_row(escape(series.gate), str(len(series.points)), now, ", ".join(told) or few)
    return table
