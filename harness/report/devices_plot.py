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

from harness.base import rows, shelf
from harness.base.errors import InputError
from harness.report.devices import Pair, pairs, pays_from, runs, words
from harness.report.page import axes, count, header, new_page, quantity, save, text, ticks
from harness.report.site.provenance import config_of
from harness.report.style import FASTER, HEIGHT, INK, MUTED, RC, RULE, WIDTH, marks

_LEFT, _TOP, _GAP, _COLUMNS = 84, 150, 96, 2
_SIDES = (("device", FASTER, "-"), ("processor", INK, (0, (5, 2))))


def draw_devices(results: Path) -> Iterator[tuple[Path | None, list[str]]]:
    """Draw `pictures/devices.png` for each sweep that requested a device.

    Args:
        results: folder of results, or the folder of one sweep.
    Yields: the picture, or None if no run on a device reached its residual; and sentences on the sweep's rows.
    """
    for folder in shelf.folders(results, "rows"):
        try:
            found = runs(rows.read(shelf.units(folder), left_out=lambda mistake: None))
        except InputError:
            continue  # the page tells of damaged rows
        if said := words(found, config_of(folder.parent)):
            picture = folder.parent / "pictures" / "devices.png"
            compared = pairs(found)
            picture.unlink(missing_ok=True)  # rows that are gone may have drawn it
            if compared:
                picture.parent.mkdir(exist_ok=True)
                devices = sorted({run.device for run in found if run.device})
                draw(compared, picture, folder.parent.resolve().name, devices)
            yield picture if compared else None, said


def draw(compared: dict[tuple[str, float], list[Pair]], path: Path, title: str, facts: Sequence[str]) -> None:
    """Draw the fastest runs of both sides as a PNG file.

    The picture is WIDTH pixels wide and at most HEIGHT high.

    Args:
        compared: device pairs by scene and tolerance.
        path: target file.
        title: title of the picture.
        facts: phrases below the title.
    """
    columns = min(_COLUMNS, len(compared))
    lines = ceil(len(compared) / columns)
    width = (WIDTH - _LEFT - 40 - _GAP * (columns - 1)) / columns
    tall = (HEIGHT - _TOP - 60 - _GAP * (lines - 1)) / lines
    with matplotlib.rc_context(RC):
        page = new_page()
        header(
            page, title, [*facts, "seconds of a step, the best of each side", "upright: from there on a device pays"]
        )
        for k, ((scene, tolerance), mine) in enumerate(compared.items()):
            line, column = divmod(k, columns)
            left, top = _LEFT + column * (width + _GAP), _TOP + line * (tall + _GAP)
            text(page, left, top - 16, f"{scene}, to a residual of {tolerance:g}", size=12, weight="bold")
            _panel(axes(page, left, top, width, tall), mine)
        save(page, path)


def _panel(ax: Axes, mine: Sequence[Pair]) -> None:
    looks = marks(run.solver for pair in mine for run in (pair.there, pair.here) if run)
    ax.set_xscale("log")
    ax.set_yscale("log")
    for (side, color, dash), of in zip(_SIDES, ("there", "here"), strict=True):
        ended = [(pair.vertices, run) for pair in mine if (run := getattr(pair, of))]
        ax.plot([n for n, _ in ended], [run.seconds for _, run in ended], color=color, ls=dash, lw=1.6, label=side)
        for n, run in ended:
            ax.plot(n, run.seconds, marker=looks[run.solver].marker, color=color, ls="", markersize=7)
            ax.annotate(
                run.solver, (n, run.seconds), xytext=(6, -11), textcoords="offset points", fontsize=8, color=color
            )
    if first := pays_from(mine):
        ax.axvline(first.vertices, color=FASTER, lw=1.0, alpha=0.5)
    ax.set_xticks(sorted({pair.vertices for pair in mine}))
    ax.xaxis.set_major_formatter(ticks(lambda value: count(round(value))))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.yaxis.set_major_formatter(ticks(quantity))
    ax.grid(axis="y", color=RULE)
    ax.set_xlabel("vertices", color=MUTED)
    ax.legend(frameon=False, loc="upper left")
