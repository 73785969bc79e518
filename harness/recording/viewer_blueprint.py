"""Viewer layout of a recording: mesh with colour scale, plots by frame, and run metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb
from springbench.harness.recording import curve_drawing
from springbench.harness.recording.camera_view import ViewExtent
from springbench.harness.recording.recorder_interface import RecordingInfo

BACKGROUND = (38, 40, 46)
_LEGEND_HEIGHT = 1.2
"""Height of the space for a legend above a plot's data, relative to the height of the data."""
_LIST_HEIGHT_SHARE = 1.6
"""Height of a plot with a legend relative to one without: five names fit at 800 pixels."""

ValueRanges = Mapping[str, tuple[float, float]]

_SHARE_RANGE = (-1.0, 1.0)
"""Value range where the values are unknown."""

SERIES_COLOURS = (0xE69F00FF, 0x56B4E9FF, 0x009E73FF, 0xCC79A7FF, 0xF0E442FF, 0xD55E00FF, 0x0072B2FF, 0x999999FF)
"""Colours of a plot's lines: the colour-blind safe palette of Okabe and Ito, those clearest on black first."""


def compute_spring_interval(info: RecordingInfo) -> int:
    """Return the interval in frames at which the springs are recorded.

    It is 1 for at most 1024 springs. Otherwise it is chosen so that springs cost about 2.5 bytes per vertex and frame;
    the vertices themselves cost 15.
    """
    return 1 if len(info.springs) <= 1024 else 10 * math.ceil(len(info.springs) / len(info.mesh.rest_positions))


def format_application_id(info: RecordingInfo) -> str:
    """Return the application name of a scene.

    The viewer stores one layout for each application; one for each scene makes the camera fit.
    """
    return f"springbench {info.properties.get('scene', info.title)}"


def format_scale_name(strain_range: float) -> str:
    """Return a description of the strain colour scale."""
    percent = f"{100 * strain_range:g} %"
    return f"Strain: blue = compressed {percent} or more, grey = at rest, orange = stretched {percent} or more"


def build_scene_view(root: str, name: str, extent: ViewExtent, *, springs_visible: bool) -> rrb.Spatial3DView:
    """Build the 3D view of the mesh under a root entity.

    Args:
        root: entity path above `/scene`.
        name: title of the view.
        extent: extent of the positions, from which the camera is computed.
        springs_visible: whether springs are shown at first; forces are hidden at first.
    """
    shown: dict[Any, rrb.EntityBehavior] = {f"{root}/scene/springs": rrb.EntityBehavior(visible=springs_visible)}
    shown[f"{root}/scene/forces"] = rrb.EntityBehavior(visible=False)
    return rrb.Spatial3DView(
        origin=f"{root}/scene",
        name=", ".join([name, *extent.describe_outside()]),
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=extent.build_eye_controls(),
        overrides=shown,
    )


def build_plot(
    name: str, contents: Sequence[str], *, last: int, value_range: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """Build a plot of all scalars under the given paths.

    Args:
        name: title of the plot.
        contents: entity queries.
        last: last frame shown.
        value_range: smallest and largest value; if given, a legend is shown in a space of its own above the data.
    """
    corner = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=value_range is not None)
    across = rrb.TimeRange(*(rrb.TimeRangeBoundary.absolute(seq=at) for at in (0, max(last, 1))))
    height = None
    if value_range is not None and np.isfinite(value_range).all() and value_range[1] > value_range[0]:
        height = rrb.ScalarAxis(
            range=(value_range[0], value_range[1] + _LEGEND_HEIGHT * (value_range[1] - value_range[0]))
        )
    axis = rrb.TimeAxis(view_range=across)
    return rrb.TimeSeriesView(
        origin="/", contents=list(contents), name=name, plot_legend=corner, axis_x=axis, axis_y=height
    )


def build_blueprint(
    info: RecordingInfo, extent: ViewExtent, last: int = 0, value_ranges: ValueRanges | None = None
) -> rrb.Blueprint:
    """Build the viewer layout of one recording.

    Args:
        info: properties of the recording.
        extent: extent of the positions, from which the camera is computed.
        last: last frame.
        value_ranges: smallest and largest value of groups of scalars, by entity.
    """
    value_ranges = value_ranges or {}
    series = rrb.Vertical(
        build_plot(
            "Energies: change, by its largest",
            ["+ /energy_change/**"],
            last=last,
            value_range=value_ranges.get("/energy_change", _SHARE_RANGE),
        ),
        build_plot("log10 residual [J^(1/2)]", ["+ /residual/log10"], last=last),
        build_plot("Largest strain of a spring", ["+ /max_strain"], last=last),
        build_plot(
            "Milliseconds by phase",
            ["+ /milliseconds/**"],
            last=last,
            value_range=value_ranges.get("/milliseconds", _SHARE_RANGE),
        ),
        row_shares=[_LIST_HEIGHT_SHARE, 1.0, 1.0, _LIST_HEIGHT_SHARE],
        name="By frame",
    )
    convergence = rrb.Vertical(
        curve_drawing.build_curve_view("/curves/residual", "Residual [J^(1/2)] by iteration"),
        curve_drawing.build_curve_view("/curves/objective", "Objective above its lowest [J] by iteration"),
        name="Convergence",
    )
    run = rrb.TextDocumentView(origin="/run", name="Run and machine")
    tabs = (_build_solve_plots(last, value_ranges),) if info.is_solve else (series, convergence)
    return rrb.Blueprint(
        # A grid, because the viewer then moves the plots below the mesh in windows that are higher than wide.
        rrb.Grid(
            build_scene_view("", info.title, extent, springs_visible=not len(info.mesh.triangles)),
            rrb.Tabs(*tabs, run, active_tab=0),
            column_shares=[3, 2],
        ),
        *build_panels(info.time_step, "iteration" if info.is_solve else "frame"),
        auto_views=False,
    )


def _build_solve_plots(last: int, ends: ValueRanges) -> rrb.Vertical:
    """Build the plots of a solve by iteration number."""
    return rrb.Vertical(
        build_plot(
            "log10 of gap and stationarity, relative",
            ["+ /solve/**"],
            last=last,
            value_range=ends.get("/solve", _SHARE_RANGE),
        ),
        build_plot(
            "Energies: change, by its largest",
            ["+ /energy_change/**"],
            last=last,
            value_range=ends.get("/energy_change", _SHARE_RANGE),
        ),
        build_plot("Largest strain of a spring", ["+ /max_strain"], last=last),
        row_shares=[1.0, _LIST_HEIGHT_SHARE, 1.0],
        name="By iteration",
    )


def format_run_document(info: RecordingInfo) -> str:
    """Return the metadata of the run and its machine as Markdown."""
    mesh = info.mesh
    facts = {
        "vertices": len(mesh.rest_positions),
        "springs": len(info.springs),
        "triangles": len(mesh.triangles),
        "pinned vertices": len(info.pinned_vertices),
        "time step": f"{info.time_step:g} s",
        "run": info.run_id,
        **info.properties,
    }
    rows = "\n".join(f"| {key} | `{value}` |" for key, value in facts.items())
    colours = f"## Colours\n\n{format_scale_name(info.strain_range)}.\n\n"
    hint = (
        "A vertex shows the strain of largest magnitude among its springs. The springs themselves "
        f"(`/scene/springs`, in each frame that {compute_spring_interval(info)} divides) "
        "and the forces on it (`/scene/forces`) are switched on by the eye in the blueprint panel, which the button "
        "at the top opens. On the timeline `iteration` the scene stands at its last frame.\n"
    )
    return f"# {info.title}\n\n| | |\n|-|-|\n{rows}\n\n{colours}{hint}"


def build_panels(
    time_step: float, timeline: str = "frame"
) -> tuple[rrb.TimePanel, rrb.SelectionPanel, rrb.BlueprintPanel]:
    """Build the panels, with a time panel that loops by frame or iteration.

    Playback is in real time as far as a screen can show it (1 to 120 frames per second).

    Args:
        time_step: length of a frame [s].
        timeline: name of the timeline that is played, `frame` or `iteration`.
    """
    fps = math.ceil(min(max(1 / time_step, 1.0), 120.0))
    time = rrb.TimePanel(state="collapsed", timeline=timeline, fps=fps, play_state="playing", loop_mode="all")
    return time, rrb.SelectionPanel(state="hidden"), rrb.BlueprintPanel(state="hidden")
