"""Comparison of two pytest-benchmark files: detection of performance regressions.

A benchmark that was measured against a baseline stores `extra_info["ratio"]` (median, low, high). It is slower if the
new interval lies wholly above the old one by more than a margin. For other benchmarks the minima are compared, with a
wide margin; between two machines such a difference is only a remark. A missing benchmark counts as a regression, so
that deleting a benchmark cannot hide one. Without a common benchmark the result is "cannot tell".
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
from springbench.harness.report.results_comparison import INCONCLUSIVE_EXIT_CODE

RATIO_MARGIN = 0.10
"""Margin beyond both intervals: those of two runs of the same code differed by up to 4 % on a loaded machine."""
OTHER_MACHINE_MARGIN = 0.25
"""Margin for ratios from different machines: two programs do not speed up equally on another processor."""
MINIMUM_MARGIN = 0.5
"""Margin for minima: those of two runs differ by 4 % on an idle machine; another process on the core doubles them."""

_MAX_FILE_BYTES = 2**25
"""Maximum size of a stored file [bytes]; each time of each benchmark takes 20."""

REGRESSION_VERDICTS = ("slower", "vanished")


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
        told = self.machine_info.get("cpu")
        cpu = cast(Mapping[str, Any], told) if isinstance(told, Mapping) else dict[str, Any]()
        return (cpu.get("brand_raw"), cpu.get("count"), self.machine_info.get("affinity"))


def compare_benchmarks(base: Path, new: Path, console: Console) -> int:
    """Print a table of the changes from `base` to `new`.

    Args:
        base: pytest-benchmark file of the old version.
        new: pytest-benchmark file of the new version.
        console: console that the table is printed on.
    Returns: 1 if a benchmark became slower or is missing; INCONCLUSIVE_EXIT_CODE if there is no common benchmark;
        otherwise 0.
    Raises:
        InputError: if pytest-benchmark did not write one of the files.
    """
    old, now = read_stored_benchmarks(base), read_stored_benchmarks(new)
    if not old.benchmarks_by_name.keys() & now.benchmarks_by_name.keys():
        console.print(f"cannot tell: {base} and {new} have no benchmark in common", markup=False)
        return INCONCLUSIVE_EXIT_CODE
    same = old.machine_key == now.machine_key
    table = Table("benchmark", "old", "new", "change", "verdict", box=SIMPLE_HEAD)
    verdicts: list[str] = []
    for name in old.benchmarks_by_name | now.benchmarks_by_name:
        before, after = old.benchmarks_by_name.get(name), now.benchmarks_by_name.get(name)
        change, verdict = _classify_change(before, after, same)
        verdicts.append(verdict)
        table.add_row(
            *map(escape, (name.rpartition("::")[2], _format_time(before), _format_time(after), change, verdict))
        )
    console.print(split_wide_table(table))
    if not same:
        console.print("The files come from different machines: minima are not judged, ratios with a wider margin.")
    bad = sum(verdict in REGRESSION_VERDICTS for verdict in verdicts)
    console.print(f"{bad} of {len(verdicts)} became slower or vanished" if bad else "nothing became slower")
    return 1 if bad else 0


def _classify_change(old: BenchmarkRecord | None, new: BenchmarkRecord | None, same_machine: bool) -> tuple[str, str]:
    """Return the change and its class: slower, vanished, faster, unchanged, new, or not judged."""
    if old is None or new is None:
        return "", "new" if old is None else "vanished"
    was, now = old.extra_info.ratio, new.extra_info.ratio
    if was and not now:
        return "", "vanished"
    if was and now:
        margin = RATIO_MARGIN if same_machine else OTHER_MACHINE_MARGIN
        change = now.median / was.median
        slower, faster = now.low > was.high * (1 + margin), now.high * (1 + margin) < was.low
    else:
        change = new.stats.min / old.stats.min
        slower, faster = change > 1 + MINIMUM_MARGIN, change * (1 + MINIMUM_MARGIN) < 1
        if not same_machine and (slower or faster):
            return f"{change - 1:+.1%}", "not judged: other machine"
    return f"{change - 1:+.1%}", "slower" if slower else "faster" if faster else "unchanged"


def _format_time(benchmark: BenchmarkRecord | None) -> str:
    """Format the ratio with its interval, or the minimum if there is no ratio."""
    if benchmark is None:
        return ""
    ratio = benchmark.extra_info.ratio
    if ratio is None:
        return f"{1e3 * benchmark.stats.min:.3g} ms at best"
    return f"{ratio.median:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]"


def read_stored_benchmarks(path: Path) -> StoredBenchmarks:
    """Read the benchmarks of a pytest-benchmark file.

    Raises:
        InputError: if the file cannot be read, is too large or has another format.
    """
    wanted = "wanted a file that pytest-benchmark stored; `pytest tests/bench --benchmark-only` makes one"
    try:
        if path.exists() and not path.is_file():
            raise InputError(InputMistake(f"is no file; {wanted}", path))
        with path.open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
        if len(content) > _MAX_FILE_BYTES:
            raise InputError(InputMistake(f"has more than {_MAX_FILE_BYTES:,} bytes; {wanted}", path))
        return StoredBenchmarks.model_validate_json(content)
    except OSError as error:
        raise InputError(InputMistake(f"cannot be read ({error.strerror}); {wanted}", path)) from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(InputMistake(f"{first['msg']}; {wanted}", path, key=key)) from error
