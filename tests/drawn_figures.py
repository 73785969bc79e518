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

from harness.report.figures import kinds
from harness.report.figures.asked import Asked
from harness.report.figures.canvas import compose
from harness.report.figures.entry import chosen
from tests import figure_results as made

FOLDER = Path(__file__).parent / "looks"
PART, ALIKE = 24, 0.9
"""Pixels of the parts of a sheet that are compared, some four letters, and the structural similarity (Wang et al. 2004)
that parts of one look have: other rounding of grey edges leaves 0.98, and a curve of another colour 0.8 or less."""

MESHES = ("run", "comparison", "scenes")
"""Kinds whose pictures are drawn by the system, of the results `made.recorded`."""

RESULTS: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "convergence": ("block:gap", made.accuracy),
    "times": ("net:10:current:alone", made.accuracy),
    "work": ("bdf2", made.accuracy),
    "winners": ("", made.winners),
    "profiles": ("performance:1e-3", made.accuracy),
    "growth": ("net:current", made.accuracy),
    "liu2013": ("figure-2", made.accuracy),
    "timing": ("step", made.sweep),
    "hard": ("map", made.sweep),
    "ablation": ("", made.ablation),
    "prices": ("", made.ablation),
    "speed": ("step", made.speed),
    "history": ("", made.gates),
    "engines": ("", made.engines),
}


def composed(kind: str, results: Path, asked: Asked, older: Any = ()) -> tuple[Figure, list[Any]]:
    found = kinds.kind(kind)
    selectors = asked.selectors or tuple(tuple(one.split(":")) for one in [RESULTS[kind][0]] if one) or found.usual
    panels = found.draw(chosen(found.panels(results, lambda _: older), selectors))
    return compose(panels, found.title, asked), panels


def composed_meshes(kind: str, folder: Path, width: float = 60.0) -> tuple[Figure, list[Any]]:
    found = kinds.kind(kind)
    panels = found.draw(chosen(found.panels(folder, lambda _: ()), ()))
    return compose(panels, found.title, Asked(width=width)), panels


def pixels(figure: Figure) -> Image.Image:
    agg = FigureCanvasAgg(figure)
    agg.draw()
    return Image.fromarray(np.asarray(agg.buffer_rgba())).convert("RGB")


def sheet(figures: Sequence[Figure], size: tuple[int, int]) -> Image.Image:
    """All figures below and beside each other."""
    whole = Image.new("RGB", size, "white")
    x = y = 0
    for picture in map(pixels, figures):
        if y + picture.height > size[1]:
            x, y = x + picture.width + 10, 0
        whole.paste(picture, (x, y))
        y += picture.height + 10
    return whole


def similarity(one: Image.Image, other: Image.Image) -> float:
    """Of the part of the pictures that differs most: the mean over a whole sheet would be that of its white."""
    found: Any = structural_similarity(np.asarray(one), np.asarray(other), channel_axis=-1, full=True)
    parts: Any = (PART, PART)
    return float(block_reduce(found[1].mean(axis=-1), parts, np.mean, cval=1).min())
