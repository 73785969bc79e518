"""Chart of a speed report for the results page.

It shows times and bandwidth by size, compared with the machine's limits.
"""

from __future__ import annotations

from typing import Any

import pyarrow as pa

from harness.report.site.marks import LOG, axis, drawn
from harness.report.site.runs import MACHINE, references
from harness.report.site.script import number
from harness.report.speed.figures import Figures, figures
from harness.report.speed.speed_table import remarks
from harness.report.style import looks

_LINEAR = {"rangemode": "tozero"}
_SHARE = {"rangemode": "tozero", "tickformat": ".0%"}
_COLUMNS = {
    "step": axis("step", "ms, a step of 50 iterations"),
    "global_": axis("global_", "ms, a global step"),
    "local": axis("local", "ms, a local step"),
    "warm": axis("warm", "ms, to prepare, warm"),
    "touched": axis("touched", "bytes a second that an iteration touches", LOG),
    "reached": axis("reached", "of the limit that binds", _SHARE),
    "faster": axis("faster", "times faster than the yardstick in C++", _LINEAR),
}


def is_speed(table: pa.Table) -> bool:
    """Return whether rows belong to a speed report, which contains the machine's own limits."""
    return MACHINE in table["solver"].unique().to_pylist()


def chart(table: pa.Table) -> tuple[dict[str, Any], list[str]]:
    """Build the chart, and remarks in sentences."""
    found = figures(table)
    timed = [f for f in found if f.status == "ok"]
    reference = dict(zip(*(table[name].to_pylist() for name in ("solver", "reference")), strict=True))
    lines: dict[tuple[str, str], list[Figures]] = {}
    for f in sorted(timed, key=lambda f: f.vertices):
        lines.setdefault((f.scene, f.label), []).append(f)
    marks = looks((f.label, f.solver) for f in timed)
    dated = zip(*(table[name].to_pylist() for name in ("started", "code")), strict=True)
    newest = max(((started or "", code or "") for started, code in dated), default=("", ""))[1]
    hover = [["vertices", "vertices"], ["step", "ms a step"], ["global_", "ms a global step"]]
    return {
        "title": "Speed and its limits",
        "note": "Medians over the rounds. A limit is what the machine reads or computes at most, measured beside the "
        "solvers; the yardstick is the same method in C++ with Eigen.",
        "filters": ["scene"],
        "x": [axis("vertices", "vertices")],
        "y": list(_COLUMNS.values()),
        "hover": [*hover, ["binds", "limit that binds"], ["reached", "share of that limit reached"]],
        "items": [_item(scene, label, some, newest) for (scene, label), some in lines.items()],
        "marks": {label: drawn(mark) for label, mark in marks.items()},
        "references": references((f.label, reference.get(f.solver)) for f in timed),
        "command": "springbench speed CONFIG --again",
    }, remarks(found)


def _item(scene: str, label: str, some: list[Figures], newest: str) -> dict[str, Any]:
    names = ("vertices", *(name for name in _COLUMNS if name != "faster"))
    columns = {name: [number(getattr(f, name)) for f in some] for name in names}
    columns["faster"] = [number(f.faster and f.faster.middle) for f in some]
    ends = {f"faster_{end}": [number(getattr(f.faster, end, None)) for f in some] for end in ("low", "high")}
    threads = f"{some[0].threads} thread{'s' if some[0].threads > 1 else ''}"
    told = {"label": label, "what": f"{scene}, {threads}", "scene": scene, "panel": scene, "parameters": "{}"}
    return told | columns | ends | {"binds": [f.binds for f in some], "older": [f.code != newest for f in some]}
