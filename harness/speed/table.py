"""The table of a speed report: a line for each candidate at each size, and what the machine itself can do."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import groupby

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from harness.report.page import count, quantity
from harness.speed.figures import STEP, Figures, Interval

_NUMBERS = (
    "prepare\ncold ms",
    "\nwarm ms",
    "local\nms",
    "global\nms",
    f"step of\n{STEP} ms",
    "an iteration\ntouches MB",
    "\nGB/s",
    "what\nbinds",
    "of that\nlimit",
    "by nnz(L)\nalone",
    "step against eigen\ntimes faster",
    "with cheap\ntemporaries",
    "solve against\ncholespy",
    "load",
)


def speed_table(found: Sequence[Figures]) -> Table:
    """A line for each candidate at each size; ratios with their 95 % intervals."""
    table = Table(box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    table.add_column("size", justify="right")
    table.add_column("candidate", no_wrap=True)
    for words in _NUMBERS:
        table.add_column(words, justify="right", no_wrap=True)
    for _, group in groupby(found, key=lambda f: (f.scene, f.size)):
        for f in group:
            if f.status == "ok":
                table.add_row(count(f.size), _named(f), *_cells(f))
            else:
                table.add_row(count(f.size), f.label, f"[yellow]{f.status}[/]")
        table.add_section()
    return table


def _named(f: Figures) -> str:
    return f.label if f.iterations == STEP else f"{f.label} ({f.iterations} of {STEP})"


def _cells(f: Figures) -> list[str]:
    return [
        *(_number(value) for value in (f.cold, f.warm, f.local, f.global_, f.step)),
        _number(f.bytes and f.bytes / 1e6),
        _number(f.touched and f.touched / 1e9),
        f.binds or "–",
        _share(f.reached),
        _share(f.least),
        *(_ratio(interval) for interval in (f.faster, f.cheap_faster, f.solves_faster)),
        _number(f.load),
    ]


def _number(value: float | None) -> str:
    return "–" if value is None else quantity(value)


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _ratio(interval: Interval | None) -> str:
    return "–" if interval is None else f"{interval.ratio:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


def remarks(found: Sequence[Figures]) -> list[str]:
    """What was left out or failed and why, what the solvers chose, and how the cost of a solve grows."""
    told: dict[str, list[str]] = defaultdict(list)
    for f in sorted(found, key=lambda f: f.status == "ok"):
        if f.status != "ok":
            told[f"{f.label}: {f.status}: {f.reason}"].append(str(f.size))
        elif f.choice and "auto" in f.label.split():
            told[f"{f.label} chose {f.choice}"].append(str(f.size))
    said = [f"{words} (at {', '.join(sizes)})" for words, sizes in told.items()]
    for label, exponent in exponents(found).items():
        said.append(f"{label}: from 10,000 vertices on a solve costs n^{exponent:.2f}")
    return said


def exponents(found: Sequence[Figures], least: int = 10_000) -> dict[str, float]:
    """The power of n by which the global step's time grows, by label, where several sizes have `least` vertices."""
    by_label: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for f in found:
        if f.global_ and f.vertices >= least:
            by_label[f.label].append((f.vertices, f.global_))
    logarithms = {label: np.log(np.array(points)).T for label, points in by_label.items() if len(points) > 1}
    return {label: float(np.polyfit(n, seconds, 1)[0]) for label, (n, seconds) in logarithms.items()}
