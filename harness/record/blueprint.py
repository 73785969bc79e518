"""Viewer layout of a recording: the mesh and its colour scale, plots by frame, and the run's metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from harness.record import curves
from harness.record.base import RecordingInfo
from harness.record.camera import Extent

BACKGROUND = (38, 40, 46)
_LEGEND = 1.2
"""Height of the space for a legend above a plot's data, relative to the height of the data."""
_LISTED = 1.6
"""Height of a plot with a legend relative to one without: five names fit at 800 pixels."""

Ends = Mapping[str, tuple[float, float]]

_SHARES = (-1.0, 1.0)
"""Value range where the values are unknown."""

COLOURS = (0xE69F00FF, 0x56B4E9FF, 0x009E73FF, 0xCC79A7FF, 0xF0E442FF, 0xD55E00FF, 0x0072B2FF, 0x999999FF)
"""Colours of a plot's lines: the colour-blind safe palette of Okabe and Ito, those clearest on black first."""


def spring_cadence(info: RecordingInfo) -> int:
    """Return the interval in frames at which the springs are recorded.

    It is 1 for at most 1024 springs. Otherwise it is chosen so that springs cost about 2.5 bytes per vertex and frame;
    the vertices themselves cost 15.
    """
    return 1 if len(info.springs) <= 1024 else 10 * math.ceil(len(info.springs) / len(info.mesh.rest))


def application(info: RecordingInfo) -> str:
    """Return the application name of a scene.

    The viewer stores one layout for each application; one for each scene makes the camera fit.
    """
    return f"springbench {info.properties.get('scene', info.title)}"


def scale_name(strain_range: float) -> str:
    """Return a description of the strain colour scale."""
    percent = f"{100 * strain_range:g} %"
    return f"Strain: blue = compressed {percent} or more, grey = at rest, orange = stretched {percent} or more"


def scene_view(root: str, name: str, box: Extent, *, springs_visible: bool) -> rrb.Spatial3DView:
    """Build the 3D view of the mesh under a root entity.

    Args:
      root: entity path above `/scene`.
      name: title of the view.
      box: extent of the positions, from which the camera is computed.
      springs_visible: whether springs are shown at first; forces are hidden at first.
    """
    shown: dict[Any, rrb.EntityBehavior] = {f"{root}/scene/springs": rrb.EntityBehavior(visible=springs_visible)}
    shown[f"{root}/scene/forces"] = rrb.EntityBehavior(visible=False)
    return rrb.Spatial3DView(
        origin=f"{root}/scene",
        name=", ".join([name, *box.outside()]),
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=box.eye(),
        overrides=shown,
    )


def plot(
    name: str, contents: Sequence[str], *, last: int, ends: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """Build a plot of all scalars under the given paths.

    Args:
      name: title of the plot.
      contents: entity queries.
      last: last frame shown.
      ends: smallest and largest value; if given, a legend is shown in a space of its own above the data.
    """
    corner = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=ends is not None)
    across = rrb.TimeRange(*(rrb.TimeRangeBoundary.absolute(seq=at) for at in (0, max(last, 1))))
    height = None
    if ends is not None and np.isfinite(ends).all() and ends[1] > ends[0]:
        height = rrb.ScalarAxis(range=(ends[0], ends[1] + _LEGEND * (ends[1] - ends[0])))
    axis = rrb.TimeAxis(view_range=across)
    return rrb.TimeSeriesView(
        origin="/", contents=list(contents), name=name, plot_legend=corner, axis_x=axis, axis_y=height
    )


def blueprint(info: RecordingInfo, box: Extent, last: int = 0, ends: Ends | None = None) -> rrb.Blueprint:
    """Build the viewer layout of one recording.

    Args:
      info: properties of the recording.
      box: extent of the positions, from which the camera is computed.
      last: last frame.
      ends: smallest and largest value of groups of scalars, by entity.
    """
    ends = ends or {}
    series = rrb.Vertical(
        plot(
            "Energies: change, by its largest",
            ["+ /energy_change/**"],
            last=last,
            ends=ends.get("/energy_change", _SHARES),
        ),
        plot("log10 residual [J^(1/2)]", ["+ /residual/log10"], last=last),
        plot("Largest strain of a spring", ["+ /strain/largest"], last=last),
        plot("Milliseconds by phase", ["+ /milliseconds/**"], last=last, ends=ends.get("/milliseconds", _SHARES)),
        row_shares=[_LISTED, 1.0, 1.0, _LISTED],
        name="By frame",
    )
    convergence = rrb.Vertical(
        curves.view("/curves/residual", "Residual [J^(1/2)] by iteration"),
        curves.view("/curves/objective", "Objective above its lowest [J] by iteration"),
        name="Convergence",
    )
    run = rrb.TextDocumentView(origin="/run", name="Run and machine")
    tabs = (_solve(last, ends),) if info.iterates else (series, convergence)
    return rrb.Blueprint(
        # In a grid, the viewer moves the plots below the mesh in windows higher than wide, such as a phone's.
        rrb.Grid(
            scene_view("", info.title, box, springs_visible=not len(info.mesh.triangles)),
            rrb.Tabs(*tabs, run, active_tab=0),
            column_shares=[3, 2],
        ),
        *panels(info.time_step, "iteration" if info.iterates else "frame"),
        auto_views=False,
    )


def _solve(last: int, ends: Ends) -> rrb.Vertical:
    """Build the plots of a solve by iteration number."""
    return rrb.Vertical(
        plot("log10 of gap and stationarity, relative", ["+ /solve/**"], last=last, ends=ends.get("/solve", _SHARES)),
        plot(
            "Energies: change, by its largest",
            ["+ /energy_change/**"],
            last=last,
            ends=ends.get("/energy_change", _SHARES),
        ),
        plot("Largest strain of a spring", ["+ /strain/largest"], last=last),
        row_shares=[1.0, _LISTED, 1.0],
        name="By iteration",
    )


def run_document(info: RecordingInfo) -> str:
    """Return the metadata of the run and its machine as Markdown."""
    mesh = info.mesh
    facts = {
        "vertices": len(mesh.rest),
        "springs": len(info.springs),
        "triangles": len(mesh.triangles),
        "pinned vertices": len(info.pinned),
        "time step": f"{info.time_step:g} s",
        "run": info.run_id,
        **info.properties,
    }
    rows = "\n".join(f"| {key} | `{value}` |" for key, value in facts.items())
    colours = f"## Colours\n\n{scale_name(info.strain_range)}.\n\n"
    hint = (
        "A vertex shows the strain of largest magnitude among its springs. The springs themselves "
        f"(`/scene/springs`, in each frame that {spring_cadence(info)} divides) "
        "and the forces on it (`/scene/forces`) are switched on by the eye in the blueprint panel, which the button "
        "at the top opens. On the timeline `iteration` the scene stands at its last frame.\n"
    )
    return f"# {info.title}\n\n| | |\n|-|-|\n{rows}\n\n{colours}{hint}"


def panels(time_step: float, timeline: str = "frame") -> tuple[rrb.TimePanel, rrb.SelectionPanel, rrb.BlueprintPanel]:
    """Build the panels, with a time panel that loops by frame or iteration.

    Playback is in real time as far as a screen can show it (1 to 120 frames per second).
    """
    fps = math.ceil(min(max(1 / time_step, 1.0), 120.0))
    time = rrb.TimePanel(state="collapsed", timeline=timeline, fps=fps, play_state="playing", loop_mode="all")
    return time, rrb.SelectionPanel(state="hidden"), rrb.BlueprintPanel(state="hidden")
