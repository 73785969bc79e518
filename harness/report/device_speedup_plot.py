# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Plot of device speedups: step times of both sides against vertices.

Each side is represented by its fastest run to a residual.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter
from springbench.harness.errors import InputError
from springbench.harness.report.device_speedup import (
    DevicePair,
    find_break_even,
    pair_fastest_runs,
    read_device_runs,
    summarise_runs,
)
from springbench.harness.report.number_format import format_count, format_quantity
from springbench.harness.report.page_layout import add_axes, draw_header, draw_text, new_page, save_page, tick_formatter
from springbench.harness.report.plot_style import (
    FASTER_COLOUR,
    MUTED_COLOUR,
    PAGE_HEIGHT,
    PAGE_RC,
    PAGE_WIDTH,
    RULE_COLOUR,
    TEXT_COLOUR,
    assign_solver_styles,
)
from springbench.harness.report.site.row_provenance import find_config
from springbench.harness.results import parquet_rows, row_store

_PANELS_LEFT, _PANELS_TOP, _PANEL_GAP, _MAX_COLUMNS = 84, 150, 96, 2
_SIDE_STYLES = (("device", FASTER_COLOUR, "-"), ("processor", TEXT_COLOUR, (0, (5, 2))))


def draw_device_speedups(results: Path) -> Iterator[tuple[Path | None, list[str]]]:
    """Draw `pictures/devices.png` for each sweep that requested a device.

    Args:
        results: folder of results, or the folder of one sweep.
    Yields: the picture, or None if no run on a device reached its residual; and sentences on the sweep's rows.
    """
    for folder in row_store.find_row_folders(results, "rows"):
        try:
            found = read_device_runs(
                parquet_rows.read_rows(row_store.list_units(folder), on_invalid=lambda mistake: None)
            )
        except InputError:
            continue  # the page reports damaged rows
        if sentences := summarise_runs(found, find_config(folder.parent)):
            picture = folder.parent / "pictures" / "devices.png"
            compared = pair_fastest_runs(found)
            picture.unlink(missing_ok=True)  # rows that are gone may have drawn it
            if compared:
                picture.parent.mkdir(exist_ok=True)
                devices = sorted({run.device for run in found if run.device})
                draw_pairs(compared, picture, folder.parent.resolve().name, devices)
            yield picture if compared else None, sentences


def draw_pairs(
    pairs_by_panel: dict[tuple[str, float], list[DevicePair]], path: Path, title: str, facts: Sequence[str]
) -> None:
    """Draw the fastest runs of both sides as a PNG file.

    The picture is PAGE_WIDTH pixels wide and at most PAGE_HEIGHT high.

    Args:
        pairs_by_panel: device pairs by scene and tolerance.
        path: target file.
        title: title of the picture.
        facts: phrases below the title.
    """
    columns = min(_MAX_COLUMNS, len(pairs_by_panel))
    lines = ceil(len(pairs_by_panel) / columns)
    width = (PAGE_WIDTH - _PANELS_LEFT - 40 - _PANEL_GAP * (columns - 1)) / columns
    tall = (PAGE_HEIGHT - _PANELS_TOP - 60 - _PANEL_GAP * (lines - 1)) / lines
    with matplotlib.rc_context(PAGE_RC):
        page = new_page()
        draw_header(
            page, title, [*facts, "seconds of a step, the best of each side", "upright: from there on a device pays"]
        )
        for k, ((scene, tolerance), mine) in enumerate(pairs_by_panel.items()):
            line, column = divmod(k, columns)
            left, top = _PANELS_LEFT + column * (width + _PANEL_GAP), _PANELS_TOP + line * (tall + _PANEL_GAP)
            draw_text(page, left, top - 16, f"{scene}, to a residual of {tolerance:g}", size=12, weight="bold")
            _draw_panel(add_axes(page, left, top, width, tall), mine)
        save_page(page, path)


def _draw_panel(ax: Axes, panel_pairs: Sequence[DevicePair]) -> None:
    looks = assign_solver_styles(run.solver for pair in panel_pairs for run in (pair.device_run, pair.cpu_run) if run)
    ax.set_xscale("log")
    ax.set_yscale("log")
    for (side, color, dash), of in zip(_SIDE_STYLES, ("device_run", "cpu_run"), strict=True):
        ended = [(pair.vertices, run) for pair in panel_pairs if (run := getattr(pair, of))]
        ax.plot([n for n, _ in ended], [run.seconds for _, run in ended], color=color, ls=dash, lw=1.6, label=side)
        for n, run in ended:
            ax.plot(n, run.seconds, marker=looks[run.solver].marker, color=color, ls="", markersize=7)
            ax.annotate(
                run.solver, (n, run.seconds), xytext=(6, -11), textcoords="offset points", fontsize=8, color=color
            )
    if first := find_break_even(panel_pairs):
        ax.axvline(first.vertices, color=FASTER_COLOUR, lw=1.0, alpha=0.5)
    ax.set_xticks(sorted({pair.vertices for pair in panel_pairs}))
    ax.xaxis.set_major_formatter(tick_formatter(lambda value: format_count(round(value))))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.yaxis.set_major_formatter(tick_formatter(format_quantity))
    ax.grid(axis="y", color=RULE_COLOUR)
    ax.set_xlabel("vertices", color=MUTED_COLOUR)
    ax.legend(frameon=False, loc="upper left")
