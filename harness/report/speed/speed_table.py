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
from springbench.harness.report.number_format import format_count, format_quantity
from springbench.harness.report.provenance_words import is_stale
from springbench.harness.report.speed.speed_figures import STEP_ITERATIONS, SpeedFigures
from springbench.harness.results.bootstrap_statistics import ConfidenceInterval

_NUMBER_HEADINGS = (
    "prepare\ncold ms",
    "\nwarm ms",
    "local\nms",
    "global\nms",
    f"step of\n{STEP_ITERATIONS} ms",
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


def build_speed_table(candidates: Sequence[SpeedFigures]) -> Table:
    """Build a table with a line for each candidate at each size.

    Speedups have their 95 % intervals.
    """
    title = "medians over the rounds, and of the ratios round by round with their 95 % intervals"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    table.add_column("scene", justify="right")
    table.add_column("candidate", no_wrap=True)
    for words in _NUMBER_HEADINGS:
        table.add_column(words, justify="right", no_wrap=True)
    where = _build_scene_labels(candidates)
    for _, group in groupby(candidates, key=lambda f: (f.scene, f.size)):
        for f in group:
            if f.status == "ok":
                table.add_row(where(f), _format_label(f), *_format_cells(f))
            else:
                table.add_row(where(f), f.label, f"[yellow]{f.status}[/]")
        table.add_section()
    return table


def _build_scene_labels(candidates: Sequence[SpeedFigures]) -> Callable[[SpeedFigures], str]:
    """Return a function that labels a candidate's scene.

    If there is one scene, the label is the size only.
    """
    if len({f.scene for f in candidates}) == 1:
        return lambda f: format_count(f.size)
    return lambda f: f"{f.scene} {format_count(f.size)}"


def _format_label(f: SpeedFigures) -> str:
    notes = [f"{f.iterations} of {STEP_ITERATIONS}"] if f.iterations != STEP_ITERATIONS else []
    notes += ["by other code"] if is_stale(f.source_fingerprint) else []
    return f"{f.label} ({', '.join(notes)})" if notes else f.label


def _format_cells(f: SpeedFigures) -> list[str]:
    return [
        *(_format_number(value) for value in (f.cold, f.warm, f.local, f.global_, f.step)),
        _format_number(f.bytes_moved and f.bytes_moved / 1e6),
        _format_number(f.achieved_bandwidth and f.achieved_bandwidth / 1e9),
        f.binding_limit or "–",
        _format_share(f.roofline_fraction),
        _format_share(f.two_pass_fraction),
        *(
            _format_ratio(interval)
            for interval in (f.speedup, f.speedup_over_cheap, f.speedup_over_cholmod, f.solve_speedup_over_cholespy)
        ),
        "–" if f.precision_error is None else f"{f.precision_error:.0e}",
        _format_number(f.load_average),
    ]


def _format_number(value: float | None) -> str:
    return "–" if value is None else format_quantity(value)


def _format_share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _format_ratio(interval: ConfidenceInterval | None) -> str:
    return "–" if interval is None else f"{interval.estimate:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


def describe_speed(candidates: Sequence[SpeedFigures]) -> list[str]:
    """Describe failures, choices of the solvers, and the scaling of a solve.

    Failed and omitted candidates are listed with their reasons.
    """
    where = _build_scene_labels(candidates)
    sizes_by_sentence: dict[str, list[str]] = defaultdict(list)
    for f in sorted(candidates, key=lambda f: f.status == "ok"):
        if f.status != "ok":
            sizes_by_sentence[f"{f.label}: {f.status}: {f.reason}"].append(where(f))
        elif f.solver_description and "auto" in f.label.split():
            sizes_by_sentence[f"{f.label} chose {f.solver_description}"].append(where(f))
    sentences = [f"{words} (at {', '.join(sizes)})" for words, sizes in sizes_by_sentence.items()]
    entries = fit_exponents(candidates, "factor_entries")
    for (scene, label), exponent in fit_exponents(candidates).items():
        factor = f", its factor has n^{entries[scene, label]:.2f} entries" if (scene, label) in entries else ""
        sentences.append(f"{label}: from 10,000 vertices of {scene} on a solve costs n^{exponent:.2f}{factor}")
    return sentences


def fit_exponents(
    candidates: Sequence[SpeedFigures], figure: str = "global_", min_vertices: int = 10_000
) -> dict[tuple[str, str], float]:
    """Fit exponents of a figure's growth with size, by scene and label.

    Args:
        candidates: figures of all candidates.
        figure: field that is fitted; by default the time of a global step.
        min_vertices: smallest size that is included.
    """
    by_label: dict[tuple[str, str], list[tuple[int, float]]] = defaultdict(list)
    for f in candidates:
        value = getattr(f, figure)
        if value and f.vertices >= min_vertices:
            by_label[f.scene, f.label].append((f.vertices, value))
    logarithms = {label: np.log(np.array(points)).T for label, points in by_label.items() if len(points) > 1}
    return {
        label: float(cast(NDArray[np.float64], np.polyfit(n, values, 1))[0])
        for label, (n, values) in logarithms.items()
    }
