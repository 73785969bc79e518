# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Output files of a figure: image formats, data as CSV, and a script.

The short script reproduces the figure from the data.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from pprint import pformat
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from harness.base.files import replacing
from harness.report.figures import scripts
from harness.report.figures.asked import Asked
from harness.report.figures.canvas import INCH, RC
from harness.report.figures.drawing import DOTS
from harness.report.figures.panel import CellMap, Panel, Picture, Plot, Row


def write(figure: Figure, panels: Sequence[Panel], stem: Path, title: str, asked: Asked) -> list[Path]:
    """Write a figure, its data as CSV and its script, and return the files.

    Args:
        figure: figure to write.
        panels: panels of the figure, all of one type.
        stem: path of the files without suffix.
        title: title of the figure.
        asked: options of the figure.
    Raises:
        CannotWrite: if a file cannot be written.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    about = "; ".join(dict.fromkeys(words for panel in panels for words in (panel.subject, panel.machine) if words))
    paths: list[Path] = []
    for kind in asked.formats:
        paths.append(stem.with_name(f"{stem.name}.{kind}"))
        with matplotlib.rc_context(RC), replacing(paths[-1]) as partial:
            figure.savefig(partial, format=kind, dpi=DOTS, metadata=_metadata(kind, title, about))
    paths.append(stem.with_name(f"{stem.name}.csv"))
    _table(paths[-1], [row for panel in panels for row in panel.rows()], [title, about])
    if isinstance(panels[0], Picture):
        paths.append(stem.with_name(f"{stem.name}-mesh.csv"))
        meshes = [panel for panel in panels if isinstance(panel, Picture)]
        _table(paths[-1], [row for panel in meshes for row in _mesh(panel)], [title, about])
    paths.append(stem.with_name(f"{stem.name}.py"))
    with replacing(paths[-1]) as partial:
        partial.write_text(script(figure, panels, stem.name, asked), encoding="utf-8")
    return paths


def _metadata(kind: str, title: str, about: str) -> dict[str, Any]:
    """Build the metadata of a file, without a date.

    Equal data thus gives equal files.
    """
    if kind == "pdf":
        return {"Title": title, "Subject": about, "Creator": "springbench", "CreationDate": None}
    if kind == "svg":
        return {"Title": title, "Description": about, "Creator": "springbench", "Date": None}
    return {"Title": title, "Description": about, "Software": "springbench"}


def _table(path: Path, rows: Sequence[Row], about: Sequence[str]) -> None:
    """Write rows as CSV, below comments that describe them."""
    with replacing(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        for words in filter(None, about):
            file.write("# " + " ".join(words.split()) + "\n")
        table = csv.DictWriter(file, rows[0].keys() if rows else ("panel",), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def _mesh(panel: Picture) -> list[Row]:
    name = ":".join((*panel.of, *panel.name))
    if len(panel.triangles):
        return [{"panel": name, "a": a, "b": b, "c": c} for a, b, c in panel.triangles.tolist()]
    return [{"panel": name, "a": a, "b": b} for a, b in panel.springs.tolist()]


def script(figure: Figure, panels: Sequence[Panel], name: str, asked: Asked) -> str:
    """Build a script that needs only Matplotlib and the CSV file next to it."""
    kind = type(panels[0])
    said = {"name": name, "width": asked.width, "size": asked.size, "small": asked.small}
    inches = tuple(round(float(side), 3) for side in figure.get_size_inches())
    places = [spec for ax in figure.axes[: len(panels)] if (spec := ax.get_subplotspec())]
    columns = max(spec.get_topmost_subplotspec().colspan.stop for spec in places)
    shared: dict[str, Any] = said | {"inches": inches, "columns": columns, "rows": -(-len(panels) // columns)}
    head = scripts.HEAD.format(**shared)
    if kind is Plot:
        plots = [panel for panel in panels if isinstance(panel, Plot)]
        looks = {s.label: (s.look.color, s.look.marker, s.look.dash) for panel in plots for s in panel.series}
        return head + scripts.PLOT.format(looks=_told(looks), panels=_told(dict(map(_stated, plots))), **shared)
    if kind is CellMap:
        grids = [panel for panel in panels if isinstance(panel, CellMap)]
        outcomes = dict(grids[0].outcomes)
        return head + scripts.GRID.format(outcomes=_told(outcomes), **shared)
    pictures = [panel for panel in panels if isinstance(panel, Picture)]
    titles = {":".join((*panel.of, *panel.name)): panel.title for panel in pictures}
    return head + scripts.PICTURE.format(titles=_told(titles), limit=pictures[0].limit, **shared)


def _stated(panel: Plot) -> tuple[str, dict[str, Any]]:
    """Describe the properties of a panel that a script needs, except its points."""
    axes = {
        key: {"words": scale.words, "scale": _SCALES[scale.kind], "names": list(scale.names)}
        for key, scale in (("x", panel.x), ("y", panel.y))
    }
    first = panel.series[0] if panel.series else None
    how = {"steps": bool(first and first.steps), "joined": bool(first is None or first.joined)}
    lines = [(line.y, line.words) for line in panel.lines]
    whole = " ".join(filter(None, (panel.subject, panel.title)))
    across = bool(first and first.across)
    return ":".join((*panel.of, *panel.name)), {"title": whole, **axes, **how, "across": across, "lines": lines}


_SCALES = {"log": "log", "sizes": "log", "linear": "linear", "iterations": "symlog", "names": "linear"}


def _told(what: object) -> str:
    return pformat(what, width=110, sort_dicts=False)


def millimetres(figure: Figure) -> tuple[float, float]:
    """Return width and height [mm]."""
    across, up = figure.get_size_inches()
    return float(across) * INCH, float(up) * INCH
