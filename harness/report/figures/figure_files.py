# pyright: reportUnknownMemberType=false
# Matplotlib's stubs do not type most keywords.
"""Output files of a figure: image formats, data as CSV, and a script.

The short script reproduces the figure from the data.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from pprint import pformat
from typing import Any

import matplotlib
from matplotlib.backend_bases import get_registered_canvas_class
from matplotlib.figure import Figure
from springbench.harness.atomic_files import atomic_write
from springbench.harness.execution.forked_call import start_in_fork
from springbench.harness.report.charts.figure_panels import CellMap, CsvRow, CurvePlot, FigurePanel, MeshPicture
from springbench.harness.report.figures import script_templates
from springbench.harness.report.figures.figure_layout import FIGURE_RC, MILLIMETRES_PER_INCH
from springbench.harness.report.figures.figure_options import FIGURE_FORMATS, FigureOptions
from springbench.harness.report.figures.panel_drawing import RASTER_DPI
from springbench.harness.report.picture_sources import SOURCES_KEY


def write_figure(
    figure: Figure, panels: Sequence[FigurePanel], stem: Path, title: str, options: FigureOptions
) -> list[Path]:
    """Write a figure, its data as CSV and its script, and return the files.

    Args:
        figure: figure to write.
        panels: panels of the figure, all of one type.
        stem: path of the files without suffix.
        title: title of the figure.
        options: options of the figure.

    Raises:
        WriteError: if a file cannot be written.
    """
    about = "; ".join(
        dict.fromkeys(words for panel in panels for words in (panel.subject, panel.machine_words) if words)
    )
    first, *rest = sorted(options.formats, key=FIGURE_FORMATS.index)  # PDF takes as long as the others together
    finish_first = start_in_fork(partial(write_images, figure, stem, title, about, replace(options, formats=(first,))))
    write_images(figure, stem, title, about, replace(options, formats=tuple(rest)))
    paths = [stem.with_name(f"{stem.name}.{suffix}") for suffix in (*options.formats, "csv")]
    _write_csv(paths[-1], [row for panel in panels for row in panel.csv_rows()], [title, about])
    if isinstance(panels[0], MeshPicture):
        paths.append(stem.with_name(f"{stem.name}-mesh.csv"))
        meshes = [panel for panel in panels if isinstance(panel, MeshPicture)]
        _write_csv(paths[-1], [row for panel in meshes for row in _mesh_rows(panel)], [title, about])
    paths.append(stem.with_name(f"{stem.name}.py"))
    with atomic_write(paths[-1]) as target:
        target.write_text(build_script(figure, panels, stem.name, options), encoding="utf-8")
    finish_first()
    return paths


def preload_formats() -> None:
    """Import what writes each format."""
    for kind in FIGURE_FORMATS:
        get_registered_canvas_class(kind)


def write_images(
    figure: Figure,
    stem: Path,
    title: str,
    about: str,
    options: FigureOptions,
    dpi: int = RASTER_DPI,
    sources: str = "",
) -> list[Path]:
    """Write a figure in the formats of its options, and return the files.

    Args:
        figure: figure to write.
        stem: path of the files without suffix.
        title, about: metadata of the files.
        options: options of the figure.
        dpi: resolution of images [dots per inch].
        sources: digest of the data, stored in PNG files.

    Raises:
        WriteError: if a file cannot be written.
    """
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = {kind: stem.with_name(f"{stem.name}.{kind}") for kind in options.formats}
    for kind in sorted(paths, key="png".__eq__):  # the PNG last: its digest states that all formats are up to date
        with matplotlib.rc_context(FIGURE_RC), atomic_write(paths[kind]) as target:
            figure.savefig(target, format=kind, dpi=dpi, metadata=_build_metadata(kind, title, about, sources))
    return list(paths.values())


def _build_metadata(kind: str, title: str, about: str, sources: str) -> dict[str, Any]:
    """Build the metadata of a file, without a date.

    Equal data thus gives equal files.
    """
    if kind == "pdf":
        return {"Title": title, "Subject": about, "Creator": "springbench", "CreationDate": None}
    if kind == "svg":
        return {"Title": title, "Description": about, "Creator": "springbench", "Date": None}
    return {"Title": title, "Description": about, "Software": "springbench", SOURCES_KEY: sources}


def _write_csv(path: Path, rows: Sequence[CsvRow], about: Sequence[str]) -> None:
    """Write rows as CSV, below comments that describe them."""
    with atomic_write(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        for words in filter(None, about):
            file.write("# " + " ".join(words.split()) + "\n")
        table = csv.DictWriter(file, rows[0].keys() if rows else ("panel",), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def _mesh_rows(panel: MeshPicture) -> list[CsvRow]:
    name = ":".join((*panel.group, *panel.name))
    if len(panel.triangles):
        return [{"panel": name, "a": a, "b": b, "c": c} for a, b, c in panel.triangles.tolist()]
    return [{"panel": name, "a": a, "b": b} for a, b in panel.springs.tolist()]


def build_script(figure: Figure, panels: Sequence[FigurePanel], name: str, options: FigureOptions) -> str:
    """Build a script that needs only Matplotlib and the CSV file next to it.

    Args:
        figure: drawn figure, whose size and columns the script repeats.
        panels: panels in their order, all of one kind.
        name: name of the files without suffix.
        options: width and font sizes.

    Returns:
        Source of the script.
    """
    kind = type(panels[0])
    settings = {"name": name, "width": options.width_mm, "size": options.font_size, "small": options.small_font_size}
    inches = tuple(round(float(side), 3) for side in figure.get_size_inches())
    places = [spec for ax in figure.axes[: len(panels)] if (spec := ax.get_subplotspec())]
    columns = max(spec.get_topmost_subplotspec().colspan.stop for spec in places)
    shared: dict[str, Any] = settings | {"inches": inches, "columns": columns, "rows": -(-len(panels) // columns)}
    head = script_templates.SCRIPT_HEADER.format(**shared)
    if kind is CurvePlot:
        plots = [panel for panel in panels if isinstance(panel, CurvePlot)]
        looks = {s.label: (s.style.color, s.style.marker, s.style.dash) for panel in plots for s in panel.series}
        return head + script_templates.CURVE_TEMPLATE.format(
            looks=_format_literal(looks), panels=_format_literal(dict(map(_describe_panel, plots))), **shared
        )
    if kind is CellMap:
        grids = [panel for panel in panels if isinstance(panel, CellMap)]
        outcomes = {one.label: one.color for one in grids[0].outcomes}
        return head + script_templates.CELL_MAP_TEMPLATE.format(outcomes=_format_literal(outcomes), **shared)
    pictures = [panel for panel in panels if isinstance(panel, MeshPicture)]
    titles = {":".join((*panel.group, *panel.name)): panel.title for panel in pictures}
    return head + script_templates.MESH_TEMPLATE.format(
        titles=_format_literal(titles), limit=pictures[0].strain_limit, **shared
    )


def _describe_panel(panel: CurvePlot) -> tuple[str, dict[str, Any]]:
    """Describe the properties of a panel that a script needs, except its points."""
    axes = {
        key: {"words": scale.label, "scale": _MATPLOTLIB_SCALES[scale.division], "names": list(scale.place_names)}
        for key, scale in (("x", panel.x), ("y", panel.y))
    }
    curves = {
        (one.label, one.setting): {
            "is_stepped": one.is_stepped,
            "is_connected": one.is_connected,
            "is_horizontal": one.is_horizontal,
        }
        for one in panel.series
    }
    lines, x_lines = ([line.value for line in some] for some in (panel.lines, panel.x_lines))
    whole = " ".join(filter(None, (panel.subject, panel.title)))
    how: dict[str, Any] = {"curves": curves, "lines": lines, "x_lines": x_lines}
    return ":".join((*panel.group, *panel.name)), {"title": whole, **axes, **how}


_MATPLOTLIB_SCALES = {"log": "log", "sizes": "log", "linear": "linear", "iterations": "symlog", "names": "linear"}


def _format_literal(what: object) -> str:
    return pformat(what, width=110, sort_dicts=False)


def figure_size_mm(figure: Figure) -> tuple[float, float]:
    """Return width and height [mm]."""
    across, up = figure.get_size_inches()
    return float(across) * MILLIMETRES_PER_INCH, float(up) * MILLIMETRES_PER_INCH
