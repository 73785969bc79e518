"""What is seen when a recording is opened: the mesh and its colour scale beside plots by frame, and the run."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from harness.mesh.base import Mesh
from harness.record.base import RecordingInfo
from harness.record.shading import palette

BACKGROUND = (38, 40, 46)
_DIRECTION = np.array([0.62, 0.38, 0.78])
"""From where the camera looks: a little from above and from the side, y is up."""


def spring_cadence(mesh: Mesh) -> int:
    """Springs are drawn in the frames that this number divides: in all where they are few, else so rarely that
    they cost about 2.5 bytes a vertex and frame; vertices cost 15."""
    return 1 if len(mesh.springs) <= 1024 else 10 * math.ceil(len(mesh.springs) / len(mesh.rest))


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


def camera(low: NDArray[np.float64], high: NDArray[np.float64]) -> rrb.EyeControls3D:
    """An orbiting eye that sees the box from `low` (3,) to `high` (3,) [m] as a whole."""
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low)) or 1.0
    eye = centre + 0.85 * size * _DIRECTION / np.linalg.norm(_DIRECTION)
    return rrb.EyeControls3D(kind=rrb.Eye3DKind.Orbital, position=eye, look_target=centre, eye_up=(0, 1, 0))


def scene_view(
    root: str, name: str, springs_visible: bool, low: NDArray[np.float64], high: NDArray[np.float64]
) -> rrb.Spatial3DView:
    """The mesh under `root`/scene; its springs are there to be switched on."""
    springs = f"{root}/scene/springs"
    return rrb.Spatial3DView(
        origin=f"{root}/scene",
        name=name,
        background=BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=camera(low, high),
        overrides={springs: rrb.EntityBehavior(visible=springs_visible)},
    )


def scale_view(strain_range: float, origin: str = "/legend") -> rrb.Spatial2DView:
    """The strip of colours."""
    return rrb.Spatial2DView(origin=origin, name=scale_name(strain_range), background=BACKGROUND)


def plot(name: str, contents: Sequence[str], corner: rrb.Corner2D = rrb.Corner2D.RightTop) -> rrb.TimeSeriesView:
    """One plot of everything under the given paths."""
    legend = rrb.PlotLegend(corner, visible=any("*" in path for path in contents))
    return rrb.TimeSeriesView(origin="/", contents=list(contents), name=name, plot_legend=legend)


def blueprint(info: RecordingInfo, low: NDArray[np.float64], high: NDArray[np.float64]) -> rrb.Blueprint:
    """The layout of one recording whose positions stay in the box from `low` to `high`, each (3,) [m]."""
    series = rrb.Vertical(
        plot("Energy [J]", ["+ /energy/**"]),
        plot("log10 of the residual [J^(1/2)]", ["+ /residual/log10"]),
        plot("Largest strain of a spring", ["+ /strain/largest"]),
        plot("Milliseconds by phase", ["+ /milliseconds/**"]),
        name="By frame",
    )
    convergence = rrb.Vertical(
        plot("log10 of the residual [J^(1/2)] by iteration", ["+ /convergence/log10_residual/**"]),
        plot("Objective [J] by iteration", ["+ /convergence/objective/**"]),
        name="Convergence (choose timeline: iteration)",
    )
    run = rrb.TextDocumentView(origin="/run", name="Run and machine")
    triangles = len(info.mesh.triangles) > 0
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                scene_view("", info.title, not triangles, low, high),
                scale_view(info.strain_range),
                row_shares=[9, 1],
            ),
            rrb.Tabs(series, convergence, run, active_tab=0),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline="frame", fps=_frames_per_second(info.time_step)),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def run_document(info: RecordingInfo) -> str:
    """The run and its machine as Markdown."""
    mesh = info.mesh
    facts = {
        "vertices": len(mesh.rest),
        "springs": len(mesh.springs),
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
        f"(`/scene/springs`, in each frame that {spring_cadence(mesh)} divides) "
        "are switched on by the eye in the blueprint panel.\n"
    )
    return f"# {info.title}\n\n| | |\n|-|-|\n{rows}\n\n{colours}{hint}"


def _frames_per_second(time_step: float) -> float:
    """Play in real time, as far as a screen can show it."""
    return math.ceil(min(max(1 / time_step, 1.0), 120.0))
