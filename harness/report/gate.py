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

from harness.base.console import narrow
from harness.base.errors import InputError, Mistake
from harness.report.stored import CANNOT_TELL

RATIO_MARGIN = 0.10
"""Margin beyond both intervals: those of two runs of the same code differed by up to 4 % on a loaded machine."""
OTHER_MACHINE_MARGIN = 0.25
"""Margin for ratios from different machines: two programs do not speed up equally on another processor."""
MINIMUM_MARGIN = 0.5
"""Margin for minima: those of two runs differ by 4 % on an idle machine; another process on the core doubles them."""

_MOST = 2**25
"""Maximum size of a stored file [bytes]; each time of each benchmark takes 20."""

REGRESSIONS = ("slower", "vanished")


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Ratio(BaseModel):
    """A median ratio of times and its 95 % interval."""

    median: Positive
    low: Positive
    high: Positive

    @model_validator(mode="after")
    def _in_order(self) -> Ratio:
        if not self.low <= self.median <= self.high:
            raise ValueError(f"the median {self.median:g} lies outside of its interval")
        return self


class Extra(BaseModel):
    """Additional data of a benchmark, besides its times."""

    ratio: Ratio | None = None


class Stats(BaseModel):
    """The times of a benchmark [s]."""

    min: Positive


class Benchmark(BaseModel):
    """One benchmark of a file."""

    fullname: str
    extra_info: Extra
    stats: Stats


class Commit(BaseModel):
    """The version of the measured code; `time` is that of the commit, ISO 8601."""

    id: str = "unknown"
    time: str | None = None
    dirty: bool = False


class Stored(BaseModel):
    """The compared part of a pytest-benchmark file; unknown keys are ignored.

    Attributes:
        datetime: time of the measurement, ISO 8601.
    """

    datetime: str = ""
    commit_info: Commit = Commit()
    machine_info: Mapping[str, Any]
    benchmarks: list[Benchmark] = Field(min_length=1)

    @property
    def by_name(self) -> dict[str, Benchmark]:
        """The benchmarks by the names of their tests."""
        return {benchmark.fullname: benchmark for benchmark in self.benchmarks}

    @property
    def machine(self) -> tuple[Any, ...]:
        """The properties that determine speed: the processor, its number of cores and the usable cores."""
        told = self.machine_info.get("cpu")
        cpu = cast(Mapping[str, Any], told) if isinstance(told, Mapping) else dict[str, Any]()
        return (cpu.get("brand_raw"), cpu.get("count"), self.machine_info.get("affinity"))


def compare(base: Path, new: Path, console: Console) -> int:
    """Print a table of the changes from `base` to `new`.

    Args:
        base: pytest-benchmark file of the old version.
        new: pytest-benchmark file of the new version.
        console: console that the table is printed on.
    Returns: 1 if a benchmark became slower or is missing; CANNOT_TELL if there is no common benchmark;
        otherwise 0.
    Raises:
        InputError: if pytest-benchmark did not write one of the files.
    """
    old, now = read_stored(base), read_stored(new)
    if not old.by_name.keys() & now.by_name.keys():
        console.print(f"cannot tell: {base} and {new} have no benchmark in common", markup=False)
        return CANNOT_TELL
    same = old.machine == now.machine
    table = Table("benchmark", "old", "new", "change", "verdict", box=SIMPLE_HEAD)
    verdicts: list[str] = []
    for name in old.by_name | now.by_name:
        before, after = old.by_name.get(name), now.by_name.get(name)
        change, verdict = _judged(before, after, same)
        verdicts.append(verdict)
        table.add_row(*map(escape, (name.rpartition("::")[2], _figure(before), _figure(after), change, verdict)))
    console.print(narrow(table))
    if not same:
        console.print("The files come from different machines: minima are not judged, ratios with a wider margin.")
    bad = sum(verdict in REGRESSIONS for verdict in verdicts)
    console.print(f"{bad} of {len(verdicts)} became slower or vanished" if bad else "nothing became slower")
    return 1 if bad else 0


def _judged(old: Benchmark | None, new: Benchmark | None, same_machine: bool) -> tuple[str, str]:
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


def _figure(benchmark: Benchmark | None) -> str:
    """Format the ratio with its interval, or the minimum if there is no ratio."""
    if benchmark is None:
        return ""
    ratio = benchmark.extra_info.ratio
    if ratio is None:
        return f"{1e3 * benchmark.stats.min:.3g} ms at best"
    return f"{ratio.median:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]"


def read_stored(path: Path) -> Stored:
    """Read the benchmarks of a pytest-benchmark file.

    Raises:
        InputError: if the file cannot be read, is too large or has another format.
    """
    wanted = "wanted a file that pytest-benchmark stored; `pytest tests/bench --benchmark-only` makes one"
    try:
        if path.exists() and not path.is_file():
            raise InputError(Mistake(f"is no file; {wanted}", path))
        with path.open("rb") as file:
            content = file.read(_MOST + 1)
        if len(content) > _MOST:
            raise InputError(Mistake(f"has more than {_MOST:,} bytes; {wanted}", path))
        return Stored.model_validate_json(content)
    except OSError as error:
        raise InputError(Mistake(f"cannot be read ({error.strerror}); {wanted}", path)) from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(Mistake(f"{first['msg']}; {wanted}", path, key=key)) from error
