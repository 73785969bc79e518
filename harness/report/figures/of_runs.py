"""Panels of sweeps and of speed reports: times against size."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from harness.base import rows, shelf
from harness.base.errors import InputError, Mistake
from harness.report.figures.entry import Entry, ready
from harness.report.figures.panel import Plot, Scale, Series
from harness.report.origin import NEEDED, measured_on
from harness.report.speed import figures as speed_figures
from harness.report.speed.pictures import PICTURES
from harness.report.style import OLDER, Mark, looks
from harness.report.timing_table import RunTimes, labels, runs

Older = Callable[[pa.Table], Collection[str]]
"""Returns the ids of those runs in a table of rows that other code than the current version measured."""

_VERTICES = Scale("vertices", "sizes", "plain")
_NEEDED = ("run_id", "scene", "size", "solver", "phase", "status")


def sweep_rows(folder: Path) -> pa.Table:
    """Read the rows of a sweep.

    Raises:
        InputError: if there are none, or if they belong to a speed report.
    """
    units = shelf.units(folder / "rows")
    if not units:
        raise InputError(Mistake("holds no rows of runs; wanted those of `springbench run CONFIG`", folder))
    table = rows.read(units, needed=_NEEDED)
    if speed_figures.MACHINE in table["solver"].unique().to_pylist():
        raise InputError(Mistake("holds rows of `springbench speed`; ask for the kind speed", folder))
    return table


def timing(folder: Path, older: Older) -> list[Entry]:
    """Build panels of step and preparation times, for each scene.

    Args:
        folder: folder of a sweep's results.
        older: returns the ids of stale runs in a table of rows.
    """
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
    """Build curves of time against the number of vertices.

    For a single size there is one row per solver instead, the fastest first.
    """
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
    """Build panels of phase times and of the reached share of the limit."""
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
