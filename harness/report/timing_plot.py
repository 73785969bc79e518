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
from springbench.harness.report.line_end_labels import LABEL_SPACING, LineEnd, draw_direct_labels
from springbench.harness.report.number_format import format_count, format_quantity, shorten_words
from springbench.harness.report.page_layout import add_axes, draw_header, draw_text, new_page, save_page, tick_formatter
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    DASH_DOTTED_LINE,
    DASHED_LINE,
    DOTTED_LINE,
    MUTED_COLOUR,
    PAGE_HEIGHT,
    PAGE_RC,
    PAGE_WIDTH,
    TEXT_COLOUR,
    SeriesStyle,
    assign_solver_styles,
)
from springbench.harness.report.provenance_words import describe_machine_and_commit
from springbench.harness.report.timing_rows_plot import PANEL_TITLES, draw_timing_rows
from springbench.harness.report.timing_table import RunTimes, label_runs, read_run_times

_PANELS_LEFT, _PANELS_TOP, _PANELS_RIGHT, _PANELS_BOTTOM = 40, 118, PAGE_WIDTH - 40, PAGE_HEIGHT - 30
_PANEL_COLUMNS = 4  # scenes side by side
_MAX_NOTES = 4  # failures described in the footer; the panels mark all
_LABEL_LETTERS = 34  # of a direct label
_VARIANT_LINE_STYLES = (DASHED_LINE, DOTTED_LINE, DASH_DOTTED_LINE)  # the further variants of one solver


def write_timing_plot(rows: pa.Table, folder: Path) -> list[Path]:
    """Write the timing plot of a sweep; a report that a sweep can name.

    Args:
        rows: rows of the sweep.
        folder: folder that the file is written to.
    Returns: the path of the picture.
    """
    path = folder / "timing.png"
    draw_timing_plot(rows, path, folder.name)
    return [path]


def draw_timing_plot(
    table: pa.Table, path: Path, title: str, stale_ids: Collection[str] = (), sources: str = ""
) -> None:
    """Draw the times of a sweep's runs as a PNG file.

    The picture is PAGE_WIDTH pixels wide and at most PAGE_HEIGHT high. Failed runs are crosses at the upper edge, with
    their reasons in words at the foot. A scene of one size has a row for each solver instead of a point in an empty
    frame.

    Args:
        table: rows (schema: `springbench.harness.results.run_schema.RUN_SCHEMA`).
        path: target file.
        title: title of the picture.
        stale_ids: ids of runs that were executed by other code than the current version; their marks are hollow.
        sources: digest of all these, stored in the file (`springbench.harness.report.page_layout.save_page`).
    """
    found = read_run_times(table)
    names = label_runs(found)
    looks = assign_solver_styles(run.solver for run in found)
    scenes = list(dict.fromkeys(run.scene for run in found))
    failed = [run for run in found if run.status != "ok"]
    with matplotlib.rc_context(PAGE_RC):
        page = new_page()
        hollow = ["hollow: by other code than today's"] if any(run.run_id in stale_ids for run in found) else []
        draw_header(page, title, [*_collect_facts(table), *hollow], max_letters=84)
        bottom = _PANELS_BOTTOM - LABEL_SPACING * min(len(failed), _MAX_NOTES + 1)
        columns = min(len(scenes), _PANEL_COLUMNS) or 1
        width, height = (
            (_PANELS_RIGHT - _PANELS_LEFT) / columns,
            (bottom - _PANELS_TOP) / (ceil(len(scenes) / columns) or 1),
        )
        used = float(PAGE_HEIGHT) if failed or not scenes else 0.0
        for k, scene in enumerate(scenes):
            row, column = divmod(k, columns)
            box = (_PANELS_LEFT + column * width, _PANELS_TOP + row * height, width - 20, height - 12)
            one = len({run.vertices for run in found if run.scene == scene and run.vertices}) == 1
            drawn = (draw_timing_rows if one else _draw_scene)(page, scene, found, names, looks, box, stale_ids)
            used = max(used, drawn)
        _draw_failure_notes(page, failed, names, bottom)
        save_page(page, path, used_height=min(used, PAGE_HEIGHT), sources=sources)


def _collect_facts(table: pa.Table) -> list[str]:
    """Return the machine, the code version and the meaning of the marks."""
    threads: list[int] = sorted(set[Any](table["threads"].drop_null().to_pylist()))
    facts = ["median and quartiles of all steps"]
    if threads:
        facts.append(f"{', '.join(map(str, threads))} thread{'s' if threads != [1] else ''}")
    return [*facts, *describe_machine_and_commit(table.select(["cpu", "commit"]).to_pylist())]


def _draw_scene(
    page: Figure,
    scene: str,
    timed_runs: Sequence[RunTimes],
    names: Mapping[str, str],
    styles: Mapping[str, SeriesStyle],
    box: tuple[float, float, float, float],
    stale_ids: Collection[str],
) -> float:
    """Draw the two panels of one scene within a box (left, top, width, height) [pixels].

    All scenes have the same time scales. Returns the y position of the lower end [pixels].
    """
    left, top, width, height = box
    draw_text(page, left, top + 14, shorten_words(scene, int(width / 10)), size=12.5, weight="bold")
    room = height - 56 - 64 - 44  # less the headings and the ticks of both panels
    upper, lower = 0.64 * room, 0.36 * room
    draw_text(page, left, top + 40, PANEL_TITLES[0], size=9.5, color=MUTED_COLOUR)
    step = add_axes(page, left + 48, top + 52, width - 48, upper)
    below = top + 52 + upper + 64
    draw_text(page, left, below - 12, PANEL_TITLES[1], size=9.5, color=MUTED_COLOUR)
    prepare = add_axes(page, left + 48, below, width - 48, lower)
    here = [run for run in timed_runs if run.scene == scene and run.vertices]
    failed = [run for run in here if run.status != "ok"]
    series: dict[str, list[RunTimes]] = {}
    for run in here:
        if run.status == "ok":
            series.setdefault(names[run.run_id], []).append(run)
    sizes = sorted({run.vertices or 0 for run in here})
    letters = max((min(len(name), _LABEL_LETTERS) for name in series), default=0) + 6
    labels_share = min(7.6 * letters / (width - 48), 0.42)
    crosses = any(run.status != "ok" for run in timed_runs)
    _format_axes(step, sizes, _collect_times(timed_runs, "step", "lower", "upper"), labels_share, crosses=crosses)
    _format_axes(prepare, sizes, _collect_times(timed_runs, "cold", "warm"), labels_share)
    prepare.set_xlabel("vertices", fontsize=9.5, loc="left")
    ends: list[LineEnd] = []
    for (name, members), dash in zip(series.items(), _assign_line_styles(series, styles), strict=True):
        look = styles[members[0].solver]
        ends += _draw_step_times(step, name, members, look, dash, stale_ids)
        _draw_prepare_times(prepare, members, look, stale_ids)
    draw_direct_labels(step, ends)
    _draw_failure_crosses(step, failed, styles)
    if not series:
        step.text(0.5, 0.5, "no run succeeded", transform=step.transAxes, ha="center", color=MUTED_COLOUR)
    return float(PAGE_HEIGHT)


def _assign_line_styles(series: Mapping[str, Sequence[RunTimes]], looks: Mapping[str, SeriesStyle]) -> list[Any]:
    """Assign a line style to each series.

    The first series of a solver gets the solver's own style.
    """
    dashes: list[Any] = []
    solvers = [members[0].solver for members in series.values()]
    for k, solver in enumerate(solvers):
        own = looks[solver].dash
        styles = [own, *(dash for dash in _VARIANT_LINE_STYLES if dash != own)]
        dashes.append(styles[solvers[:k].count(solver) % len(styles)])
    return dashes


def _collect_times(timed_runs: Sequence[RunTimes], *fields: str) -> list[float]:
    """Return all times [ms] in these fields of the runs.

    There are at least two, so that a scale always exists.
    """
    times = [getattr(run, field) for run in timed_runs for field in fields]
    return [time for time in times if time] or [0.1, 10.0]


def _format_axes(
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
    ax.xaxis.set_major_locator(FixedLocator(_select_spaced_sizes(ax, sizes)))
    ax.xaxis.set_major_formatter(tick_formatter(lambda value: format_count(round(value))))
    wide = high / low > 300
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0), numticks=8 if wide else 12))
    ax.yaxis.set_major_formatter(tick_formatter(format_quantity))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(NullLocator())
    ax.tick_params(length=3, labelsize=9)
    ax.grid(axis="y")
    ax.set_axisbelow(True)


def _select_spaced_sizes(ax: Axes, sizes: Sequence[int]) -> list[int]:
    """Select the sizes whose tick labels do not overlap; the largest is always included."""
    at = {size: ax.transData.transform((size, 1.0))[0] for size in sizes}
    selected = [sizes[-1]]
    for size in reversed(sizes[:-1]):
        if at[selected[-1]] - at[size] > 8.0 * len(format_count(selected[-1])):
            selected.append(size)
    return selected


def _draw_step_times(
    ax: Axes, name: str, members: Sequence[RunTimes], style: SeriesStyle, dash: Any, stale_ids: Collection[str]
) -> list[LineEnd]:
    """Draw one line with its quartile band.

    Returns the position, text and colour of its direct label.
    """
    timed = sorted((run for run in members if run.step), key=lambda run: run.vertices or 0)
    if not timed:
        return []
    n, middle, low, high = (
        np.array([getattr(run, field) for run in timed], float) for field in ("vertices", "step", "lower", "upper")
    )
    ax.fill_between(n, low, high, color=style.color, alpha=0.16, linewidth=0)
    ax.vlines(n, low, high, color=style.color, alpha=0.5, linewidth=1.2)
    ax.plot(
        n,
        middle,
        color=style.color,
        linestyle=dash,
        linewidth=1.8,
        marker=style.marker,
        markersize=6,
        mec=BACKGROUND_COLOUR,
    )
    hollow = [run.run_id in stale_ids for run in timed]
    ax.plot(
        n[hollow],
        middle[hollow],
        marker=style.marker,
        ls="",
        mfc=BACKGROUND_COLOUR,
        mec=style.color,
        mew=1.5,
        markersize=6,
        zorder=4,
    )
    solver, comma, settings = name.partition(", ")
    words = shorten_words(shorten_words(solver, 20) + comma + settings, _LABEL_LETTERS)
    if len(set(n)) > 1:
        slope = np.polyfit(np.log(n), np.log(middle), 1)[0]
        words += f"  $n^{{{slope:.1f}}}$"
    return [(n[-1], middle[-1], words, style.color)]


def _draw_prepare_times(ax: Axes, members: Sequence[RunTimes], style: SeriesStyle, stale_ids: Collection[str]) -> None:
    for field, dash, marker in (("cold", (0, (2, 2)), "_"), ("warm", "-", style.marker)):
        known = [run for run in members if getattr(run, field)]
        timed = sorted((run.vertices or 0, getattr(run, field), run.run_id in stale_ids) for run in known)
        if timed:
            n, value, hollow = (np.array(part) for part in zip(*timed, strict=True))
            ax.plot(n, value, color=style.color, linestyle=dash, linewidth=1.3, marker=marker, markersize=5)
            if hollow.any():
                at, of = n[hollow], value[hollow]
                ax.plot(at, of, marker=marker, ls="", mfc=BACKGROUND_COLOUR, mec=style.color, markersize=5, zorder=4)


def _draw_failure_crosses(ax: Axes, failed: Sequence[RunTimes], styles: Mapping[str, SeriesStyle]) -> None:
    """Draw a cross at the upper edge for each failed run.

    Crosses of one size are stacked.
    """
    taken: dict[int, int] = {}
    for run in failed:
        size = run.vertices or 0
        place = taken[size] = taken.get(size, -1) + 1
        y = 1.0 - (9 + 15 * place) / ax.bbox.height
        at = ax.get_xaxis_transform()
        color = styles[run.solver].color
        ax.plot([size], [y], "x", color=color, transform=at, markersize=7, markeredgewidth=2, clip_on=False)
        status = ax.annotate(run.status, (size, y), (8, 0), xycoords=at, textcoords="offset points")
        status.set(color=color, fontsize=8, va="center")


def _draw_failure_notes(page: Figure, failed: Sequence[RunTimes], names: Mapping[str, str], top: float) -> None:
    """Draw the failed runs and their reasons at the foot of the page."""
    for k, run in enumerate(failed[:_MAX_NOTES]):
        where = f"{run.scene}, size {run.size}" if run.size else run.scene
        why = f"{run.status}: {run.reason}" if run.reason else run.status
        draw_text(page, _PANELS_LEFT, top + LABEL_SPACING * (k + 1), "×", size=11, color=TEXT_COLOUR)
        words = f"{names[run.run_id]} on {where} {why}"
        draw_text(
            page, _PANELS_LEFT + 18, top + LABEL_SPACING * (k + 1), shorten_words(" ".join(words.split()), 190), size=9
        )
    if len(failed) > _MAX_NOTES:
        rest = f"and {len(failed) - _MAX_NOTES} more, marked above"
        draw_text(page, _PANELS_LEFT + 18, top + LABEL_SPACING * (_MAX_NOTES + 1), rest, size=9, color=MUTED_COLOUR)
