"""Panels of ablations: cost, influence and overhead of effects.

The overhead per iteration is shown for every solver.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import machine_info
from springbench.harness.report import ablation_summary
from springbench.harness.report.ablation_summary import ResultRow
from springbench.harness.report.charts.figure_panels import (
    AxisScale,
    CellMap,
    CurvePlot,
    CurveSeries,
    FigurePanel,
    MapCell,
    MarkedValue,
    ShadedBand,
    describe_stale_cells,
)
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle, assign_label_styles, indexed_style
from springbench.harness.report.provenance_words import describe_provenance
from springbench.harness.results import row_store

_ERROR_LABELS = {"solver": "error of the solver", "time-step": "error of the time step"}

_INDISTINGUISHABLE = ("cannot be told from 1", "#efece6")
_OVERHEAD_CLASSES = (
    (1.0, "below 1", "#a8d5b9"),
    (1.1, "to 1.1", "#dfeaf3"),
    (1.5, "1.1 to 1.5", "#aacbe4"),
    (2.0, "1.5 to 2", "#64a2d6"),
    (3.0, "2 to 3", "#2f78b5"),
    (np.inf, "above 3", "#0f3f70"),
)
"""Upper limits of the overhead classes, their labels and colours."""
_UNSUPPORTED_COLOUR, _FAILED_COLOUR = "#bcb8b0", "#dd8f88"
"""Colours of what a solver does not support, and of other cases without an overhead."""
_OVERHEAD_NOTE = (
    "CPU time of an iteration with the effect over one without, the median over rounds; of those whose interval of "
    "95 % holds 1 nothing can be told."
)
_ALL_EFFECTS = "all"
"""Name of the overhead of all effects together in the rows."""


def _read_ablations(folder: Path, kind: str) -> Iterator[tuple[str, Sequence[ResultRow]]]:
    """Yield the rows of each ablation with rows of a kind, by file name.

    Raises:
        InputError: if there are none.
    """
    found = [(path.stem, ablation_summary.read_ablation(path)) for path in row_store.list_units(folder / "ablation")]
    found = [(stem, table) for stem, table in found if ablation_summary.select_kind(table, kind)]
    if not found:
        command = "springbench ablate SCENE" + (" --all-solvers" if kind == "overhead" else "")
        raise InputError(InputMistake(f"holds nothing of that kind; wanted the rows of `{command}`", folder))
    yield from found


def effect_cost_panels(folder: Path) -> list[PanelEntry]:
    """Build panels of the cost of each effect and the changes without it."""
    plots: list[CurvePlot] = []
    for stem, table in _read_ablations(folder, "ablated"):
        (whole,) = ablation_summary.select_kind(table, "full-scene")
        points = [row for row in ablation_summary.select_kind(table, "ablated") if row["status"] == "ok"]
        if whole["status"] != "ok" or not points:
            continue
        other = _is_stale(whole)
        series = [_build_effect_series(k, row, whole["seconds"], is_stale=other) for k, row in enumerate(points)]
        known = [row for row in ablation_summary.select_kind(table, "error") if row["status"] == "ok"]
        error, whose = ablation_summary.largest_known_error(table)
        gone = [row["name"] for row in ablation_summary.select_kind(table, "ablated") if row["status"] != "ok"]
        below = [f"Shaded: less than {whose}, so not called for."] if whose else []
        dashed = [f"{_ERROR_LABELS[row['name']]}, {row['displacement_max']:.2g}" for row in known]
        below += [f"Dashed: {'; '.join(dashed)}."] if dashed else []
        below += [f"Impossible without {', '.join(gone)}."] if gone else []
        plots.append(
            CurvePlot(
                *((whole["scene"], str(whole["size"])), (stem,), f"{whole['scene']}, {whole['vertices']} vertices", ""),
                AxisScale("cost [% of a step, with the 95 % interval]", "linear", "percent"),
                AxisScale("largest displacement without it [mean rest lengths]", "log", "power"),
                series,
                bands=[ShadedBand(0.0, error, "")] if np.isfinite(error) else [],
                lines=[MarkedValue(max(row["displacement_max"], 1e-6), "") for row in known],
                notes=[*below, *([STALE_NOTE] if other else [])],
                machine_words=describe_provenance(table),
            )
        )
    return entries_from_panels(plots)


def _build_effect_series(k: int, row: ResultRow, full_run: float, *, is_stale: bool) -> CurveSeries:
    x, low, high = (
        np.array([row[key] / full_run]) for key in ("added_seconds", "added_seconds_low", "added_seconds_high")
    )
    y = np.array([max(row["displacement_max"], 1e-6)])
    return CurveSeries(
        row["name"],
        indexed_style(k),
        x,
        y,
        low,
        high,
        True,
        np.array([is_stale]),
        is_connected=False,
        labels_points=True,
    )


def overhead_panels(folder: Path) -> list[PanelEntry]:
    """Build panels of the overhead per iteration.

    These are a map of all solvers, and intervals for each solver.
    """
    found = _label_rows(
        [
            row
            for _, table in _read_ablations(folder, "overhead")
            for row in ablation_summary.select_kind(table, "overhead")
        ]
    )
    marked = assign_label_styles((row["label"], row["solver"]) for row in found)
    panels: list[FigurePanel] = []
    for scene in dict.fromkeys((row["scene"], row["size"]) for row in found):
        here = [row for row in found if (row["scene"], row["size"]) == scene]
        of, subject = (scene[0], str(scene[1])), f"{scene[0]}, size {scene[1]}"
        panels.append(_build_overhead_map(of, subject, here))
        for label in dict.fromkeys(row["label"] for row in here):
            mine = [row for row in here if row["label"] == label and row["status"] == "ok"]
            panels += [_build_interval_plot(of, subject, marked[label], mine)] if mine else []
    return entries_from_panels(panels)


def _label_rows(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Add a `label` to rows: the solver, with its parameters if they vary."""
    settings: dict[str, set[str]] = {row["solver"]: set() for row in rows}
    for row in rows:
        settings[row["solver"]].add(row["parameters"] or "{}")
    labels: list[str] = []
    for row in rows:
        stated: dict[str, Any] = json.loads(row["parameters"] or "{}") if len(settings[row["solver"]]) > 1 else {}
        labels.append(", ".join([row["solver"], *(f"{name} {value}" for name, value in stated.items())]))
    return [{**row, "label": label} for row, label in zip(rows, labels, strict=True)]


def _is_stale(row: ResultRow) -> bool:
    return row["source_fingerprint"] not in (None, machine_info.hash_sources())


def _build_overhead_map(group: tuple[str, ...], subject: str, here: Sequence[ResultRow]) -> CellMap:
    """Build the overhead map with effects in rows and solvers in columns.

    The most expensive effect comes first, and all effects together come last.
    """
    known = [row for row in here if row["status"] == "ok"]
    paid = {row["name"]: [r["overhead_ratio"] for r in known if r["name"] == row["name"]] for row in here}
    order = sorted(paid, key=lambda name: (name == _ALL_EFFECTS, -median(paid[name] or [0.0])))
    cells = [_build_cell(row) for row in sorted(here, key=lambda row: order.index(row["name"]))]
    refused = dict.fromkeys(row["status"] for row in here if row["status"] != "ok")
    classes = [
        _INDISTINGUISHABLE,
        *((words, color) for _, words, color in _OVERHEAD_CLASSES),
        *((words, _describe_missing_overhead(words)) for words in refused),
    ]
    return CellMap(
        group,
        ("map",),
        subject,
        "",
        cells,
        classes,
        [_OVERHEAD_NOTE, *describe_stale_cells(cells)],
        describe_provenance(here),
    )


def _build_cell(row: ResultRow) -> MapCell:
    at = row["name"], row["label"]
    if row["status"] != "ok":
        return MapCell(*at, row["status"], _describe_missing_overhead(row["status"]), "–", _is_stale(row))
    price = row["overhead_ratio"]
    class_ = next((words, color) for most, words, color in _OVERHEAD_CLASSES if price <= most)
    label = _INDISTINGUISHABLE if row["overhead_ratio_low"] <= 1.0 <= row["overhead_ratio_high"] else class_
    return MapCell(*at, *label, f"{price:.2f}" if price < 9.995 else f"{price:.0f}", _is_stale(row))


def _describe_missing_overhead(status: str) -> str:
    return _UNSUPPORTED_COLOUR if status == "unsupported" else _FAILED_COLOUR


def _build_interval_plot(
    group: tuple[str, ...], subject: str, style: SeriesStyle, rows: Sequence[ResultRow]
) -> CurvePlot:
    """Build a plot of a solver's overheads with their intervals, the most expensive effect first."""
    mine, label = sorted(rows, key=lambda row: -row["overhead_ratio"]), rows[0]["label"]
    older = np.array([_is_stale(row) for row in mine])
    x, low, high = (
        np.array([row[key] for row in mine], float)
        for key in ("overhead_ratio", "overhead_ratio_low", "overhead_ratio_high")
    )
    y, names = np.arange(len(mine), dtype=float), tuple(row["name"] for row in mine)
    return CurvePlot(
        *(group, (label,), subject, label),
        AxisScale("an iteration with the effect over one without", "log", "plain"),
        AxisScale("", "names", place_names=names),
        [CurveSeries(label, style, x, y, low, high, True, older, is_connected=False)],
        notes=[STALE_NOTE] if older.any() else [],
        machine_words=describe_provenance(mine),
    )
