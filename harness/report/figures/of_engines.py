"""Comparison with external engines by Pareto fronts, one panel per mesh.

The front of a program is taken over all its settings.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harness.report.accuracy.engines import OURS, fronts, marks, met
from harness.report.accuracy.measured import WorkPoint, by_self_converged, older
from harness.report.accuracy.reading import read
from harness.report.figures.entry import Entry, ready
from harness.report.figures.panel import Plot, Scale, Series
from harness.report.page import quantity
from harness.report.style import OLDER, Mark

_NOTE = (
    "Each line is what no other setting of the same program beats in both time and error; "
    f"{OURS}: of all its methods that were tried. Errors are of positions, relative to the "
    "way from the start; those of 100 % and more are left out."
)


def engines(folder: Path) -> list[Entry]:
    """Build a panel for each mesh with runs of both engines and own methods."""
    table = read(folder)
    looks = marks(table.works)
    plots: list[Plot] = []
    for mesh, here in met(table.works).items():
        one = here[0]
        best = fronts(here)
        hollow = [OLDER] if any(older(work) for front in best.values() for work in front) else []
        plots.append(
            Plot(
                *(("engines",), (one.scene, str(one.size)), "", f"{mesh}, {quantity(one.horizon)} s"),
                Scale("wall time a simulated second", "log", "time"),
                Scale("error at the end", "log", "percent"),
                [_series(name, looks[name], front) for name, front in best.items() if front],
                notes=[_NOTE, *by_self_converged(here), *hollow],
                machine=", ".join(table.machine),
            )
        )
    return ready(plots)


def _series(name: str, look: Mark, front: list[WorkPoint]) -> Series:
    x, y = np.array([work.seconds for work in front]), np.array([work.error for work in front])
    setting = "; ".join(work.setting for work in front)
    return Series(name, look, x, y, older=np.array([older(work) for work in front]), setting=setting)
