"""Comparison with external engines by Pareto fronts, one panel per mesh.

The front of a program is taken over all its settings.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import WorkPoint, describe_self_converged, is_stale
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.engine_comparison import (
    OWN_PROGRAM,
    assign_program_styles,
    meshes_with_engines,
    pareto_fronts,
)
from springbench.harness.report.figures.figure_panels import AxisScale, CurvePlot, CurveSeries
from springbench.harness.report.figures.panel_selection import PanelEntry, entries_from_panels
from springbench.harness.report.number_format import format_quantity
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle

_FRONT_NOTE = (
    "Each line is what no other setting of the same program beats in both time and error; "
    f"{OWN_PROGRAM}: of all its methods that were tried. Errors are of positions, relative to the "
    "way from the start; those of 100 % and more are left out."
)


def engine_panels(folder: Path) -> list[PanelEntry]:
    """Build a panel for each mesh with runs of both engines and own methods."""
    table = read_accuracy(folder)
    looks = assign_program_styles(table.work_points)
    plots: list[CurvePlot] = []
    for mesh, here in meshes_with_engines(table.work_points).items():
        one = here[0]
        best = pareto_fronts(here)
        hollow = [STALE_NOTE] if any(is_stale(work) for front in best.values() for work in front) else []
        plots.append(
            CurvePlot(
                *(("engines",), (one.scene, str(one.size)), "", f"{mesh}, {format_quantity(one.t_end)} s"),
                AxisScale("wall time a simulated second", "log", "time"),
                AxisScale("error at the end", "log", "percent"),
                [_build_series(name, looks[name], front) for name, front in best.items() if front],
                notes=[_FRONT_NOTE, *describe_self_converged(here), *hollow],
                machine_words=", ".join(table.machine_words),
            )
        )
    return entries_from_panels(plots)


def _build_series(name: str, style: SeriesStyle, front: list[WorkPoint]) -> CurveSeries:
    x, y = np.array([work.seconds_per_simulated_second for work in front]), np.array([work.error for work in front])
    setting = "; ".join(work.setting_label for work in front)
    return CurveSeries(name, style, x, y, stale=np.array([is_stale(work) for work in front]), setting=setting)
