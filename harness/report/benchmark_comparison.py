"""Comparison of two pytest-benchmark files: detection of performance regressions.

A benchmark that was measured against a baseline stores `extra_info["ratio"]` (median, low, high). It is slower if the
new interval lies wholly above the old one by more than a margin. For other benchmarks the minima are compared, with a
wide margin; between two machines such a difference is inconclusive. A missing benchmark fails, so that deleting a
benchmark cannot hide a regression. Without a common benchmark the comparison is inconclusive.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, cast

from pydantic import BaseModel, Field, ValidationError, model_validator
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from springbench.harness.console import split_wide_table
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results.regression_verdict import RegressionVerdict, combine_verdicts, describe_counts

RATIO_MARGIN = 0.10
"""Margin beyond both intervals: those of two runs of the same code differed by up to 4 % on a loaded machine."""
OTHER_MACHINE_MARGIN = 0.25
"""Margin for ratios from different machines: two programs do not speed up equally on another processor."""
MINIMUM_MARGIN = 0.5
"""Margin for minima: those of two runs differ by 4 % on an idle machine; another process on the core doubles them."""

_MAX_FILE_BYTES = 2**25
"""Maximum size of a stored file [bytes]; each time of each benchmark takes 20."""

PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class TimeRatio(BaseModel):
    """A median ratio of times and its 95 % interval."""

    median: PositiveFloat
    low: PositiveFloat
    high: PositiveFloat

    @model_validator(mode="after")
    def _check_interval_order(self) -> TimeRatio:
        if not self.low <= self.median <= self.high:
            raise ValueError(f"the median {self.median:g} lies outside of its interval")
        return self


class BenchmarkExtra(BaseModel):
    """Additional data of a benchmark, besides its times."""

    ratio: TimeRatio | None = None


class BenchmarkStats(BaseModel):
    """The times of a benchmark [s]."""

    min: PositiveFloat


class BenchmarkRecord(BaseModel):
    """One benchmark of a file."""

    fullname: str
    extra_info: BenchmarkExtra
    stats: BenchmarkStats


class CommitInfo(BaseModel):
    """The version of the measured code; `time` is that of the commit, ISO 8601."""

    id: str = "unknown"
    time: str | None = None
    dirty: bool = False


class StoredBenchmarks(BaseModel):
    """The compared part of a pytest-benchmark file; unknown keys are ignored.

    Attributes:
        datetime: time of the measurement, ISO 8601.
    """

    datetime: str = ""
    commit_info: CommitInfo = CommitInfo()
    machine_info: Mapping[str, Any]
    benchmarks: list[BenchmarkRecord] = Field(min_length=1)

    @property
    def benchmarks_by_name(self) -> dict[str, BenchmarkRecord]:
        """The benchmarks by the names of their tests."""
        return {benchmark.fullname: benchmark for benchmark in self.benchmarks}

    @property
    def machine_key(self) -> tuple[Any, ...]:
        """The properties that determine speed: the processor, its number of cores and the usable cores."""
        stored = self.machine_info.get("cpu")
        cpu = cast(Mapping[str, Any], stored) if isinstance(stored, Mapping) else dict[str, Any]()
        return (cpu.get("brand_raw"), cpu.get("count"), self.machine_info.get("affinity"))


def compare_benchmarks(baseline: Path, new: Path, console: Console) -> RegressionVerdict:
    """Print a table of the changes from `baseline` to `new`.

    Args:
        baseline: pytest-benchmark file of the old version.
        new: pytest-benchmark file of the new version.
        console: console that the table is printed on.

    Returns:
        The verdict of all benchmarks; a new one has none.

    Raises:
        InputError: if pytest-benchmark did not write one of the files.
    """
    before, after = read_stored_benchmarks(baseline), read_stored_benchmarks(new)
    if not before.benchmarks_by_name.keys() & after.benchmarks_by_name.keys():
        console.print(f"inconclusive: {baseline} and {new} have no benchmark in common", markup=False)
        return RegressionVerdict.INCONCLUSIVE
    is_same_machine = before.machine_key == after.machine_key
    table = Table("benchmark", "baseline", "new", "change", "verdict", box=SIMPLE_HEAD)
    verdicts: list[RegressionVerdict] = []
    for name in before.benchmarks_by_name | after.benchmarks_by_name:
        old, now = before.benchmarks_by_name.get(name), after.benchmarks_by_name.get(name)
        change, verdict, remark = _classify_change(old, now, is_same_machine)
        verdicts += [verdict] if verdict else []
        words = ": ".join(filter(None, (verdict, remark)))
        table.add_row(*map(escape, (name.rpartition("::")[2], _format_time(old), _format_time(now), change, words)))
    console.print(split_wide_table(table))
    if not is_same_machine:
        console.print("The files come from different machines: only ratios are compared, with a wider margin.")
    verdict = combine_verdicts(verdicts)
    console.print(f"{verdict}: {describe_counts(verdicts)}")
    return verdict


def _classify_change(
    old: BenchmarkRecord | None, new: BenchmarkRecord | None, is_same_machine: bool
) -> tuple[str, RegressionVerdict | None, str]:
    """Return the change, the verdict (None for a new benchmark), and a remark."""
    if old is None or new is None:
        return ("", None, "new") if old is None else ("", RegressionVerdict.FAIL, "missing")
    was, now = old.extra_info.ratio, new.extra_info.ratio
    if was and not now:
        return "", RegressionVerdict.FAIL, "its ratio is missing"
    if was and now:
        margin = RATIO_MARGIN if is_same_machine else OTHER_MACHINE_MARGIN
        change = now.median / was.median
        slower, faster = now.low > was.high * (1 + margin), now.high * (1 + margin) < was.low
    else:
        change = new.stats.min / old.stats.min
        slower, faster = change > 1 + MINIMUM_MARGIN, change * (1 + MINIMUM_MARGIN) < 1
        if not is_same_machine and (slower or faster):
            return f"{change - 1:+.1%}", RegressionVerdict.INCONCLUSIVE, "another machine"
    verdict = RegressionVerdict.FAIL if slower else RegressionVerdict.PASS
    return f"{change - 1:+.1%}", verdict, "slower" if slower else "faster" if faster else ""


def _format_time(benchmark: BenchmarkRecord | None) -> str:
    """Format the ratio with its interval, or the minimum if there is no ratio."""
    if benchmark is None:
        return ""
    ratio = benchmark.extra_info.ratio
    if ratio is None:
        return f"{1e3 * benchmark.stats.min:.3g} ms (minimum)"
    return f"{ratio.median:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]"


def read_stored_benchmarks(path: Path) -> StoredBenchmarks:
    """Read the benchmarks of a pytest-benchmark file.

    Raises:
        InputError: if the file cannot be read, is too large or has another format.
    """
    expected = "expected a file that pytest-benchmark stored; `pytest tests/bench --benchmark-only` stores one"
    try:
        if path.exists() and not path.is_file():
            raise InputError(InputMistake(f"is not a file; {expected}", path))
        with path.open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
        if len(content) > _MAX_FILE_BYTES:
            raise InputError(InputMistake(f"has more than {_MAX_FILE_BYTES:,} bytes; {expected}", path))
        return StoredBenchmarks.model_validate_json(content)
    except OSError as error:
        raise InputError(InputMistake(f"cannot be read ({error.strerror}); {expected}", path)) from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(InputMistake(f"{first['msg']}; {expected}", path, key=key)) from error
