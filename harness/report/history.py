# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# ruptures has no types.
"""Detection of changes in the stored results of benchmarks over time.

The results of a benchmark on one kind of machine, in the order of their commits, are logarithms y of its ratio to the
baseline (of its minimum time, if it has no baseline). They have noise with one standard deviation sigma, and means that
change at some commits. The changes minimise the penalised negative log-likelihood (times two, up to a constant),

    sum over results of (y - mean of its segment)^2 / sigma^2 + 5 log(n) per change,

found exactly by PELT (Killick, Fearnhead and Eckley 2012; the library ruptures). Sigma is estimated from differences of
neighbours, which a change hardly affects, and is at least as large as the results' own intervals imply.
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
"""Minimum number of results for change detection: two segments, and their noise."""
SHORTEST = 2
"""Minimum number of results in a segment: a single deviating result is an outlier."""
PENALTY = 5.0
"""Penalty of a change, in units of log(n).

The modified BIC (Zhang and Siegmund 2007) has about 3; then 14 of 200 series of 30 results of pure noise show a change.
With 5 it is 1 of 400 series, and 99 of 100 steps of five times the noise are located within one commit.
"""
FLOOR = 0.005
"""Minimum noise of the logarithm: results are rounded, and may coincide by chance."""
CHANGED = "*"
"""Suffix of a commit whose files were modified."""

_INTERVAL = 2 * 1.96
"""Width of a 95 % interval [standard deviations]."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A stored benchmark result.

    `value`, `low` and `high` are the ratio to the baseline, or all three the minimum time [s].
    """

    commit: str
    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class GateHistory:
    """Results of a benchmark on one kind of machine, in the order of their commits.

    Attributes:
        ratio: whether values are ratios; otherwise they are seconds.
        starts: first index of each segment; 0 is first, the others are changes.
    """

    gate: str
    machine: str
    ratio: bool
    points: tuple[StoredResult, ...]
    starts: tuple[int, ...]

    @property
    def levels(self) -> list[float]:
        """The geometric mean of each segment."""
        ends = (*self.starts[1:], len(self.points))
        return [
            math.exp(float(np.mean([math.log(p.value) for p in self.points[a:b]])))
            for a, b in zip(self.starts, ends, strict=True)
        ]

    @property
    def changes(self) -> list[tuple[int, float]]:
        """The index and the ratio of new to old level of each change."""
        levels = self.levels
        return [(at, new / old) for at, old, new in zip(self.starts[1:], levels, levels[1:], strict=False)]


def stored_files(places: Iterable[Path]) -> list[Path]:
    """Return the pytest-benchmark files in these folders, and the files among the paths.

    Raises:
        InputError: if a path does not exist.
    """
    found: list[Path] = []
    for place in places:
        if not place.exists():
            raise InputError(Mistake("is not there; wanted a folder of pytest-benchmark, or a file of it", place))
        found += sorted(place.rglob("*.json")) if place.is_dir() else [place]
    return found


def history(files: Sequence[Path]) -> list[GateHistory]:
    """Read the benchmark histories in stored files, the largest change first.

    Raises:
        InputError: if pytest-benchmark did not write one of the files.
    """
    return histories(map(read_stored, files))


def histories(stored: Iterable[Stored]) -> list[GateHistory]:
    """Build the benchmark histories of stored results, the largest change first."""
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
    """Return the starts of the segments.

    The result is (0,) if nothing changed or there are too few results.
    """
    if len(points) < FEWEST:
        return (0,)
    from ruptures import Pelt

    y: Array = np.log([p.value for p in points])
    sigma = max(noise(y), float(np.median([math.log(p.high / p.low) for p in points])) / _INTERVAL)
    fitted: Any = Pelt(model="l2", min_size=SHORTEST, jump=1).fit(y / sigma)
    found: list[int] = fitted.predict(pen=PENALTY * math.log(len(y)))
    return (0, *found[:-1])


def noise(y: Array) -> float:
    """Estimate the noise of results around their segment's mean from the median difference of neighbours."""
    apart = np.abs(np.diff(y))
    return max(float(np.median(apart)) / (0.6745 * math.sqrt(2)), FLOOR)


def history_table(found: Sequence[GateHistory]) -> Table:
    """Build a table of the benchmarks, their last level and their changes."""
    table = Table("gate", "results", "now", "changes", box=SIMPLE_HEAD)
    for series in found:
        told = [f"{100 * (r - 1):+.1f} % at {series.points[k].commit}" for k, r in series.changes]
        few = f"too few to tell; wanted {FEWEST}" if len(series.points) < FEWEST else "none"
        now = f"{series.levels[-1]:.3g}" if series.ratio else f"{1e3 * series.levels[-1]:.3g} ms"
        table.add_row(escape(series.gate), str(len(series.points)), now, ", ".join(told) or few)
    return table
