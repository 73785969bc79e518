"""Detection of changes in the stored results of benchmarks over time.

The results of a benchmark on one kind of machine, in the order of their commits, are logarithms y of its ratio to the
baseline (of its minimum time, if it has no baseline). They have noise with one standard deviation sigma, and means that
change at some commits. The changes minimise the penalised negative log-likelihood (times two, up to a constant),

    sum over results of (y - mean of its segment)^2 / sigma^2 + 5 log(n) per change,

found exactly by dynamic programming over the last change (optimal partitioning, Jackson et al. 2005), in O(n^2). Sigma
is estimated from differences of neighbours, which a change hardly affects, and is at least as large as the results' own
intervals imply.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.benchmark_comparison import BenchmarkRecord, StoredBenchmarks, read_stored_benchmarks

MIN_RESULTS = 6
"""Minimum number of results for change detection: two segments, and their noise."""
MIN_SEGMENT_RESULTS = 2
"""Minimum number of results in a segment: a single deviating result is an outlier."""
CHANGE_PENALTY = 5.0
"""Penalty of a change, in units of log(n).

The modified BIC (Zhang and Siegmund 2007) has about 3; then 14 of 200 series of 30 results of pure noise show a change.
With 5 it is 1 of 400 series, and 99 of 100 steps of five times the noise are located within one commit.
"""
NOISE_FLOOR = 0.005
"""Minimum noise of the logarithm: results are rounded, and may coincide by chance."""
DIRTY_MARK = "*"
"""Suffix of a commit whose files were modified."""

_INTERVAL_SIGMAS = 2 * 1.96
"""Width of a 95 % interval [standard deviations]."""

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BenchmarkPoint:
    """A stored benchmark result.

    `value`, `low` and `high` are the ratio to the baseline, or all three the minimum time [s].
    """

    commit: str
    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class BenchmarkHistory:
    """Results of a benchmark on one kind of machine, in the order of their commits.

    Attributes:
        is_ratio: whether values are ratios; otherwise they are seconds.
        segment_starts: first index of each segment; 0 is first, the others are changes.
    """

    benchmark_name: str
    machine_words: str
    is_ratio: bool
    points: tuple[BenchmarkPoint, ...]
    segment_starts: tuple[int, ...]

    @property
    def segment_levels(self) -> list[float]:
        """The geometric mean of each segment."""
        ends = (*self.segment_starts[1:], len(self.points))
        return [
            math.exp(float(np.mean([math.log(p.value) for p in self.points[a:b]])))
            for a, b in zip(self.segment_starts, ends, strict=True)
        ]

    @property
    def level_changes(self) -> list[tuple[int, float]]:
        """The index and the ratio of new to old level of each change."""
        levels = self.segment_levels
        return [(at, new / old) for at, old, new in zip(self.segment_starts[1:], levels, levels[1:], strict=False)]


def find_stored_files(paths: Iterable[Path]) -> list[Path]:
    """Return the pytest-benchmark files in these folders, and the files among the paths.

    Raises:
        InputError: if a path does not exist.
    """
    found: list[Path] = []
    for place in paths:
        if not place.exists():
            raise InputError(InputMistake("does not exist; expected a folder or a file of pytest-benchmark", place))
        found += sorted(place.rglob("*.json")) if place.is_dir() else [place]
    return found


def read_histories(files: Sequence[Path]) -> list[BenchmarkHistory]:
    """Read the benchmark histories in stored files, the largest change first.

    Raises:
        InputError: if pytest-benchmark did not write one of the files.
    """
    return build_histories(map(read_stored_benchmarks, files))


def build_histories(stored: Iterable[StoredBenchmarks]) -> list[BenchmarkHistory]:
    """Build the benchmark histories of stored results, the largest change first."""
    points: dict[tuple[str, str, bool], list[BenchmarkPoint]] = defaultdict(list)
    for one in sorted(stored, key=lambda s: (s.commit_info.time or s.datetime, s.datetime)):
        for benchmark in one.benchmarks:
            key = benchmark.fullname.rpartition("::")[2], _describe_machine(one), benchmark.extra_info.ratio is not None
            points[key].append(_build_point(one, benchmark))
    found = [BenchmarkHistory(*key, tuple(some), detect_changes(some)) for key, some in points.items()]
    return sorted(
        found, key=lambda s: (-max((abs(math.log(r)) for _, r in s.level_changes), default=0.0), s.benchmark_name)
    )


def _describe_machine(stored: StoredBenchmarks) -> str:
    cpu, cores, usable = stored.machine_key
    return f"{cpu or 'unknown processor'}, {usable or cores or '?'} cores"


def _build_point(stored: StoredBenchmarks, benchmark: BenchmarkRecord) -> BenchmarkPoint:
    commit = stored.commit_info.id[:7] + (DIRTY_MARK if stored.commit_info.dirty else "")
    ratio, least = benchmark.extra_info.ratio, benchmark.stats.min
    return (
        BenchmarkPoint(commit, ratio.median, ratio.low, ratio.high)
        if ratio
        else BenchmarkPoint(commit, least, least, least)
    )


def detect_changes(points: Sequence[BenchmarkPoint]) -> tuple[int, ...]:
    """Return the starts of the segments.

    The result is (0,) if nothing changed or there are too few results.
    """
    if len(points) < MIN_RESULTS:
        return (0,)
    y: FloatArray = np.log([p.value for p in points])
    sigma = max(estimate_noise(y), float(np.median([math.log(p.high / p.low) for p in points])) / _INTERVAL_SIGMAS)
    return partition_series(y / sigma, CHANGE_PENALTY * math.log(len(y)))


def partition_series(y: FloatArray, penalty: float) -> tuple[int, ...]:
    """Return the starts of the segments that minimise squared deviations plus a penalty per change.

    Args:
        y: at least MIN_SEGMENT_RESULTS values (n,).
        penalty: cost of a change.
    """
    n, y = len(y), y - y.mean()
    sums, squares = (np.concatenate([[0.0], np.cumsum(values)]) for values in (y, y * y))
    least, last = np.full(n + 1, np.inf), np.zeros(n + 1, np.int64)
    least[0] = -penalty  # the first segment begins without a change
    for end in range(MIN_SEGMENT_RESULTS, n + 1):
        start = np.arange(end - MIN_SEGMENT_RESULTS + 1)
        cost = squares[end] - squares[start] - (sums[end] - sums[start]) ** 2 / (end - start)
        total = least[start] + cost + penalty
        last[end] = np.argmin(total)
        least[end] = total[last[end]]
    starts = [int(last[n])]
    while starts[0]:
        starts.insert(0, int(last[starts[0]]))
    return tuple(starts)


def estimate_noise(y: FloatArray) -> float:
    """Estimate the standard deviation of the noise from the median difference of neighbours."""
    differences = np.abs(np.diff(y))
    # The median of |x| is 0.6745 sigma for normal x; the difference of two results has sqrt(2) sigma.
    return max(float(np.median(differences)) / (0.6745 * math.sqrt(2)), NOISE_FLOOR)


def build_history_table(histories: Sequence[BenchmarkHistory]) -> Table:
    """Build a table of the benchmarks, their last level and their changes."""
    table = Table("benchmark", "results", "level", "changes", box=SIMPLE_HEAD)
    for series in histories:
        changes = [f"{100 * (r - 1):+.1f} % at {series.points[k].commit}" for k, r in series.level_changes]
        none = f"inconclusive: fewer than {MIN_RESULTS} results" if len(series.points) < MIN_RESULTS else "none"
        level = f"{series.segment_levels[-1]:.3g}" if series.is_ratio else f"{1e3 * series.segment_levels[-1]:.3g} ms"
        table.add_row(escape(series.benchmark_name), str(len(series.points)), level, ", ".join(changes) or none)
    return table
