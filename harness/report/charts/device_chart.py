"""Chart of device speedups: step times of device and processor against vertices.

There is a frame for each scene and residual. Each side is represented by its fastest run to the residual.
"""

from __future__ import annotations

from collections.abc import Sequence

from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import AxisScale, MarkedValue
from springbench.harness.report.device_speedup import (
    DevicePair,
    DeviceRun,
    ScenePanel,
    find_break_even,
    pair_fastest_runs,
)
from springbench.harness.report.plot_style import DASHED_LINE, FASTER_COLOUR, TEXT_COLOUR, SeriesStyle

_SIDE_STYLES = {
    "device": SeriesStyle(FASTER_COLOUR, "o"),
    "processor": SeriesStyle(TEXT_COLOUR, "s", DASHED_LINE),
}


def build_device_chart(device_runs: Sequence[DeviceRun]) -> ChartDescription:
    """Build the chart, without frames if no run on a device reached its residual.

    Args:
        device_runs: runs of a sweep.
    """
    return ChartDescription(
        title="What a device saves",
        note="Median time of a step, of the solver that is fastest to the residual on each side.",
        frames=[_build_frame(panel, compared) for panel, compared in pair_fastest_runs(device_runs).items()],
        x=(ChartAxis("vertices", AxisScale("vertices", "sizes", "plain")),),
        y=(ChartAxis("seconds", AxisScale("time of a step, of the fastest solver", "log", "time")),),
        hover=(("solver", "solver"), ("vertices", "vertices"), ("seconds", "seconds a step")),
        machine_words=", ".join(sorted({run.device for run in device_runs if run.device})),
        command="springbench run CONFIG",
    )


def _build_frame(panel: ScenePanel, compared: Sequence[DevicePair]) -> ChartFrame:
    scene, tolerance = panel
    sides = {"device": [pair.device_run for pair in compared], "processor": [pair.cpu_run for pair in compared]}
    first = find_break_even(compared)
    return ChartFrame(
        group=(scene,),
        name=(f"{tolerance:g}",),
        subject=scene,
        title=f"to a residual of {tolerance:g}",
        series=[_build_series(side, found) for side, runs in sides.items() if (found := [run for run in runs if run])],
        lines={"vertices": [MarkedValue(first.vertices, "")]} if first else {},
        notes=[
            "Names: the fastest solver of a side, where it changes.",
            *([f"{scene}: a device pays from the dashed line on."] if first else []),
        ],
    )


def _build_series(side: str, runs: Sequence[DeviceRun]) -> ChartSeries:
    solvers = [run.solver for run in runs]
    columns = {
        "vertices": [run.vertices for run in runs],
        "seconds": [run.seconds for run in runs],
        "solver": solvers,
    }
    changes = {k: name for k, name in enumerate(solvers) if k == 0 or name != solvers[k - 1]}
    return ChartSeries(side, _SIDE_STYLES[side], columns, callouts=changes)
