"""Table of a speed report, compared with the machine's limits.

There is a line for each candidate at each size.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import cast

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table

from harness.base.statistics import Interval
from harness.report.page import count, quantity
from harness.report.speed.figures import STEP, Figures

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
    "of two passes\nover L",
    "step against eigen\ntimes faster",
    "with cheap\ntemporaries",
    "against careful\nC++ (cholmod)",
    "solve against\ncholespy",
    "converged, apart\nfrom float64",
    "load",
)


def speed_table(found: Sequence[Figures]) -> Table:
    """Build a table with a line for each candidate at each size.

    Speedups have their 95 % intervals.
    """
    title = "medians over the rounds, and of the ratios round by round with their 95 % intervals"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    table.add_column("scene", justify="right")
    table.add_column("candidate", no_wrap=True)
    for words in _NUMBERS:
        table.add_column(words, justify="right", no_wrap=True)
    where = _places(found)
    for _, group in groupby(found, key=lambda f: (f.scene, f.size)):
        for f in group:
            if f.status == "ok":
                table.add_row(where(f), _named(f), *_cells(f))
            else:
                table.add_row(where(f), f.label, f"[yellow]{f.status}[/]")
        table.add_section()
    return table


def _places(found: Sequence[Figures]) -> Callable[[Figures], str]:
    """Return a function that labels a candidate's scene.

    If there is one scene, the label is the size only.
    """
    if len({f.scene for f in found}) == 1:
        return lambda f: count(f.size)
    return lambda f: f"{f.scene} {count(f.size)}"


def _named(f: Figures) -> str:
    said = [f"{f.iterations} of {STEP}"] if f.iterations != STEP else []
    said += ["by other code"] if f.older else []
    return f"{f.label} ({', '.join(said)})" if said else f.label


def _cells(f: Figures) -> list[str]:
    return [
        *(_number(value) for value in (f.cold, f.warm, f.local, f.global_, f.step)),
        _number(f.bytes and f.bytes / 1e6),
        _number(f.touched and f.touched / 1e9),
        f.binds or "–",
        _share(f.reached),
        _share(f.passes),
        *(_ratio(interval) for interval in (f.faster, f.cheap_faster, f.careful_faster, f.solves_faster)),
        "–" if f.apart is None else f"{f.apart:.0e}",
        _number(f.load),
    ]


def _number(value: float | None) -> str:
    return "–" if value is None else quantity(value)


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _ratio(interval: Interval | None) -> str:
    return "–" if interval is None else f"{interval.middle:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


def remarks(found: Sequence[Figures]) -> list[str]:
    """Describe failures, choices of the solvers, and the scaling of a solve.

    Failed and omitted candidates are listed with their reasons.
    """
    where = _places(found)
    told: dict[str, list[str]] = defaultdict(list)
    for f in sorted(found, key=lambda f: f.status == "ok"):
        if f.status != "ok":
            told[f"{f.label}: {f.status}: {f.reason}"].append(where(f))
        elif f.choice and "auto" in f.label.split():
            told[f"{f.label} chose {f.choice}"].append(where(f))
    said = [f"{words} (at {', '.join(sizes)})" for words, sizes in told.items()]
    entries = exponents(found, "entries")
    for (scene, label), exponent in exponents(found).items():
        factor = f", its factor has n^{entries[scene, label]:.2f} entries" if (scene, label) in entries else ""
        said.append(f"{label}: from 10,000 vertices of {scene} on a solve costs n^{exponent:.2f}{factor}")
    return said


def exponents(found: Sequence[Figures], figure: str = "global_", least: int = 10_000) -> dict[tuple[str, str], float]:
    """Fit exponents of a figure's growth with size, by scene and label.

    Args:
        found: figures of all candidates.
        figure: field that is fitted; by default the time of a global step.
        least: smallest size that is included.
    """
    by_label: dict[tuple[str, str], list[tuple[int, float]]] = defaultdict(list)
    for f in found:
        value = getattr(f, figure)
        if value and f.vertices >= least:
            by_label[f.scene, f.label].append((f.vertices, value))
    logarithms = {label: np.log(np.array(points)).T for label, points in by_label.items() if len(points) > 1}
    return {
        label: float(cast(NDArray[np.float64], np.polyfit(n, values, 1))[0])
        for label, (n, values) in logarithms.items()
    }
