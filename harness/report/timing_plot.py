# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Step and preparation times [ms] against number of vertices, by solver.

Each scene has a pair of panels.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from math import ceil
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullLocator

from harness.report.labels import LINE, End, direct_labels
from harness.report.origin import machine_and_commit
from harness.report.page import axes, count, header, new_page, quantity, save, shorten, text, ticks
from harness.report.style import DASH_DOTTED, DASHED, DOTTED, HEIGHT, INK, MUTED, PAGE, RC, WIDTH, Mark, marks
from harness.report.timing_rows import HEADINGS, draw_rows
from harness.report.timing_table import RunTimes, labels, runs

_LEFT, _TOP, _RIGHT, _BOTTOM = 40, 118, WIDTH - 40, HEIGHT - 30
_COLUMNS = 4  # scenes side by side
_NOTES = 4  # failures told in words at the foot; all are marked in the panels
_LETTERS = 34  # of a direct label
_DASHES = (DASHED, DOTTED, DASH_DOTTED)  # the further variants of one solver


def timing(rows: pa.Table, folder: Path) -> list[Path]:
    """Write the timing plot of a sweep; a report that a sweep can name.

    Args:
        rows: rows of the sweep.
        folder: folder that the file is written to.
    Returns: the path of the picture.
    """
    path = folder / "timing.png"
    draw_timing(rows, path, folder.name)
    return [path]


def draw_timing(table: pa.Table, path: Path, title: str, older: Collection[str] = ()) -> None:
    """Draw the times of a sweep's runs as a PNG file.

    The picture is WIDTH pixels wide and at most HEIGHT high. Failed runs are crosses at the upper edge, with
    their reasons in words at the foot. A scene of one size has a row for each solver instead of a point in an empty
    frame.

    Args:
        table: rows (schema: `harness.base.columns.SCHEMA`).
        path: target file.
        title: title of the picture.
        older: ids of runs that were executed by other code than the current version; their marks are hollow.
    """
    found = runs(table)
    names = labels(found)
    looks = marks(run.solver for run in found)
    scenes = list(dict.fromkeys(run.scene for run in found))
    failed = [run for run in found if run.status != "ok"]
    with matplotlib.rc_context(RC):
        page = new_page()
        hollow = ["hollow: by other code than today's"] if any(run.run_id in older for run in found) else []
        header(page, title, [*_facts(table), *hollow], letters=84)
        bottom = _BOTTOM - LINE * min(len(failed), _NOTES + 1)
        columns = min(len(scenes), _COLUMNS) or 1
        width, height = (_RIGHT - _LEFT) / columns, (bottom - _TOP) / (ceil(len(scenes) / columns) or 1)
        used = float(HEIGHT) if failed or not scenes else 0.0
        for k, scene in enumerate(scenes):
            row, column = divmod(k, columns)
            box = (_LEFT + column * width, _TOP + row * height, width - 20, height - 12)
            one = len({run.vertices for run in found if run.scene == scene and run.vertices}) == 1
            drawn = (draw_rows if one else _scene)(page, scene, found, names, looks, box, older)
            used = max(used, drawn)
        _notes(page, failed, names, bottom)
        save(page, path, used=min(used, HEIGHT))


def _facts(table: pa.Table) -> list[str]:
    """Return the machine, the code version and the meaning of the marks."""
    threads: list[int] = sorted(set[Any](table["threads"].drop_null().to_pylist()))
    facts = ["median and quartiles of all steps"]
    if threads:
        facts.append(f"{', '.join(map(str, threads))} thread{'s' if threads != [1] else ''}")
    return [*facts, *machine_and_commit(table.select(["cpu", "commit"]).to_pylist())]


def _scene(
    page: Figure,
    scene: str,
    found: Sequence[RunTimes],
    names: Mapping[str, str],
    looks: Mapping[str, Mark],
    box: tuple[float, float, float, float],
    older: Collection[str],
) -> float:
    """Draw the two panels of one scene within a box (left, top, width, height) [pixels].

    All scenes have the same time scales. Returns the y position of the lower end [pixels].
    """
    left, top, width, height = box
    text(page, left, top + 14, shorten(scene, int(width / 10)), size=12.5, weight="bold")
    room = height - 56 - 64 - 44  # less the headings and the ticks of both panels
    upper, lower = 0.64 * room, 0.36 * room
    text(page, left, top + 40, HEADINGS[0], size=9.5, color=MUTED)
    step = axes(page, left + 48, top + 52, width - 48, upper)
    below = top + 52 + upper + 64
    text(page, left, below - 12, HEADINGS[1], size=9.5, color=MUTED)
    prepare = axes(page, left + 48, below, width - 48, lower)
    here = [run for run in found if run.scene == scene and run.vertices]
    failed = [run for run in here if run.status != "ok"]
    series: dict[str, list[RunTimes]] = {}
    for run in here:
        if run.status == "ok":
            series.setdefault(names[run.run_id], []).append(run)
    sizes = sorted({run.vertices or 0 for run in here})
    letters = max((min(len(name), _LETTERS) for name in series), default=0) + 6
    labels_share = min(7.6 * letters / (width - 48), 0.42)
    crosses = any(run.status != "ok" for run in found)
    _scales(step, sizes, _times(found, "step", "lower", "upper"), labels_share, crosses=crosses)
    _scales(prepare, sizes, _times(found, "cold", "warm"), labels_share)
    prepare.set_xlabel("vertices", fontsize=9.5, loc="left")
    ends: list[End] = []
    for (name, members), dash in zip(series.items(), _variants(series, looks), strict=True):
        look = looks[members[0].solver]
        ends += _draw_steps(step, name, members, look, dash, older)
        _draw_prepare(prepare, members, look, older)
    direct_labels(step, ends)
    _crosses(step, failed, looks)
    if not series:
        step.text(0.5, 0.5, "no run succeeded", transform=step.transAxes, ha="center", color=MUTED)
    return float(HEIGHT)


def _variants(series: Mapping[str, Sequence[RunTimes]], looks: Mapping[str, Mark]) -> list[Any]:
    """Assign a line style to each series.

    The first series of a solver gets the solver's own style.
    """
    dashes: list[Any] = []
    solvers = [members[0].solver for members in series.values()]
    for k, solver in enumerate(solvers):
        own = looks[solver].dash
        styles = [own, *(dash for dash in _DASHES if dash != own)]
        dashes.append(styles[solvers[:k].count(solver) % len(styles)])
    return dashes


def _times(found: Sequence[RunTimes], *fields: str) -> list[float]:
    """Return all times [ms] in these fields of the runs.

    There are at least two, so that a scale always exists.
    """
    times = [getattr(run, field) for run in found for field in fields]
    return [time for time in times if time] or [0.1, 10.0]


def _scales(
    ax: Axes, sizes: Sequence[int], times: Sequence[float], labels_share: float, *, crosses: bool = False
) -> None:
    """Set logarithmic scales with space for labels and crosses.

    Direct labels are at the right and, if needed, crosses at the top.
    """
    sizes = sizes or [1, 10]
    first, last = (sizes[0] / 1.15, sizes[-1] * 1.15) if len(sizes) > 1 else (sizes[0] / 2, sizes[0] * 2)
    ax.set_xscale("log")
    ax.set_xlim(first, last * (last / first) ** (labels_share / (1 - labels_share)))
    middle, ratio = np.sqrt(min(times) * max(times)), max(times) / min(times)
    reach = np.sqrt(max(ratio**1.16, 10.0))  # at least a decade, so that noise looks like noise
    low, high = middle / reach, middle * reach
    ax.set_yscale("log")
    ax.set_ylim(low, high * (high / low) ** (0.16 if crosses else 0.0))
    ax.xaxis.set_major_locator(FixedLocator(_apart(ax, sizes)))
    ax.xaxis.set_major_formatter(ticks(lambda value: count(round(value))))
    wide = high / low > 300
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0), numticks=8 if wide else 12))
    ax.yaxis.set_major_formatter(ticks(quantity))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(NullLocator())
    ax.tick_params(length=3, labelsize=9)
    ax.grid(axis="y")
    ax.set_axisbelow(True)


def _apart(ax: Axes, sizes: Sequence[int]) -> list[int]:
    """Select the sizes whose tick labels do not overlap; the largest is always included."""
    at = {size: ax.transData.transform((size, 1.0))[0] for size in sizes}
    kept = [sizes[-1]]
    for size in reversed(sizes[:-1]):
        if at[kept[-1]] - at[size] > 8.0 * len(count(kept[-1])):
            kept.append(size)
    return kept


def _draw_steps(
    ax: Axes, name: str, members: Sequence[RunTimes], look: Mark, dash: Any, older: Collection[str]
) -> list[End]:
    """Draw one line with its quartile band.

    Returns the position, text and colour of its direct label.
    """
    timed = sorted((run for run in members if run.step), key=lambda run: run.vertices or 0)
    if not timed:
        return []
    n, middle, low, high = (
        np.array([getattr(run, field) for run in timed], float) for field in ("vertices", "step", "lower", "upper")
    )
    ax.fill_between(n, low, high, color=look.color, alpha=0.16, linewidth=0)
    ax.vlines(n, low, high, color=look.color, alpha=0.5, linewidth=1.2)
    ax.plot(n, middle, color=look.color, linestyle=dash, linewidth=1.8, marker=look.marker, markersize=6, mec=PAGE)
    hollow = [run.run_id in older for run in timed]
    ax.plot(
        n[hollow], middle[hollow], marker=look.marker, ls="", mfc=PAGE, mec=look.color, mew=1.5, markersize=6, zorder=4
    )
    solver, comma, settings = name.partition(", ")
    words = shorten(shorten(solver, 20) + comma + settings, _LETTERS)
    if len(set(n)) > 1:
        slope = np.polyfit(np.log(n), np.log(middle), 1)[0]
        words += f"  $n^{{{slope:.1f}}}$"
    return [(n[-1], middle[-1], words, look.color)]


def _draw_prepare(ax: Axes, members: Sequence[RunTimes], look: Mark, older: Collection[str]) -> None:
    for field, dash, marker in (("cold", (0, (2, 2)), "_"), ("warm", "-", look.marker)):
        known = [run for run in members if getattr(run, field)]
        timed = sorted((run.vertices or 0, getattr(run, field), run.run_id in older) for run in known)
        if timed:
            n, value, hollow = (np.array(part) for part in zip(*timed, strict=True))
            ax.plot(n, value, color=look.color, linestyle=dash, linewidth=1.3, marker=marker, markersize=5)
            if hollow.any():
                at, of = n[hollow], value[hollow]
                ax.plot(at, of, marker=marker, ls="", mfc=PAGE, mec=look.color, markersize=5, zorder=4)


def _crosses(ax: Axes, failed: Sequence[RunTimes], looks: Mapping[str, Mark]) -> None:
    """Draw a cross at the upper edge for each failed run.

    Crosses of one size are stacked.
    """
    taken: dict[int, int] = {}
    for run in failed:
        size = run.vertices or 0
        place = taken[size] = taken.get(size, -1) + 1
        y = 1.0 - (9 + 15 * place) / ax.bbox.height
        at = ax.get_xaxis_transform()
        color = looks[run.solver].color
        ax.plot([size], [y], "x", color=color, transform=at, markersize=7, markeredgewidth=2, clip_on=False)
        status = ax.annotate(run.status, (size, y), (8, 0), xycoords=at, textcoords="offset points")
        status.set(color=color, fontsize=8, va="center")


def _notes(page: Figure, failed: Sequence[RunTimes], names: Mapping[str, str], top: float) -> None:
    """Draw the failed runs and their reasons at the foot of the page."""
    for k, run in enumerate(failed[:_NOTES]):
        where = f"{run.scene}, size {run.size}" if run.size else run.scene
        why = f"{run.status}: {run.reason}" if run.reason else run.status
        text(page, _LEFT, top + LINE * (k + 1), "×", size=11, color=INK)
        words = f"{names[run.run_id]} on {where} {why}"
        text(page, _LEFT + 18, top + LINE * (k + 1), shorten(" ".join(words.split()), 190), size=9)
    if len(failed) > _NOTES:
        rest = f"and {len(failed) - _NOTES} more, marked above"
        text(page, _LEFT + 18, top + LINE * (_NOTES + 1), rest, size=9, color=MUTED)
