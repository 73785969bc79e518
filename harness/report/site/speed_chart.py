"""Chart of a speed report for the results page.

It shows times and bandwidth by size, compared with the machine's limits.
"""

from __future__ import annotations

from typing import Any

import pyarrow as pa
from springbench.harness.report.plot_style import assign_label_styles
from springbench.harness.report.site.data_scripts import round_number
from springbench.harness.report.site.plotly_styles import LOG_AXIS, axis_choice, plotly_style
from springbench.harness.report.site.run_table import MACHINE_SOLVER, format_references
from springbench.harness.report.speed.speed_figures import SpeedFigures, compute_speed_figures
from springbench.harness.report.speed.speed_table import describe_speed

_LINEAR_AXIS = {"rangemode": "tozero"}
_SHARE_AXIS = {"rangemode": "tozero", "tickformat": ".0%"}
_AXIS_CHOICES = {
    "step": axis_choice("step", "ms, a step of 50 iterations"),
    "global_": axis_choice("global_", "ms, a global step"),
    "local": axis_choice("local", "ms, a local step"),
    "warm": axis_choice("warm", "ms, to prepare, warm"),
    "achieved_bandwidth": axis_choice("achieved_bandwidth", "bytes a second that an iteration touches", LOG_AXIS),
    "roofline_fraction": axis_choice("roofline_fraction", "of the limit that binds", _SHARE_AXIS),
    "speedup": axis_choice("speedup", "times faster than the yardstick in C++", _LINEAR_AXIS),
}


def has_machine_limits(table: pa.Table) -> bool:
    """Return whether rows belong to a speed report, which contains the machine's own limits."""
    return MACHINE_SOLVER in table["solver"].unique().to_pylist()


def build_speed_chart(table: pa.Table) -> tuple[dict[str, Any], list[str]]:
    """Build the chart, and remarks in sentences."""
    found = compute_speed_figures(table)
    timed = [f for f in found if f.status == "ok"]
    reference = dict(zip(*(table[name].to_pylist() for name in ("solver", "citation")), strict=True))
    lines: dict[tuple[str, str], list[SpeedFigures]] = {}
    for f in sorted(timed, key=lambda f: f.vertices):
        lines.setdefault((f.scene, f.label), []).append(f)
    marks = assign_label_styles((f.label, f.solver) for f in timed)
    dated = zip(*(table[name].to_pylist() for name in ("started_at", "source_fingerprint")), strict=True)
    newest = max(((started or "", code or "") for started, code in dated), default=("", ""))[1]
    hover = [["vertices", "vertices"], ["step", "ms a step"], ["global_", "ms a global step"]]
    return {
        "title": "Speed and its limits",
        "note": "Medians over the rounds. A limit is what the machine reads or computes at most, measured beside the "
        "solvers; the yardstick is the same method in C++ with Eigen.",
        "filters": ["scene"],
        "x": [axis_choice("vertices", "vertices")],
        "y": list(_AXIS_CHOICES.values()),
        "hover": [*hover, ["binding_limit", "limit that binds"], ["roofline_fraction", "share of that limit reached"]],
        "items": [_build_item(scene, label, some, newest) for (scene, label), some in lines.items()],
        "styles": {label: plotly_style(mark) for label, mark in marks.items()},
        "citations": format_references((f.label, reference.get(f.solver)) for f in timed),
        "command": "springbench roofline CONFIG --rerun",
    }, describe_speed(found)


def _build_item(scene: str, label: str, some: list[SpeedFigures], newest_fingerprint: str) -> dict[str, Any]:
    names = ("vertices", *(name for name in _AXIS_CHOICES if name != "speedup"))
    columns = {name: [round_number(getattr(f, name)) for f in some] for name in names}
    columns["speedup"] = [round_number(f.speedup and f.speedup.estimate) for f in some]
    ends = {f"speedup_{end}": [round_number(getattr(f.speedup, end, None)) for f in some] for end in ("low", "high")}
    threads = f"{some[0].threads} thread{'s' if some[0].threads > 1 else ''}"
    item = {"label": label, "description": f"{scene}, {threads}", "scene": scene, "panel": scene, "parameters": "{}"}
    return (
        item
        | columns
        | ends
        | {
            "binding_limit": [f.binding_limit for f in some],
            "stale": [f.source_fingerprint != newest_fingerprint for f in some],
        }
    )
