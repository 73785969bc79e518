"""Charts of ablations: cost and influence of each effect, and its overhead per iteration."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

import numpy as np
from springbench.harness.report.ablation_summary import ResultRow, largest_known_error, select_kind
from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CellOutcome,
    MapCell,
    MarkedValue,
    ShadedBand,
    describe_stale_cells,
)
from springbench.harness.report.number_format import format_quantity
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle, assign_label_styles, build_indexed_style
from springbench.harness.report.provenance_words import describe_provenance, is_stale
from springbench.harness.report.varying_settings import find_varying_by_solver

_ERROR_LABELS = {"solver": "error of the solver", "time-step": "error of the time step"}
_MIN_DISPLACEMENT = 1e-6
"""Displacements below this value [mean rest lengths] are drawn at it."""

_INDISTINGUISHABLE = CellOutcome("not distinguishable from 1", "#efece6")
_OVERHEAD_CLASSES = (
    (1.0, CellOutcome("below 1", "#a8d5b9")),
    (1.1, CellOutcome("to 1.1", "#dfeaf3")),
    (1.5, CellOutcome("1.1 to 1.5", "#aacbe4")),
    (2.0, CellOutcome("1.5 to 2", "#64a2d6")),
    (3.0, CellOutcome("2 to 3", "#2f78b5")),
    (np.inf, CellOutcome("above 3", "#0f3f70")),
)
"""Upper limits of the overhead classes, and the classes."""
_UNSUPPORTED_COLOUR, _FAILED_COLOUR = "#bcb8b0", "#dd8f88"
"""Colours of what a solver does not support, and of other cases without an overhead."""
_OVERHEAD_NOTE = (
    "CPU time of an iteration with the effect over one without, the median over rounds. An overhead whose 95 % "
    "interval contains 1 is not distinguishable from none."
)
_ALL_EFFECTS = "all"
"""Name of the overhead of all effects together in the rows."""


def build_effect_chart(
    ablations: Mapping[str, Sequence[ResultRow]], newest_fingerprint: str | None = None
) -> ChartDescription:
    """Build the chart of the cost of each effect and the displacement without it.

    It has a frame for each ablation.

    Args:
        ablations: rows of each ablation, by the name of its file.
        newest_fingerprint: code that others are compared with; None for the current version.
    """
    found = {
        name: rows
        for name, rows in ablations.items()
        if any(row["status"] == "ok" for row in select_kind(rows, "full-scene"))
        and any(row["status"] == "ok" for row in select_kind(rows, "ablated"))
    }
    rows = [row for some in found.values() for row in some]
    return ChartDescription(
        title="What each effect costs and changes",
        note="CPU time of a step that is saved where the effect is left out, with its 95 % interval, and how far that "
        "moves some vertex. An effect is called for where it moves more than the scene is wrong by anyway.",
        frames=[_build_effect_frame(name, some, newest_fingerprint) for name, some in found.items()],
        x=(
            ChartAxis("added_time_share", AxisScale("cost [% of a step, with the 95 % interval]", "linear", "percent")),
        ),
        y=(
            ChartAxis(
                "displacement_max",
                AxisScale("largest displacement without it [mean rest lengths]", "log", "power"),
            ),
        ),
        hover=(("added_time_share", "share of a step"), ("displacement_max", "mean rest lengths moved")),
        machine_words=describe_provenance(rows),
        command="springbench ablate CONFIG --rerun",
    )


def _build_effect_frame(name: str, rows: Sequence[ResultRow], newest_fingerprint: str | None) -> ChartFrame:
    (whole,) = select_kind(rows, "full-scene")
    points = [row for row in select_kind(rows, "ablated") if row["status"] == "ok"]
    stale = is_stale(whole["source_fingerprint"], newest_fingerprint)
    known = [row for row in select_kind(rows, "error") if row["status"] == "ok"]
    error, whose = largest_known_error(rows)
    gone = [row["name"] for row in select_kind(rows, "ablated") if row["status"] != "ok"]
    missing = [row["name"] for row in select_kind(rows, "suggestion")]
    dashed = [f"{_ERROR_LABELS[row['name']]}, {row['displacement_max']:.2g}" for row in known]
    facts = f"{whole['solver']}, {format_quantity(1e3 * whole['seconds'])} CPU ms a step; {whole['frames']} steps of "
    notes = [f"{facts}{format_quantity(1e3 * whole['time_step'])} ms, {whole['rounds']} rounds."]
    notes += [f"Shaded: less than {whose}, so not called for."] if whose else []
    notes += [f"Dashed: {'; '.join(dashed)}."] if dashed else []
    notes += [f"Impossible without {', '.join(gone)}."] if gone else []
    notes += [f"Not listed, but called for by the motion: {', '.join(missing)}."] if missing else []
    return ChartFrame(
        group=(whole["scene"], str(whole["size"])),
        name=(name,),
        subject=f"{whole['scene']}, {whole['vertices']} vertices",
        title="",
        series=[_build_effect_series(k, row, whole, stale=stale) for k, row in enumerate(points)],
        bands={"displacement_max": [ShadedBand(0.0, error, "")]} if np.isfinite(error) else {},
        lines={"displacement_max": [MarkedValue(max(row["displacement_max"], _MIN_DISPLACEMENT), "") for row in known]},
        notes=[*notes, *([STALE_NOTE] if stale else [])],
    )


def _build_effect_series(number: int, row: ResultRow, whole: ResultRow, *, stale: bool) -> ChartSeries:
    columns = {"added_time_share": "added_seconds"}
    columns |= {f"added_time_share_{end}": f"added_seconds_{end}" for end in ("low", "high")}
    return ChartSeries(
        label=row["name"],
        style=build_indexed_style(number),
        columns={
            **{name: [row[column] / whole["seconds"]] for name, column in columns.items()},
            "displacement_max": [max(row["displacement_max"], _MIN_DISPLACEMENT)],
        },
        description=f"without it; {whole['solver']}, {whole['frames']} frames",
        stale=stale,
        is_connected=False,
        labels_points=True,
    )


def build_overhead_chart(rows: Sequence[ResultRow], newest_fingerprint: str | None = None) -> ChartDescription:
    """Build the chart of overheads per iteration.

    It has a map of all solvers for each scene and size, and a frame for each solver.

    Args:
        rows: rows of ablations.
        newest_fingerprint: code that others are compared with; None for the current version.
    """
    found = _label_rows(select_kind(rows, "overhead"))
    styles = assign_label_styles((row["label"], row["solver"]) for row in found)
    frames: list[ChartFrame] = []
    maps: list[CellMap] = []
    for scene in dict.fromkeys((row["scene"], row["size"]) for row in found):
        here = [row for row in found if (row["scene"], row["size"]) == scene]
        maps.append(_build_overhead_map(here, newest_fingerprint))
        for label in dict.fromkeys(row["label"] for row in here):
            mine = [row for row in here if row["label"] == label and row["status"] == "ok"]
            frames += [_build_overhead_frame(mine, styles[label], newest_fingerprint)] if mine else []
    return ChartDescription(
        title="What each effect adds to an iteration",
        note=_OVERHEAD_NOTE,
        frames=frames,
        x=(ChartAxis("overhead_ratio", AxisScale("an iteration with the effect over one without", "log", "plain")),),
        y=(ChartAxis("effect", AxisScale("", "names")),),
        subject_key="solver",
        maps=maps,
        hover=(
            ("overhead_ratio", "times as long"),
            ("overhead_ratio_bound", "least that reading its numbers allows"),
        ),
        machine_words=describe_provenance(found),
        citations={row["label"]: row["citation"] for row in found if row["citation"]},
        command="springbench ablate CONFIG --all-solvers --rerun",
    )


def _label_rows(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Add a `label` to rows: the solver with its varying parameters."""
    parameters: list[dict[str, Any]] = [json.loads(row["parameters"] or "{}") for row in rows]
    varying = find_varying_by_solver((row["solver"], own) for row, own in zip(rows, parameters, strict=True))
    labels = [
        ", ".join([row["solver"], *(f"{key} {value}" for key, value in own.items() if key in varying[row["solver"]])])
        for row, own in zip(rows, parameters, strict=True)
    ]
    return [{**row, "label": label} for row, label in zip(rows, labels, strict=True)]


def _build_overhead_map(here: Sequence[ResultRow], newest_fingerprint: str | None) -> CellMap:
    """Build the overhead map with effects in rows and solvers in columns.

    The most expensive effect is first, and all effects together are last.
    """
    known = [row for row in here if row["status"] == "ok"]
    paid = {row["name"]: [r["overhead_ratio"] for r in known if r["name"] == row["name"]] for row in here}
    order = sorted(paid, key=lambda name: (name == _ALL_EFFECTS, -median(paid[name] or [0.0])))
    cells = [_build_cell(row, newest_fingerprint) for row in sorted(here, key=lambda row: order.index(row["name"]))]
    refused = dict.fromkeys(row["status"] for row in here if row["status"] != "ok")
    return CellMap(
        group=_name_group(here[0]),
        name=("map",),
        subject=f"{here[0]['scene']}, size {here[0]['size']}",
        title="",
        cells=cells,
        outcomes=[_INDISTINGUISHABLE, *(one for _, one in _OVERHEAD_CLASSES), *map(_classify_refusal, refused)],
        notes=[_OVERHEAD_NOTE, *describe_stale_cells(cells)],
        machine_words=describe_provenance(here),
    )


def _name_group(row: ResultRow) -> tuple[str, ...]:
    return row["scene"], str(row["size"])


def _build_cell(row: ResultRow, newest_fingerprint: str | None) -> MapCell:
    if row["status"] != "ok":
        outcome, words, reason = _classify_refusal(row["status"]), "–", row["reason"] or ""
    else:
        ratio, low, high = (row[f"overhead_ratio{end}"] for end in ("", "_low", "_high"))
        class_ = next(one for limit, one in _OVERHEAD_CLASSES if ratio <= limit)
        outcome = _INDISTINGUISHABLE if low <= 1.0 <= high else class_
        words = f"{ratio:.2f}" if ratio < 9.995 else f"{ratio:.0f}"
        reason = f"{ratio:.3g} times as long, 95 % interval {low:.3g} to {high:.3g}"
    return MapCell(
        row=row["name"],
        column=row["label"],
        outcome=outcome.label,
        color=outcome.color,
        value_text=words,
        is_stale=is_stale(row["source_fingerprint"], newest_fingerprint),
        reason=reason,
    )


def _classify_refusal(status: str) -> CellOutcome:
    """Return the class of a status other than "ok"."""
    return CellOutcome(status, _UNSUPPORTED_COLOUR if status == "unsupported" else _FAILED_COLOUR)


def _build_overhead_frame(rows: Sequence[ResultRow], style: SeriesStyle, newest_fingerprint: str | None) -> ChartFrame:
    """Build the frame of a solver's overheads with their intervals, the most expensive effect first."""
    mine = sorted(rows, key=lambda row: -row["overhead_ratio"])
    label, stale = mine[0]["label"], [is_stale(row["source_fingerprint"], newest_fingerprint) for row in mine]
    names = ("overhead_ratio", "overhead_ratio_low", "overhead_ratio_high", "overhead_ratio_bound")
    columns = {name: [row[name] for row in mine] for name in names}
    return ChartFrame(
        group=_name_group(mine[0]),
        name=(label,),
        subject=f"{label} on {mine[0]['scene']}, size {mine[0]['size']}",
        title="",
        series=[
            ChartSeries(
                label,
                style,
                {**columns, "effect": np.arange(len(mine), dtype=float)},
                description=f"{mine[0]['scene']}, an iteration",
                stale=stale,
                is_connected=False,
                links={"parameters": mine[0]["parameters"] or "{}"},
            )
        ],
        notes=[STALE_NOTE] if any(stale) else [],
        place_names={"effect": tuple(row["name"] for row in mine)},
    )
