"""Chart of external engines: the Pareto front of each program over all its settings."""

from __future__ import annotations

from itertools import chain

from springbench.harness.report.accuracy.accuracy_data import (
    AccuracyData,
    WorkPoint,
    describe_self_converged,
)
from springbench.harness.report.accuracy.engine_comparison import (
    OWN_PROGRAM,
    assign_program_styles,
    find_pareto_fronts,
    list_engine_meshes,
)
from springbench.harness.report.charts.accuracy_charts import (
    ACCURACY_COMMAND,
    COST_LABEL,
    ERROR_LABEL,
    describe_hollow_marks,
)
from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import AxisScale
from springbench.harness.report.number_format import format_quantity
from springbench.harness.report.plot_style import SeriesStyle
from springbench.harness.report.provenance_words import is_stale


def build_engine_chart(table: AccuracyData, newest_fingerprint: str | None = None) -> ChartDescription:
    """Build the chart, with a frame for each mesh on which engines were measured.

    Args:
        table: data of an accuracy measurement.
        newest_fingerprint: source fingerprint of the newest rows, others are stale; None for that of this version.
    """
    styles = assign_program_styles(table.work_points)
    frames: list[ChartFrame] = []
    for mesh, works in list_engine_meshes(table.work_points).items():
        fronts = {name: front for name, front in find_pareto_fronts(works).items() if front}
        frames.append(
            ChartFrame(
                group=("engines",),
                name=(works[0].scene, str(works[0].size)),
                subject=mesh,
                title=f"{format_quantity(works[0].t_end)} s",
                series=[_build_series(name, styles[name], front, newest_fingerprint) for name, front in fronts.items()],
                notes=[
                    "Each line is what no other setting of the same program beats in both time and error; "
                    f"{OWN_PROGRAM}: of all its methods that were tried. Errors of 100 % and more are left out.",
                    *(
                        *describe_self_converged(works),
                        *describe_hollow_marks(chain(*fronts.values()), newest_fingerprint),
                    ),
                ],
            )
        )
    return ChartDescription(
        title="Outside engines compared with springbench",
        note="springbench export-script CONFIG prints a script that repeats an engine's point without us.",
        frames=frames,
        x=(ChartAxis("seconds", AxisScale(COST_LABEL, "log", "time")),),
        y=(ChartAxis("error", AxisScale(ERROR_LABEL, "log", "percent")),),
        subject_key="scene",
        hover=(("setting", "setting"), ("error", "relative error"), ("seconds", COST_LABEL)),
        machine_words=", ".join(table.machine_words),
        command=ACCURACY_COMMAND,
    )


def _build_series(name: str, style: SeriesStyle, front: list[WorkPoint], newest_fingerprint: str | None) -> ChartSeries:
    settings = [work.setting_label for work in front]
    columns = {
        "seconds": [work.seconds_per_simulated_second for work in front],
        "error": [work.error for work in front],
        "setting": settings,
    }
    stale = [is_stale(work.source_fingerprint, newest_fingerprint) for work in front]
    return ChartSeries(name, style, columns, description=front[0].mesh_label, stale=stale, setting="; ".join(settings))
