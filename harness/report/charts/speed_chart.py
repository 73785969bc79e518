"""Chart of a speed report: times, bandwidth, roofline fraction and speedup by size."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import AxisScale
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle, assign_label_styles
from springbench.harness.report.provenance_words import describe_provenance, is_stale
from springbench.harness.report.speed.speed_figures import STEP_ITERATIONS, SpeedFigures

_TIME_SCALE = AxisScale("wall time", "log", "time")
_AXES = (
    ChartAxis("step", _TIME_SCALE, "step", f"a step of {STEP_ITERATIONS} iterations"),
    ChartAxis("global", _TIME_SCALE, "global", "a global step: one solve, three right-hand sides"),
    ChartAxis("local", _TIME_SCALE, "local", "a local step"),
    ChartAxis("prepare", _TIME_SCALE, "prepare", "to prepare, warm"),
    ChartAxis("limit", AxisScale("part of the limit that binds an iteration", "linear", "percent"), "limit"),
    ChartAxis(
        "bandwidth",
        AxisScale("bytes a second that an iteration touches", "log", "power"),
        "bandwidth",
        is_on_sheets=False,
    ),
    ChartAxis(
        "speedup",
        AxisScale("times faster than the C++ baseline", "linear", "plain"),
        "speedup",
        is_on_sheets=False,
    ),
)


def build_speed_chart(
    candidates: Sequence[SpeedFigures],
    newest_fingerprint: str | None = None,
    citations: Mapping[str, str | None] | None = None,
) -> ChartDescription:
    """Build the chart, with a frame for each scene; candidates that failed are left out.

    Args:
        candidates: figures of all candidates.
        newest_fingerprint: code that measurements are compared with to find stale ones; None for the current version.
        citations: citation of the method of each solver.
    """
    timed = sorted((one for one in candidates if one.status == "ok"), key=lambda one: one.vertices)
    styles = assign_label_styles((one.label, one.solver) for one in timed)

    frames: list[ChartFrame] = []
    for scene in dict.fromkeys(one.scene for one in candidates if one.status == "ok"):
        here = [one for one in timed if one.scene == scene]
        stale = [is_stale(one.source_fingerprint, newest_fingerprint) for one in here]
        loads = sorted(one.load_average for one in here if one.load_average is not None)
        ends = list(dict.fromkeys(f"{load:.1f}" for load in (*loads[:1], *loads[-1:])))
        load = f"; load {' to '.join(ends)}" if ends else ""
        frames.append(
            ChartFrame(
                group=(scene,),
                name=(),
                subject=scene,
                title="",
                series=[*_build_series(here, styles, stale)],
                notes=[
                    f"Medians over the rounds, candidates interleaved{load}.",
                    *([STALE_NOTE] if newest_fingerprint is None and any(stale) else []),
                ],
            )
        )
    return ChartDescription(
        title="Speed and its limits",
        note="A limit is what the machine reads or computes at most, interleaved with the solvers; the baseline "
        "is the same method in C++ with Eigen.",
        frames=frames,
        x=(ChartAxis("vertices", AxisScale("vertices", "sizes", "plain")),),
        y=_AXES,
        subject_key="scene",
        hover=(
            *(("vertices", "vertices"), ("step", "a step"), ("global", "a global step")),
            *(("binding_limit", "limit that binds"), ("limit", "share of that limit reached")),
        ),
        machine_words=describe_provenance([one._asdict() for one in candidates]),
        citations={one.label: source for one in timed if (source := (citations or {}).get(one.solver))},
        command="springbench roofline CONFIG --rerun",
    )


def _build_series(
    timed: Sequence[SpeedFigures], styles: Mapping[str, SeriesStyle], stale: Sequence[bool]
) -> Iterator[ChartSeries]:
    for label in dict.fromkeys(one.label for one in timed):
        own = [(one, old) for one, old in zip(timed, stale, strict=True) if one.label == label]
        threads = own[0][0].threads
        columns: dict[str, Any] = {
            "vertices": [one.vertices for one, _ in own],
            "step": [_to_seconds(one.step) for one, _ in own],
            "global": [_to_seconds(one.global_) for one, _ in own],
            "local": [_to_seconds(one.local) for one, _ in own],
            "prepare": [_to_seconds(one.warm or one.cold) for one, _ in own],
            "limit": [one.roofline_fraction for one, _ in own],
            "bandwidth": [one.achieved_bandwidth for one, _ in own],
            "speedup": [one.speedup and one.speedup.estimate for one, _ in own],
            "speedup_low": [one.speedup and one.speedup.low for one, _ in own],
            "speedup_high": [one.speedup and one.speedup.high for one, _ in own],
            "binding_limit": [one.binding_limit for one, _ in own],
        }
        yield ChartSeries(
            label,
            styles[label],
            columns,
            description=f"{own[0][0].scene}, {threads} thread{'s' if threads > 1 else ''}",
            stale=[old for _, old in own],
        )


def _to_seconds(milliseconds: float | None) -> float | None:
    return None if milliseconds is None else 1e-3 * milliseconds
