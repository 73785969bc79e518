"""Figures of every kind, composed of results of known looks, and how alike two pictures of them are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from skimage.measure import block_reduce
from skimage.metrics import structural_similarity
from springbench.harness.report.figures import figure_kinds
from springbench.harness.report.figures.figure_layout import compose_figure
from springbench.harness.report.figures.figure_options import FigureOptions
from springbench.harness.report.figures.panel_selection import select_entries

from tests import synthetic_results as made
from tests.synthetic_device_rows import write_device_results

EXPECTED_FOLDER = Path(__file__).parent / "looks"
PART_PIXELS, MIN_SIMILARITY = 24, 0.9
"""Pixels of the parts of a sheet that are compared, some four letters, and the structural similarity (Wang et al. 2004)
that parts of one look have: other rounding of grey edges leaves 0.98, and a curve of another colour 0.8 or less."""

MESH_FIGURE_KINDS = ("run", "comparison", "scenes")
"""Kinds whose pictures are drawn by the system, of the results `made.recorded`."""

FIGURE_SOURCES: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "convergence": ("block:gap", made.write_accuracy_results),
    "times": ("net:10:previous:alone", made.write_accuracy_results),
    "work": ("bdf2", made.write_accuracy_results),
    "winners": ("", made.write_winner_results),
    "profiles": ("performance:1e-3", made.write_accuracy_results),
    "growth": ("net:previous", made.write_accuracy_results),
    "liu2013": ("figure-2:iterations", made.write_accuracy_results),
    "timing": ("step", made.write_sweep_results),
    "hard": ("map", made.write_sweep_results),
    "ablation": ("", made.write_ablation_results),
    "prices": ("", made.write_ablation_results),
    "speed": ("step", made.write_speed_results),
    "history": ("", made.write_benchmark_history),
    "engines": ("", made.write_engine_results),
    "devices": ("0.001", write_device_results),
}


def compose_kind(kind: str, results: Path, options: FigureOptions, find_stale: Any = ()) -> tuple[Figure, list[Any]]:
    found = figure_kinds.find_figure_kind(kind)
    selectors = (
        options.selectors
        or tuple(tuple(one.split(":")) for one in [FIGURE_SOURCES[kind][0]] if one)
        or found.default_panels
    )
    panels = found.prepare_panels(select_entries(found.list_panels(results, lambda _: find_stale), selectors))
    return compose_figure(panels, found.title, options), panels


def compose_mesh_kind(kind: str, folder: Path, width: float = 60.0) -> tuple[Figure, list[Any]]:
    found = figure_kinds.find_figure_kind(kind)
    panels = found.prepare_panels(select_entries(found.list_panels(folder, lambda _: ()), ()))
    return compose_figure(panels, found.title, FigureOptions(width_mm=width)), panels


def render_figure(figure: Figure) -> Image.Image:
    agg = FigureCanvasAgg(figure)
    agg.draw()
    return Image.fromarray(np.asarray(agg.buffer_rgba())).convert("RGB")


def tile_figures(figures: Sequence[Figure], size: tuple[int, int]) -> Image.Image:
    """All figures in one image."""
    whole = Image.new("RGB", size, "white")
    x = y = 0
    for picture in map(render_figure, figures):
        if y + picture.height > size[1]:
            x, y = x + picture.width + 10, 0
        whole.paste(picture, (x, y))
        y += picture.height + 10
    return whole


def least_similarity(one: Image.Image, other: Image.Image) -> float:
    """Of the part of the pictures that differs most: the mean over a whole sheet would be that of its white."""
    found: Any = structural_similarity(np.asarray(one), np.asarray(other), channel_axis=-1, full=True)
    parts: Any = (PART_PIXELS, PART_PIXELS)
    return float(block_reduce(found[1].mean(axis=-1), parts, np.mean, cval=1).min())
