# pyright: reportUnknownMemberType=false
# PyVista's filters and meshes are only partly typed.
"""Shaded renderings of recorded frames.

They show a surface or tubes coloured by strain, pinned vertices, and a soft shadow. All frames of a run share one
camera, so that apparent motion is that of the scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter
from pyvista.plotting import Plotter  # imported here, so that processes that draw inherit it
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.recording.strain_scale import PIN_COLOUR
from springbench.harness.report import opengl_probe
from springbench.harness.report.obstacle_meshes import build_obstacle_meshes
from springbench.harness.report.page_layout import STRAIN_MAP
from springbench.harness.report.plot_style import BACKGROUND_COLOUR, TEXT_COLOUR
from springbench.harness.report.recorded_strain import compute_spring_strain, compute_vertex_strain, mean_rest_length

PointArray = NDArray[np.floating]
ColouredPoints = tuple[PointArray, str]
_HALF_FIELD_OF_VIEW = np.radians(12.0)  # vertical; narrow, so that perspective distortion is small
_VIEW_MARGIN = 0.06  # of the view, left free at each side
_MAX_TUBES = 20_000  # springs; beyond that they are drawn as lines
_PIXELS_PER_VERTEX = 350  # pixels of the view for each vertex; with fewer, lines would hide the colours
_SUPERSAMPLING = 3  # a pixel is the mean of 3 x 3: faster than VTK's own anti-aliasing in software
_JOINT_COLOUR = "#8a8d92"  # vertices of a network without triangles
_OBSTACLE_COLOUR = "#c9c3b8"  # obstacles
_SHADOW_COLOUR = "#d3d0ca"  # where the ground is fully in shadow
_MATERIAL_OPTIONS: dict[str, Any] = {"ambient": 0.62, "diffuse": 0.44, "specular": 0.06, "specular_power": 18.0}


@dataclass(frozen=True, slots=True, eq=False)
class FittedCamera:
    """A camera with y up.

    Attributes:
        position: position of the camera (3,) [m].
        target: focal point (3,) [m].
        ground_height: height of the plane that receives the shadow [m].
        box_low: lower corner of the box of all framed points (3,) [m].
        box_high: upper corner of that box (3,) [m].
    """

    position: PointArray
    target: PointArray
    ground_height: float
    box_low: PointArray
    box_high: PointArray

    def scale_view(self, factor: float) -> FittedCamera:
        """Return the view of a scene whose coordinates are multiplied by `factor`."""
        return FittedCamera(
            factor * self.position,
            factor * self.target,
            factor * self.ground_height,
            factor * self.box_low,
            factor * self.box_high,
        )

    def select_nearby(self, p: PointArray) -> PointArray:
        """Return the points (n, 3) in the box or within its diagonal of it.

        If there are none, all points are returned.
        """
        around = _box_diagonal(np.stack([self.box_low, self.box_high]))
        inside = ((p >= self.box_low - around) & (p <= self.box_high + around)).all(axis=1)
        return p[inside] if inside.any() else p


def choose_view_angles(points: PointArray, areas: PointArray) -> tuple[float, float]:
    """Choose azimuth and elevation [degrees] of a three-quarter view.

    Args:
        points: points (q, 3), y up.
        areas: area vectors (f, 3) of the triangles; of the four corner views the one that shows most area is chosen.
    """
    x, y, z = np.ptp(points, axis=0)
    corner = 32.0 if x >= z else 58.0
    elevation = 8.0 + 12.0 * min(2.0 * min(x, z) / max(x, y, z, 1e-30), 1.0)

    def measure_shown_area(azimuth: float) -> float:
        # The front view gets a bonus, so that the choice between similar views does not depend on round-off.
        return float(np.abs(areas @ _view_direction(azimuth, elevation)).sum()) * (1.05 if azimuth == corner else 1.0)

    return max((corner, -corner, 180.0 - corner, corner - 180.0), key=measure_shown_area), elevation


def compute_area_vectors(replay: RecordingReplay, frame: int) -> PointArray:
    """Compute half the cross product of two edges of each triangle [m^2], shape (f, 3).

    Args:
        replay: recording with triangles (f, 3).
        frame: index of a recorded frame; -1 is the last.
    """
    p = replay.positions[frame].astype(np.float64)
    a, b, c = (p[corner] for corner in replay.triangles.T)
    return np.cross(b - a, c - a) / 2.0


def _view_direction(azimuth: float, elevation: float) -> PointArray:
    """Return the unit vector from the scene to the viewer at these angles [degrees]."""
    azimuth, elevation = np.radians(azimuth), np.radians(elevation)
    level = np.cos(elevation)
    return np.array([np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level])


def fit_camera(points: PointArray, *, aspect: float, angles: tuple[float, float]) -> FittedCamera:
    """Compute the closest camera that sees all points.

    A point with camera coordinates (a, b, c), c towards the viewer, is visible from (ea, eb, ec) if

        |a - ea| <= tan (ec - c),

    and likewise for b. Each pair of bounds is tight at one ec; the larger ec sees all points.

    Args:
        points: points (q, 3) [m].
        aspect: width / height of the view.
        angles: azimuth and elevation [degrees] of the viewer.
    """
    axes = _camera_axes(angles)
    ground = _ground_height(points)
    a, b, c = axes @ np.concatenate([points, _project_shadow(points, ground)]).astype(np.float64).T
    tan = (1.0 - 2.0 * _VIEW_MARGIN) * np.tan(_HALF_FIELD_OF_VIEW)
    eye, distance = np.zeros(3), 0.0
    for k, (side, slope) in enumerate([(a, aspect * tan), (b, tan)]):
        above, below = (side + slope * c).max(), (slope * c - side).max()
        eye[k] = (above - below) / 2.0
        distance = max(distance, (above + below) / (2.0 * slope))
    middle = (c.min() + c.max()) / 2.0
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    eye[2] = max(distance, middle + 1e-3 * (float(np.linalg.norm(high - low)) or 1.0))
    return FittedCamera(eye @ axes, np.array([eye[0], eye[1], middle]) @ axes, ground, low, high)


def _camera_axes(angles: tuple[float, float]) -> PointArray:
    """Return the directions right, up and towards the viewer as rows (3, 3)."""
    towards = _view_direction(*angles)
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _ground_height(points: PointArray) -> float:
    """Return the height [m] of the plane that receives the shadow of points (q, 3)."""
    return float(points[:, 1].min() - 0.02 * _box_diagonal(points))


def view_aspect(points: PointArray, angles: tuple[float, float]) -> float:
    """Return width / height of points and their shadow, seen from far away.

    Args:
        points: points (q, 3) [m], with y up.
        angles: azimuth and elevation [degrees] of the viewer.
    """
    whole = np.concatenate([points, _project_shadow(points, _ground_height(points))])
    across, up, _ = np.ptp(_camera_axes(angles) @ whole.astype(np.float64).T, axis=1)
    return float(across / max(up, 1e-30))


def _box_diagonal(p: PointArray) -> float:
    """Return the diagonal of the points' bounding box [m], at least 1e-30."""
    return max(float(np.linalg.norm(np.ptp(p, axis=0).astype(np.float64))), 1e-30)


def _project_shadow(p: PointArray, ground: float) -> PointArray:
    """Project points (q, 3) onto the ground along the light from the upper left."""
    fall = p[:, 1] - ground
    return np.stack([p[:, 0] + 0.18 * fall, np.full(len(p), ground), p[:, 2] - 0.22 * fall], axis=1)


def _is_closed(triangles: NDArray[np.int64]) -> bool:
    """Return whether every edge has two triangles.

    Such surfaces bound a solid and get sharp edges.
    """
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges @ [triangles.max() + 1, 1], return_counts=True)[1] == 2).all())


def _make_spheres(at: PointArray, radius: float) -> pv.PolyData:
    """Make a sphere at each point (q, 3)."""
    ball = pv.Sphere(radius=radius, theta_resolution=16, phi_resolution=12)
    return cast(pv.PolyData, pv.PolyData(at).glyph(geom=ball, orient=False, scale=False))


class _SceneSizes(NamedTuple):
    """Diagonal of the framed box and mean rest length, in picture units."""

    extent: float
    spacing: float


class OffscreenRenderer:
    """One off-screen window, reused for all frames; a context manager.

    Args:
        width: width of the pictures [pixels].
        height: height of the pictures [pixels].
        mesh_lines: pixels per vertex from which on mesh lines are drawn.
        background: background colour; None for a transparent background without a shadow.

    Attributes:
        was_opened: whether this process has opened a window.

    Raises:
        RunFailed: if the system cannot draw.
    """

    was_opened: ClassVar[bool] = False

    def __init__(
        self,
        width: int,
        height: int,
        *,
        mesh_lines: int = _PIXELS_PER_VERTEX,
        background: str | None = BACKGROUND_COLOUR,
    ) -> None:
        opengl_probe.require_opengl()
        OffscreenRenderer.was_opened = True
        self._mesh_lines, self._page = mesh_lines, background
        self._pixels, self._height = width * height, height
        size = [_SUPERSAMPLING * width, _SUPERSAMPLING * height]
        self._plotter = Plotter(off_screen=True, window_size=size, lighting="none")
        self._plotter.background_color = pv.Color(background or "white")
        self._plotter.disable_anti_aliasing()
        # Lights are attached to the camera (key light at the upper left), so that all views are lit alike; the fill
        # light preserves the colours of the scale.
        for place, strength in (((-1.2, 1.5, 1.6), 0.7), ((0.6, -0.5, 2.0), 0.55)):
            light = pv.Light(position=place, intensity=strength, light_type="camera light")
            self._plotter.add_light(light)

    def __enter__(self) -> OffscreenRenderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._plotter.close()

    def render_frame(
        self,
        replay: RecordingReplay,
        frame: int,
        view: FittedCamera,
        extra_solids: Sequence[pv.PolyData] = (),
        coloured_points: Sequence[ColouredPoints] = (),
    ) -> NDArray[np.uint8]:
        """Render a recorded frame, which must be finite.

        Args:
            replay: recording.
            frame: index among the recorded frames.
            view: camera.
            extra_solids: solids that are drawn in addition to the obstacles.
            coloured_points: pairs of points (q, 3) and their colour.

        Returns:
            Pixels (height, width, 3), or 4 channels without a background.
        """
        plotter = self._plotter
        plotter.suppress_rendering = True  # otherwise the scene is rendered again with each mesh that is added
        plotter.clear_actors()
        # Scaling by a power of two is exact: scenes of all sizes render alike, and scenes of size 1 are unchanged.
        unit = 2.0 ** -round(math.log2(float(np.linalg.norm(view.position - view.target))))
        view = view.scale_view(unit)
        plotter.camera.position = tuple(view.position)
        plotter.camera.focal_point = tuple(view.target)
        plotter.camera.up = (0.0, 1.0, 0.0)
        plotter.camera.view_angle = 2.0 * np.degrees(_HALF_FIELD_OF_VIEW)
        p = np.ascontiguousarray(unit * replay.positions[frame].astype(np.float64), np.float32)
        sizes = _SceneSizes(_box_diagonal(view.select_nearby(p)), unit * mean_rest_length(replay))
        if self._page is not None:
            self._add_shadow(replay, p, view, sizes, self._page)
        if len(replay.triangles):
            self._add_surface(replay, frame, p)
        else:
            self._add_springs(replay, frame, p, sizes)
        self._add_points(replay, sizes, p[replay.pinned_vertices], PIN_COLOUR)
        for at, colour in coloured_points:
            self._add_points(replay, sizes, unit * at, colour)
        for solid in (*build_obstacle_meshes(replay, frame), *extra_solids):
            shape = solid.copy()
            shape.points = unit * np.asarray(solid.points, np.float64)
            plotter.add_mesh(shape, color=_OBSTACLE_COLOUR, smooth_shading=solid.n_cells > 6, **_MATERIAL_OPTIONS)
        plotter.reset_camera_clipping_range()
        plotter.suppress_rendering = False
        plotter.render()
        clear = self._page is None
        pixels = np.asarray(plotter.screenshot(None, return_img=True, transparent_background=clear))
        return np.asarray(Image.fromarray(pixels if clear else pixels[..., :3]).reduce(_SUPERSAMPLING))

    def _add_surface(self, replay: RecordingReplay, frame: int, p: NDArray[np.float32]) -> None:
        mesh = pv.PolyData.from_regular_faces(p, replay.triangles)
        mesh.point_data["strain"] = compute_vertex_strain(replay, frame)
        limit = replay.strain_range
        self._plotter.add_mesh(
            mesh,
            scalars="strain",
            cmap=STRAIN_MAP,
            clim=(-limit, limit),
            smooth_shading=True,
            split_sharp_edges=_is_closed(replay.triangles),
            feature_angle=50.0,
            **_MATERIAL_OPTIONS,
            show_edges=len(p) * self._mesh_lines <= self._pixels,
            edge_color=TEXT_COLOUR,
            edge_opacity=0.14,
            line_width=1.5,
            show_scalar_bar=False,
        )

    def _add_springs(self, replay: RecordingReplay, frame: int, p: NDArray[np.float32], sizes: _SceneSizes) -> None:
        m, radius = len(replay.springs), self._tube_radius(sizes)
        if not m:
            self._plotter.add_mesh(
                _make_spheres(p, 1.5 * radius), color=_JOINT_COLOUR, smooth_shading=True, **_MATERIAL_OPTIONS
            )
            return
        lines = pv.PolyData(p, lines=np.c_[np.full(m, 2), replay.springs].ravel())
        lines.cell_data["strain"] = compute_spring_strain(replay, frame)
        look: dict[str, Any] = {
            "scalars": "strain",
            "cmap": STRAIN_MAP,
            "clim": (-replay.strain_range, replay.strain_range),
            "show_scalar_bar": False,
            **_MATERIAL_OPTIONS,
        }
        if m > _MAX_TUBES:
            self._plotter.add_mesh(lines, line_width=1.5, **look)
            return
        tubes = cast(pv.PolyData, lines.tube(radius=radius, n_sides=12))
        self._plotter.add_mesh(tubes, smooth_shading=True, **look)
        self._plotter.add_mesh(
            _make_spheres(p, 1.5 * radius), color=_JOINT_COLOUR, smooth_shading=True, **_MATERIAL_OPTIONS
        )

    def _tube_radius(self, sizes: _SceneSizes) -> float:
        """Return the radius of a spring's tube.

        It is thin relative to its length and the scene, but at least about a pixel.
        """
        thin = min(0.07 * sizes.spacing, 0.007 * sizes.extent)
        return max(thin, 1.1 * sizes.extent / self._height)

    def _add_points(self, replay: RecordingReplay, sizes: _SceneSizes, at: PointArray, colour: str) -> None:
        if len(at):
            spaced = min(0.3 * sizes.spacing, 0.009 * sizes.extent)
            radius = max(spaced, 0.004 * sizes.extent, 0.0 if len(replay.triangles) else 2.2 * self._tube_radius(sizes))
            self._plotter.add_mesh(_make_spheres(at, radius), color=colour, smooth_shading=True, **_MATERIAL_OPTIONS)

    def _add_shadow(
        self, replay: RecordingReplay, p: NDArray[np.float32], view: FittedCamera, sizes: _SceneSizes, background: str
    ) -> None:
        """Add a soft shadow on the ground.

        The scene is projected from the light, as a blurred texture on an unlit plane.
        """
        ground = view.ground_height
        flat, near = (_project_shadow(points, ground)[:, [0, 2]] for points in (p, view.select_nearby(p)))
        centre = (near.min(axis=0) + near.max(axis=0)) / 2
        side = 1.5 * float(np.ptp(near, axis=0).max()) + 0.2 * sizes.extent
        pixels = 384
        at = ((flat - centre) / side + 0.5) * pixels
        stencil = Image.new("L", (pixels, pixels), 0)
        pen = ImageDraw.Draw(stencil)
        if len(replay.triangles):
            for corners in at[replay.triangles].reshape(-1, 6).tolist():
                pen.polygon(corners, fill=255)
        else:
            for ends in at[replay.springs].reshape(-1, 4).tolist():
                pen.line(ends, fill=255, width=3)
        dark = np.asarray(stencil.filter(ImageFilter.GaussianBlur(11)), np.float32)[..., None] / 255
        page, shade = (np.array(pv.Color(c).int_rgb, np.float32) for c in (background, _SHADOW_COLOUR))
        texture = pv.Texture((page + dark * (shade - page)).round().astype(np.uint8))
        plane = pv.Plane(center=(centre[0], ground, centre[1]), direction=(0, 1, 0), i_size=side, j_size=side)
        corner = (plane.points[:, [0, 2]] - centre) / side + 0.5
        plane.active_texture_coordinates = np.c_[corner[:, 0], 1.0 - corner[:, 1]].astype(np.float32)
        self._plotter.add_mesh(plane, texture=texture, lighting=False)
