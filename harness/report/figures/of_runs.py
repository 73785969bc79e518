"""The panels of sweeps, of speed reports and of ablations: times against size, and what effects cost and change."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from harness.base import machine, rows, shelf
from harness.base.errors import InputError, Mistake
from harness.report import ablation
from harness.report.figures.entry import Entry, ready
from harness.report.figures.panel import Band, Line, Plot, Scale, Series
from harness.report.origin import NEEDED, measured_on
from harness.report.speed import figures as speed_figures
from harness.report.speed.pictures import PICTURES
from harness.report.style import OLDER, Mark, looks, numbered
from harness.report.timing_table import RunTimes, labels, runs

Older = Callable[[pa.Table], Collection[str]]
"""The ids of those runs in rows that other code than today's measured."""

_VERTICES = Scale("vertices", "sizes", "plain")
_NEEDED = ("run_id", "scene", "size", "solver", "phase", "status")
_ERRORS = {"solver": "error of the solver", "time-step": "error of the time step"}


def sweep_rows(folder: Path) -> pa.Table:
    """The rows of a sweep. Raises InputError where there are none, or where they are a speed report's."""
    units = shelf.units(folder / "rows")
    if not units:
        raise InputError(Mistake("holds no rows of runs; wanted those of `springbench run CONFIG`", folder))
    table = rows.read(units, needed=_NEEDED)
    if speed_figures.MACHINE in table["solver"].unique().to_pylist():
        raise InputError(Mistake("holds rows of `springbench speed`; ask for the kind speed", folder))
    return table


def timing(folder: Path, older: Older) -> list[Entry]:
    """Times of a step and of preparing, of each scene."""
    table = sweep_rows(folder)
    found, other = runs(table), older(table)
    names = labels(found)
    marked = looks((names[run.run_id], run.solver) for run in found)
    told = measured_on(table.select(NEEDED).to_pylist())
    plots: list[Plot] = []
    for scene in dict.fromkeys(run.scene for run in found):
        here = [run for run in found if run.scene == scene]
        ok = [run for run in here if run.status == "ok" and run.vertices]
        failed = [f"{names[r.run_id]} {r.size or ''}: {r.status}" for r in here if r.status != "ok"]
        notes = [f"Failed: {'; '.join(failed)}."] if failed else []
        for key, title, fields in _TIMED:
            timed = [run for run in ok if getattr(run, fields[0]) is not None]
            if timed:
                series, scales = _by_size(timed, names, marked, fields, other)
                hollow = [OLDER] if any(run.run_id in other for run in timed) else []
                plots.append(
                    Plot(
                        *((scene,), (key,), _sized(scene, timed), title, *scales, series),
                        notes=[*(_SPREAD[len(fields)]), *hollow, *notes],
                        machine=told,
                    )
                )
    return ready(plots)


_TIMED = (
    ("step", "a step", ("step", "lower", "upper")),
    ("prepare", "preparing, warm", ("warm",)),
    ("cold", "preparing, cold", ("cold",)),
)
_SPREAD = {3: ["Median and quartiles of all steps."], 1: []}


def _sized(scene: str, timed: Sequence[RunTimes]) -> str:
    sizes = {run.vertices for run in timed}
    return f"{scene}, {sizes.pop()} vertices" if len(sizes) == 1 else scene


def _by_size(
    timed: Sequence[RunTimes],
    names: dict[str, str],
    marked: dict[str, Mark],
    fields: Sequence[str],
    other: Collection[str],
) -> tuple[list[Series], tuple[Scale, Scale]]:
    """Curves against vertices; with one size alone a row of its own for each solver, the fastest first."""
    each: dict[str, list[RunTimes]] = {}
    for run in sorted(timed, key=lambda run: run.vertices or 0):
        each.setdefault(names[run.run_id], []).append(run)
    lone = len({run.vertices for run in timed}) == 1
    if lone:
        each = dict(sorted(each.items(), key=lambda pair: getattr(pair[1][0], fields[0])))
    series: list[Series] = []
    for k, (label, members) in enumerate(each.items()):
        n = np.full(len(members), float(k)) if lone else np.array([run.vertices for run in members], float)
        values = [1e-3 * np.array([getattr(run, field) for run in members], float) for field in fields]
        low, high = values[1:] or (None, None)
        hollow = np.array([run.run_id in other for run in members])
        x, y = (values[0], n) if lone else (n, values[0])
        series.append(Series(label, marked[label], x, y, low, high, lone, hollow, joined=not lone))
    time = Scale("wall time", "log", "time")
    return series, (time, Scale("", "names", names=tuple(each))) if lone else (_VERTICES, time)


def speed(folder: Path) -> list[Entry]:
    """Times of each phase against size, and the part of the binding limit that is reached."""
    units = shelf.units(folder / "rows")
    table = rows.read(units, needed=_NEEDED) if units else None
    if table is None or speed_figures.MACHINE not in table["solver"].unique().to_pylist():
        raise InputError(Mistake("holds no speed report; wanted the rows of `springbench speed CONFIG`", folder))
    found = [one for one in speed_figures.figures(table) if one.status == "ok"]
    told = measured_on(table.select(NEEDED).to_pylist())
    marked = looks((one.label, one.solver) for one in found)
    plots: list[Plot] = []
    for scene in dict.fromkeys(one.scene for one in found):
        for picture in PICTURES:
            unit = 1.0 if picture.share else 1e-3
            points = [(f, unit * v) for f in found if f.scene == scene and (v := picture.value(f)) is not None]
            if points:
                series, scales = _lines(points, marked)
                shown = _SHARE if picture.share else _TIME
                x, y = (shown if scale is _VALUE else scale for scale in scales)
                title = picture.title.replace("Milliseconds ", "")
                hollow = [OLDER] if any(one.older for one, _ in points) else []
                plots.append(Plot((scene,), (picture.stem,), scene, title, x, y, series, notes=hollow, machine=told))
    return ready(plots)


_VALUE, _SHARE, _TIME = Scale(""), Scale("part of the limit", "linear", "percent"), Scale("time", "log", "time")


def _lines(
    points: Sequence[tuple[speed_figures.Figures, float]], marked: dict[str, Mark]
) -> tuple[list[Series], tuple[Scale, ...]]:
    each: dict[str, list[tuple[float, float, bool]]] = {}
    for one, value in sorted(points, key=lambda point: point[0].vertices):
        each.setdefault(one.label, []).append((float(one.vertices), value, one.older))
    lone = len({one.vertices for one, _ in points}) == 1
    if lone:
        each = dict(sorted(each.items(), key=lambda pair: pair[1][0][1]))
    series: list[Series] = []
    for k, (label, members) in enumerate(each.items()):
        n, values, older = (np.array(side) for side in zip(*members, strict=True))
        x, y = (values, np.full(len(n), float(k))) if lone else (n, values)
        series.append(Series(label, marked[label], x, y, older=older, joined=not lone))
    return series, (_VALUE, Scale("", "names", names=tuple(each))) if lone else (_VERTICES, _VALUE)


def _ablations(folder: Path, kind: str) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """The rows of each ablation that holds rows of a kind, by the name of its file. Raises InputError without any."""
    found = [(path.stem, ablation.read(path)) for path in shelf.units(folder / "ablation")]
    found = [(stem, table) for stem, table in found if ablation.of_kind(table, kind)]
    if not found:
        command = "springbench ablate SCENE" + (" --all-solvers" if kind == "price" else "")
        raise InputError(Mistake(f"holds nothing of that kind; wanted the rows of `{command}`", folder))
    yield from found


def effects(folder: Path) -> list[Entry]:
    """What each effect of a scene costs, and what leaving it out changes."""
    plots: list[Plot] = []
    for stem, table in _ablations(folder, "without"):
        (whole,) = ablation.of_kind(table, "whole")
        points = [row for row in ablation.of_kind(table, "without") if row["status"] == "ok"]
        if whole["status"] != "ok" or not points:
            continue
        other = whole["code"] not in (None, machine.code_hash())
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


def _effect(k: int, row: Any, whole: float, *, older: bool) -> Series:
    x, low, high = (np.array([row[key] / whole]) for key in ("cost", "cost_low", "cost_high"))
    y = np.array([max(row["largest"], 1e-6)])
    return Series(row["name"], numbered(k), x, y, low, high, True, np.array([older]), joined=False, named=True)


def prices(folder: Path) -> list[Entry]:
    """What each effect adds to an iteration of each solver."""
    tables = [table for _, table in _ablations(folder, "price")]
    found = [row for table in tables for row in ablation.of_kind(table, "price") if row["status"] == "ok"]
    marked = looks((row["solver"], row["solver"]) for row in found)
    plots: list[Plot] = []
    for scene in dict.fromkeys((row["scene"], row["size"]) for row in found):
        here = [row for row in found if (row["scene"], row["size"]) == scene]
        for solver in dict.fromkeys(row["solver"] for row in here):
            mine = sorted((row for row in here if row["solver"] == solver), key=lambda row: -row["price"])
            older = np.array([row["code"] not in (None, machine.code_hash()) for row in mine])
            x, low, high = (np.array([r[key] for r in mine], float) for key in ("price", "price_low", "price_high"))
            y, names = np.arange(len(mine), dtype=float), tuple(row["name"] for row in mine)
            series = [Series(solver, marked[solver], x, y, low, high, True, older, joined=False)]
            plots.append(
                Plot(
                    *((scene[0], str(scene[1])), (solver,), f"{scene[0]}, size {scene[1]}", solver),
                    *(Scale("an iteration with the effect over one without", "log", "plain"),),
                    *(Scale("", "names", names=names), series),
                    notes=[OLDER] if older.any() else [],
                    machine=measured_on(mine),
                )
            )
    return ready(plots)
