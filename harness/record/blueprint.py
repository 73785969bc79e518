"""What is seen when a recording is opened: the mesh and its colour scale beside plots by frame, and the run."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from harness.record.base import RecordingInfo
from harness.record.shading import palette

BACKGROUND = (38, 40, 46)
_DIRECTION = np.array([0.62, 0.38, 0.78])
"""From where the camera looks: a little from above and from the side, y is up."""

_HALF_VIEW = math.tan(math.radians(55 / 2))
"""The viewer's angle of view is 55 degrees, from bottom to top."""

COLOURS = (0xE69F00FF, 0x56B4E9FF, 0x009E73FF, 0xCC79A7FF, 0xF0E442FF, 0xD55E00FF, 0x0072B2FF, 0x999999FF)
"""Of the lines of a plot: the palette of Okabe and Ito, told apart by the colour-blind; clear on black first."""


def spring_cadence(info: RecordingInfo) -> int:
    """Springs are drawn in the frames that this number divides: in all where they are few, else so rarely that
    they cost about 2.5 bytes a vertex and frame; vertices cost 15."""
    return 1 if len(info.springs) <= 1024 else 10 * math.ceil(len(info.springs) / len(info.mesh.rest))


def application(info: RecordingInfo) -> str:
    """The viewer keeps one layout for each application: one for each scene, so that its camera fits."""
    return f"springbench {info.properties.get('scene', info.title)}"


def scale_name(strain_range: float) -> str:
    """The colour scale in words."""
    percent = f"{100 * strain_range:g} %"
    return f"Strain: blue = compressed {percent} or more, grey = at rest, orange = stretched {percent} or more"


def scale_image() -> NDArray[np.uint8]:
    """The colour scale as a strip from compressed (left) to stretched (right), shape (24, 65 * 12, 3)."""
    return np.tile(np.repeat(palette()[:-1, :3], 12, axis=0), (24, 1, 1))


class Box:
    """The box that the positions stay in, for the camera; it begins with those at rest."""

    def __init__(self, rest: NDArray[np.floating]) -> None:
        self._low, self._high = rest.min(axis=0), rest.max(axis=0)
        self._limit = 10 * np.linalg.norm(self._high - self._low)

    def add(self, p: NDArray[np.floating]) -> None:
        """Widen the box to positions (n, 3) [m], unless they have blown up beyond showing."""
        low, high = np.minimum(self._low, p.min(axis=0)), np.maximum(self._high, p.max(axis=0))
        if np.linalg.norm(high - low) <= self._limit:
            self._low, self._high = low, high

    def eye(self, aspect: float = 1.0) -> rrb.EyeControls3D:
        """An orbiting eye that just sees the whole box in a view of this width / height."""
        centre, half = (self._low + self._high) / 2, (self._high - self._low) / 2
        corners = half * np.array(list(itertools.product((-1, 1), repeat=3)))
        towards = _DIRECTION / np.linalg.norm(_DIRECTION)
        right = np.cross((0, 1, 0), towards) / np.linalg.norm(np.cross((0, 1, 0), towards))
        x, y, z = np.stack([right, np.cross(towards, right), towards]) @ corners.T
        distance = 1.05 * np.max(z + np.maximum(np.abs(x) / aspect, np.abs(y)) / _HALF_VIEW) or 1.0
        kind, eye = rrb.Eye3DKind.Orbital, centre + distance * towards
        return rrb.EyeControls3D(kind=kind, position=eye, look_target=centre, eye_up=(0, 1, 0))


def scene_view(root: str, name: str, box: Box, *, springs_visible: bool, aspect: float = 1.0) -> rrb.Spatial3DView:
    """The mesh under `root`/scene; its springs are there to be switched on."""
    springs = f"{root}/scene/springs"
    return rrb.Spatial3DView(
        origin=f"{root}/scene",
        name=name,
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=box.eye(aspect),
        overrides={springs: rrb.EntityBehavior(visible=springs_visible)},
    )


def scale_view(strain_range: float, origin: str = "/legend") -> rrb.Spatial2DView:
    """The strip of colours."""
    return rrb.Spatial2DView(origin=origin, name=scale_name(strain_range), background=BACKGROUND)


def plot(name: str, contents: Sequence[str], *, legend: bool = True) -> rrb.TimeSeriesView:
    """One plot of everything under the given paths."""
    corner = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend)
    return rrb.TimeSeriesView(origin="/", contents=list(contents), name=name, plot_legend=corner)


def blueprint(info: RecordingInfo, box: Box) -> rrb.Blueprint:
    """The layout of one recording."""
    series = rrb.Vertical(
        plot("Energy [J]", ["+ /energy/**"]),
        plot("log10 of the residual [J^(1/2)]", ["+ /residual/log10"], legend=False),
        plot("Largest strain of a spring", ["+ /strain/largest"], legend=False),
        plot("Milliseconds by phase", ["+ /milliseconds/**"]),
        name="By frame",
    )
    convergence = rrb.Vertical(
        plot("log10 of the residual [J^(1/2)] by iteration", ["+ /convergence/log10_residual/**"]),
        plot("Objective [J] by iteration", ["+ /convergence/objective/**"]),
        name="Convergence (choose timeline: iteration)",
    )
    run = rrb.TextDocumentView(origin="/run", name="Run and machine")
    tabs = (_solve(),) if info.iterates else (series, convergence)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                scene_view("", info.title, box, springs_visible=not len(info.mesh.triangles)),
                scale_view(info.strain_range),
                row_shares=[9, 1],
            ),
            rrb.Tabs(*tabs, run, active_tab=0),
            column_shares=[3, 2],
        ),
        *panels(info.time_step, "iteration" if info.iterates else "frame"),
        auto_views=False,
    )


def _solve() -> rrb.Vertical:
    """The plots of a solve, by the number of the iterate."""
    return rrb.Vertical(
        plot("log10 of the energy gap and of the stationarity, relative to the current positions", ["+ /solve/**"]),
        plot("Energy [J]", ["+ /energy/**"]),
        plot("Largest strain of a spring", ["+ /strain/largest"], legend=False),
        name="By iteration",
    )


def run_document(info: RecordingInfo) -> str:
    """The run and its machine as Markdown."""
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
        "are switched on by the eye in the blueprint panel. On the timeline `iteration` the scene "
        "stands at its last frame.\n"
    )
    return f"# {info.title}\n\n| | |\n|-|-|\n{rows}\n\n{colours}{hint}"


def panels(time_step: float, timeline: str = "frame") -> tuple[rrb.TimePanel, rrb.SelectionPanel, rrb.BlueprintPanel]:
    """Time by frame or iteration, played in real time as far as a screen can show it; nothing else in the way."""
    fps = math.ceil(min(max(1 / time_step, 1.0), 120.0))
    time = rrb.TimePanel(state="collapsed", timeline=timeline, fps=fps)
    return time, rrb.SelectionPanel(state="hidden"), rrb.BlueprintPanel(state="hidden")
