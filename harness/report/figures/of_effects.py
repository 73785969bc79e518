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

from harness.base import machine, shelf
from harness.base.errors import InputError, Mistake
from harness.report import ablation
from harness.report.ablation import Row
from harness.report.figures.entry import Entry, ready
from harness.report.figures.panel import Band, Cell, CellMap, Line, Panel, Plot, Scale, Series, dotted
from harness.report.origin import measured_on
from harness.report.style import OLDER, Mark, looks, numbered

_ERRORS = {"solver": "error of the solver", "time-step": "error of the time step"}

_NOTHING = ("cannot be told from 1", "#efece6")
_CLASSES = (
    (1.0, "below 1", "#a8d5b9"),
    (1.1, "to 1.1", "#dfeaf3"),
    (1.5, "1.1 to 1.5", "#aacbe4"),
    (2.0, "1.5 to 2", "#64a2d6"),
    (3.0, "2 to 3", "#2f78b5"),
    (np.inf, "above 3", "#0f3f70"),
)
"""Upper limits of the overhead classes, their labels and colours."""
_REFUSED, _BROKEN = "#bcb8b0", "#dd8f88"
"""Colours of what a solver does not support, and of other cases without an overhead."""
_READ = (
    "CPU time of an iteration with the effect over one without, the median over rounds; of those whose interval of "
    "95 % holds 1 nothing can be told."
)
_ALL = "all"
"""Name of the overhead of all effects together in the rows."""


def _ablations(folder: Path, kind: str) -> Iterator[tuple[str, Sequence[Row]]]:
    """Yield the rows of each ablation with rows of a kind, by file name.

    Raises:
        InputError: if there are none.
    """
    found = [(path.stem, ablation.read(path)) for path in shelf.units(folder / "ablation")]
    found = [(stem, table) for stem, table in found if ablation.of_kind(table, kind)]
    if not found:
        command = "springbench ablate SCENE" + (" --all-solvers" if kind == "price" else "")
        raise InputError(Mistake(f"holds nothing of that kind; wanted the rows of `{command}`", folder))
    yield from found


def effects(folder: Path) -> list[Entry]:
    """Build panels of the cost of each effect and the changes without it."""
    plots: list[Plot] = []
    for stem, table in _ablations(folder, "without"):
        (whole,) = ablation.of_kind(table, "whole")
        points = [row for row in ablation.of_kind(table, "without") if row["status"] == "ok"]
        if whole["status"] != "ok" or not points:
            continue
        other = _other(whole)
        series = [_effect(k, row, whole["seconds"], older=other) for k, row in enumerate(points)]
        known = [row for row in ablation.of_kind(table, "error") if row["status"] == "ok"]
        error, whose = ablation.known_error(table)
        gone = [row["name"] for row in ablation.of_kind(table, "without") if row["status"] != "ok"]
        below = [f"Shaded: less than {whose}, so not called for."] if whose else []
        dashed = [f"{_ERRORS[row['name']]}, {row['largest']:.2g}" for row in known]
        below += [f"Dashed: {'; '.join(dashed)}."] if dashed else []
        below += [f"Impossible without {', '.join(gone)}."] if gone else []
        plots.append(
            Plot(
                *((whole["scene"], str(whole["size"])), (stem,), f"{whole['scene']}, {whole['vertices']} vertices", ""),
                Scale("cost [% of a step, with the 95 % interval]", "linear", "percent"),
                Scale("largest displacement without it [mean rest lengths]", "log", "power"),
                series,
                bands=[Band(0.0, error, "")] if np.isfinite(error) else [],
                lines=[Line(max(row["largest"], 1e-6), "") for row in known],
                notes=[*below, *([OLDER] if other else [])],
                machine=measured_on(table),
            )
        )
    return ready(plots)


def _effect(k: int, row: Row, whole: float, *, older: bool) -> Series:
    x, low, high = (np.array([row[key] / whole]) for key in ("cost", "cost_low", "cost_high"))
    y = np.array([max(row["largest"], 1e-6)])
    return Series(row["name"], numbered(k), x, y, low, high, True, np.array([older]), joined=False, named=True)


def prices(folder: Path) -> list[Entry]:
    """Build panels of the overhead per iteration.

    These are a map of all solvers, and intervals for each solver.
    """
    found = _labelled([row for _, table in _ablations(folder, "price") for row in ablation.of_kind(table, "price")])
    marked = looks((row["label"], row["solver"]) for row in found)
    panels: list[Panel] = []
    for scene in dict.fromkeys((row["scene"], row["size"]) for row in found):
        here = [row for row in found if (row["scene"], row["size"]) == scene]
        of, subject = (scene[0], str(scene[1])), f"{scene[0]}, size {scene[1]}"
        panels.append(_map(of, subject, here))
        for label in dict.fromkeys(row["label"] for row in here):
            mine = [row for row in here if row["label"] == label and row["status"] == "ok"]
            panels += [_intervals(of, subject, marked[label], mine)] if mine else []
    return ready(panels)


def _labelled(rows: Sequence[Row]) -> list[Row]:
    """Add a `label` to rows: the solver, with its parameters if they vary."""
    settings: dict[str, set[str]] = {row["solver"]: set() for row in rows}
    for row in rows:
        settings[row["solver"]].add(row["parameters"] or "{}")
    labels: list[str] = []
    for row in rows:
        stated: dict[str, Any] = json.loads(row["parameters"] or "{}") if len(settings[row["solver"]]) > 1 else {}
        labels.append(", ".join([row["solver"], *(f"{name} {value}" for name, value in stated.items())]))
    return [{**row, "label": label} for row, label in zip(rows, labels, strict=True)]


def _other(row: Row) -> bool:
    return row["code"] not in (None, machine.code_hash())


def _map(of: tuple[str, ...], subject: str, here: Sequence[Row]) -> CellMap:
    """Build the overhead map with effects in rows and solvers in columns.

    The most expensive effect comes first, and all effects together come last.
    """
    known = [row for row in here if row["status"] == "ok"]
    paid = {row["name"]: [r["price"] for r in known if r["name"] == row["name"]] for row in here}
    order = sorted(paid, key=lambda name: (name == _ALL, -median(paid[name] or [0.0])))
    cells = [_cell(row) for row in sorted(here, key=lambda row: order.index(row["name"]))]
    refused = dict.fromkeys(row["status"] for row in here if row["status"] != "ok")
    classes = [
        _NOTHING,
        *((words, color) for _, words, color in _CLASSES),
        *((words, _unpriced(words)) for words in refused),
    ]
    return CellMap(of, ("map",), subject, "", cells, classes, [_READ, *dotted(cells)], measured_on(here))


def _cell(row: Row) -> Cell:
    at = row["name"], row["label"]
    if row["status"] != "ok":
        return Cell(*at, row["status"], _unpriced(row["status"]), "–", _other(row))
    price = row["price"]
    class_ = next((words, color) for most, words, color in _CLASSES if price <= most)
    told = _NOTHING if row["price_low"] <= 1.0 <= row["price_high"] else class_
    return Cell(*at, *told, f"{price:.2f}" if price < 9.995 else f"{price:.0f}", _other(row))


def _unpriced(status: str) -> str:
    return _REFUSED if status == "unsupported" else _BROKEN


def _intervals(of: tuple[str, ...], subject: str, look: Mark, rows: Sequence[Row]) -> Plot:
    """Build a plot of a solver's overheads with their intervals, the most expensive effect first."""
    mine, label = sorted(rows, key=lambda row: -row["price"]), rows[0]["label"]
    older = np.array([_other(row) for row in mine])
    x, low, high = (np.array([row[key] for row in mine], float) for key in ("price", "price_low", "price_high"))
    y, names = np.arange(len(mine), dtype=float), tuple(row["name"] for row in mine)
    return Plot(
        *(of, (label,), subject, label),
        Scale("an iteration with the effect over one without", "log", "plain"),
        Scale("", "names", names=names),
        [Series(label, look, x, y, low, high, True, older, joined=False)],
        notes=[OLDER] if older.any() else [],
        machine=measured_on(mine),
    )
