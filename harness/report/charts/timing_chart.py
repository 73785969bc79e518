"""Charts of a sweep's runs: times by size, and time against accuracy."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from springbench.harness.report.accuracy.size_scaling import fit_size_exponent
from springbench.harness.report.charts.chart_description import ChartAxis, ChartDescription, ChartFrame, ChartSeries
from springbench.harness.report.charts.figure_panels import AxisScale
from springbench.harness.report.charts.published_curves import add_published_curves, read_published_runs
from springbench.harness.report.number_format import format_count, shorten_words
from springbench.harness.report.plot_style import STALE_NOTE, SeriesStyle, assign_label_styles
from springbench.harness.report.timing_table import RunTimes, label_runs
from springbench.harness.results.published_set import PUBLISHED_FOLDER

_TIME_SCALE = AxisScale("wall time", "log", "time")
_STEP_AXIS = ChartAxis("step", _TIME_SCALE, "step", "a step")
_LEAST_AXIS = ChartAxis("least", _TIME_SCALE, "least", "the least step", is_on_sheets=False)
_STRAIN_AXIS = ChartAxis("max_strain", AxisScale("largest strain", "linear", "strain"), "strain", is_on_sheets=False)
_TIME_AXES = (
    _STEP_AXIS,
    ChartAxis("warm", _TIME_SCALE, "prepare", "preparing, warm"),
    ChartAxis("cold", _TIME_SCALE, "cold", "preparing, cold"),
    _LEAST_AXIS,
    ChartAxis("local", _TIME_SCALE, "local", "a local step", is_on_sheets=False),
    ChartAxis("global", _TIME_SCALE, "global", "a global step", is_on_sheets=False),
    ChartAxis("num_iterations", AxisScale("iterations a step", "linear", "plain"), "iterations", is_on_sheets=False),
    _STRAIN_AXIS,
)
_HOVER = (
    *(("vertices", "vertices"), ("size", "mesh size"), ("step", "a step"), ("least", "the least step")),
    *(("num_iterations", "iterations"), ("residual", "last residual, J^½"), ("max_strain", "largest strain")),
)
_MAX_FAILURE_NOTES, _REASON_LETTERS = 4, 90
"""Maximum number of sentences on failures in a frame, and of characters of a reason."""


def build_timing_chart(
    timed_runs: Sequence[RunTimes],
    stale_ids: Collection[str] = (),
    *,
    citations: Mapping[str, str | None] | None = None,
    machine_words: str = "",
) -> ChartDescription:
    """Build the chart of times by size, with a frame for each scene.

    Args:
        timed_runs: runs of a sweep; those that failed are stated in notes.
        stale_ids: ids of the runs that other code measured.
        citations: citation of the method of each solver.
        machine_words: provenance of the rows.
    """
    names = label_runs(timed_runs)
    styles = assign_label_styles((names[run.run_id], run.solver) for run in timed_runs)
    frames: list[ChartFrame] = []
    for scene in dict.fromkeys(run.scene for run in timed_runs):
        here = [run for run in timed_runs if run.scene == scene]
        timed = sorted((run for run in here if run.status == "ok" and run.vertices), key=lambda run: run.vertices or 0)
        if not timed:
            continue
        sizes = {run.vertices or 0 for run in timed}
        has_stale = any(run.run_id in stale_ids for run in timed)
        frames.append(
            ChartFrame(
                group=(scene,),
                name=(),
                subject=scene,
                title=f"{format_count(sizes.pop())} vertices" if len(sizes) == 1 else "",
                series=[*_build_series(here, timed, names, styles, stale_ids)],
                notes=[
                    "Median and quartiles of all steps.",
                    *_describe_powers(timed, names),
                    *([STALE_NOTE] if has_stale else []),
                    *_describe_failures(here, names),
                ],
            )
        )
    return ChartDescription(
        title="Time by size",
        note="Times of runs by the number of vertices; a point leads to its run.",
        frames=frames,
        x=(ChartAxis("vertices", AxisScale("vertices", "sizes", "plain")),),
        y=_TIME_AXES,
        hover=_HOVER,
        **_shared_fields(timed_runs, names, citations, machine_words),
    )


def build_compared_timing_chart(
    timed_runs: Sequence[RunTimes],
    stale_ids: Collection[str] = (),
    *,
    published: Path = PUBLISHED_FOLDER,
    **options: Any,
) -> ChartDescription:
    """Build the chart as `build_timing_chart` does, with published curves in grey behind one's own.

    Args:
        timed_runs: runs of a sweep.
        stale_ids: ids of the runs that other code measured.
        published: folder of the published set; without one nothing is added.
        **options: further arguments of `build_timing_chart`.
    """
    others = [
        build_timing_chart(runs, machine_words=words) for runs, words in read_published_runs(timed_runs, published)
    ]
    return add_published_curves(build_timing_chart(timed_runs, stale_ids, **options), others)


def build_run_accuracy_chart(
    timed_runs: Sequence[RunTimes],
    stale_ids: Collection[str] = (),
    *,
    citations: Mapping[str, str | None] | None = None,
    machine_words: str = "",
) -> ChartDescription:
    """Build the chart of step time against last residual, with a frame for each scene.

    Args:
        timed_runs: runs of a sweep.
        stale_ids: ids of the runs that other code measured.
        citations: citation of the method of each solver.
        machine_words: provenance of the rows.
    """
    names = label_runs(timed_runs)
    styles = assign_label_styles((names[run.run_id], run.solver) for run in timed_runs)
    frames: list[ChartFrame] = []
    for scene in dict.fromkeys(run.scene for run in timed_runs):
        here = [run for run in timed_runs if run.scene == scene and run.step is not None]
        here.sort(key=lambda run: run.vertices or 0)
        series = [*_build_series(here, here, names, styles, stale_ids, is_connected=False)]
        frames += [ChartFrame((scene,), (), scene, "", series)] if series else []
    return ChartDescription(
        title="Time and accuracy",
        note="Time of a step against the distance of its last iterate from a minimum: to the lower left is better.",
        frames=frames,
        x=(_STEP_AXIS, _LEAST_AXIS),
        y=(ChartAxis("residual", AxisScale("last residual, J^½", "log", "power"), "residual"), _STRAIN_AXIS),
        hover=_HOVER,
        **_shared_fields(timed_runs, names, citations, machine_words),
    )


def _build_series(
    here: Sequence[RunTimes],
    timed: Sequence[RunTimes],
    names: Mapping[str, str],
    styles: Mapping[str, SeriesStyle],
    stale_ids: Collection[str],
    *,
    is_connected: bool = True,
) -> Iterator[ChartSeries]:
    """Yield a series for each label.

    A cross marks its end if a run of a larger size failed.
    """
    for label in dict.fromkeys(names[run.run_id] for run in timed):
        own = [run for run in timed if names[run.run_id] == label]
        later = [run.status for run in here if names[run.run_id] == label and run.size > own[-1].size]
        yield ChartSeries(
            label,
            styles[label],
            {
                "vertices": [run.vertices for run in own],
                "size": [run.size for run in own],
                "step": _to_seconds(run.step for run in own),
                "step_low": _to_seconds(run.lower for run in own),
                "step_high": _to_seconds(run.upper for run in own),
                "warm": _to_seconds(run.warm for run in own),
                "cold": _to_seconds(run.cold for run in own),
                "least": _to_seconds(run.least for run in own),
                "local": _to_seconds(run.local for run in own),
                "global": _to_seconds(run.global_ for run in own),
                "num_iterations": [run.num_iterations for run in own],
                "residual": [run.residual for run in own],
                "max_strain": [run.max_strain for run in own],
            },
            description=own[0].scene,
            stale=[run.run_id in stale_ids for run in own],
            status=next((status for status in later if status != "ok"), "ok") if is_connected else "ok",
            is_connected=is_connected,
            identity=(own[0].solver, own[0].parameters_json or "{}", own[0].options_json),
            links={"runs": [run.run_id for run in own]},
        )


def _to_seconds(milliseconds: Iterable[float | None]) -> list[float | None]:
    return [None if value is None else 1e-3 * value for value in milliseconds]


def _describe_powers(timed: Sequence[RunTimes], names: Mapping[str, str]) -> list[str]:
    """Describe the fitted powers of the number of vertices; empty for too few sizes."""
    times: dict[str, dict[int, float]] = {}
    for run in timed:
        if run.vertices and run.step:
            times.setdefault(names[run.run_id], {})[run.vertices] = run.step
    powers = {label: fit_size_exponent(seconds) for label, seconds in times.items()}
    words = ", ".join(f"{label} n^{power:.1f}" for label, power in powers.items() if isfinite(power))
    return [f"Fitted powers of the vertices, {timed[0].scene}: {words}."] if words else []


def _describe_failures(here: Sequence[RunTimes], names: Mapping[str, str]) -> list[str]:
    """Describe the failed runs of a scene by status and reason."""
    causes: dict[str, list[str]] = {}
    for run in here:
        if run.status != "ok":
            reason = f", {shorten_words(' '.join(run.reason.split()), _REASON_LETTERS)}" if run.reason else ""
            causes.setdefault(run.status + reason, []).append(f"{names[run.run_id]} {run.size or ''}".rstrip())
    scene, more = here[0].scene, len(causes) - _MAX_FAILURE_NOTES
    notes = [f"× Failed on {scene} ({cause}): {', '.join(labels)}." for cause, labels in causes.items()]
    return [*notes[:_MAX_FAILURE_NOTES], *([f"Runs of {scene} failed for {more} more reasons."] if more > 0 else [])]


def _shared_fields(
    timed_runs: Sequence[RunTimes],
    names: Mapping[str, str],
    citations: Mapping[str, str | None] | None,
    machine_words: str,
) -> dict[str, Any]:
    sources = {names[run.run_id]: (citations or {}).get(run.solver) for run in timed_runs}
    return {
        "subject_key": "scene",
        "citations": {label: source for label, source in sources.items() if source},
        "machine_words": machine_words,
        "command": "springbench run CONFIG --rerun",
    }
