"""Figures of every kind, composed of results of known looks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from harness.report.figures import kinds
from harness.report.figures.asked import Asked
from harness.report.figures.canvas import compose
from harness.report.figures.entry import chosen
from tests import figure_results as made

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
    "prices": ("numba", made.ablation),
    "speed": ("step", made.speed),
    "history": ("", made.gates),
}


def composed(kind: str, results: Path, asked: Asked, older: Any = ()) -> tuple[Figure, list[Any]]:
    found = kinds.kind(kind)
    selectors = asked.selectors or tuple(tuple(one.split(":")) for one in [RESULTS[kind][0]] if one) or found.usual
    panels = found.draw(chosen(found.panels(results, lambda _: older), selectors))
    return compose(panels, found.title, asked), panels
