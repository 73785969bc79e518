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
from typing import Any, NamedTuple, cast

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter

from harness.record.base import Replay
from harness.record.shading import PIN_COLOUR
from harness.report import opengl
from harness.report.solids import solids
from harness.report.style import INK, PAGE, STRAIN_MAP

Points = NDArray[np.floating]
Dots = tuple[Points, str]
_HALF_ANGLE = np.radians(12.0)  # of the camera's view, vertically: long enough a lens for calm perspective
_MARGIN = 0.06  # of the view, left free at each side
_TUBES = 20_000  # springs; beyond that they are drawn as lines
_MESH_LINES = 350  # pixels of the view for each vertex; with fewer, lines would hide the colours
_SUPERSAMPLING = 3  # a pixel is the mean of 3 x 3: faster than VTK's own anti-aliasing in software
_JOINT = "#8a8d92"  # vertices of a network without triangles
_SOLID = "#c9c3b8"  # obstacles
_SHADE = "#d3d0ca"  # where the ground is fully in shadow
_MATERIAL: dict[str, Any] = {"ambient": 0.62, "diffuse": 0.44, "specular": 0.06, "specular_power": 18.0}


def spring_strain(replay: Replay, frame: int) -> NDArray[np.float64]:
    """Compute the strain, length / rest length - 1, of each spring.

    Args:
        replay: recording.
        frame: index among the recorded frames.
    Returns: strains (m,); 0 where the rest length is 0.
    """
    i, j = replay.springs.T
    p = replay.positions[frame].astype(np.float64)
    rest = replay.rest_lengths
    stretch = np.linalg.norm(p[i] - p[j], axis=1) - rest
    return np.divide(stretch, rest, out=np.zeros(len(rest)), where=rest > 0)


def vertex_strain(replay: Replay, frame: int) -> NDArray[np.float64]:
    """Return the signed strain of the most strained spring at each vertex, shape (n,)."""
    strain = np.repeat(spring_strain(replay, frame), 2)
    ends = replay.springs.ravel()
    by_size = np.argsort(np.abs(strain))
    out = np.zeros(replay.positions.shape[1])
    out[ends[by_size]] = strain[by_size]  # the last write to a vertex, its largest strain, stays
    return out


def spacing(replay: Replay) -> float:
    """Return the mean rest length [m], or 1 if there are no springs."""
    return float(replay.rest_lengths.mean()) if len(replay.rest_lengths) else 1.0


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera with y up.

    Attributes:
        position: position of the camera (3,) [m].
        target: focal point (3,) [m].
        ground: height of the plane that receives the shadow [m].
        low: lower corner of the box of all framed points (3,) [m].
        high: upper corner of that box (3,) [m].
    """

    position: Points
    target: Points
    ground: float
    low: Points
    high: Points

    def scaled(self, by: float) -> View:
        """Return the view of a scene whose coordinates are multiplied by `by`."""
        return View(by * self.position, by * self.target, by * self.ground, by * self.low, by * self.high)

    def near(self, p: Points) -> Points:
        """Return the points (n, 3) in the box or within its diagonal of it.

        If there are none, all points are returned.
        """
        around = _extent(np.stack([self.low, self.high]))
        inside = ((p >= self.low - around) & (p <= self.high + around)).all(axis=1)
        return p[inside] if inside.any() else p


def natural_angles(points: Points, areas: Points) -> tuple[float, float]:
    """Choose azimuth and elevation [degrees] of a three-quarter view.

    Args:
        points: points (q, 3), y up.
        areas: area vectors (f, 3) of the triangles; of the four corner views the one that shows most area is chosen.
    """
    x, y, z = np.ptp(points, axis=0)
    corner = 32.0 if x >= z else 58.0
    elevation = 8.0 + 12.0 * min(2.0 * min(x, z) / max(x, y, z, 1e-30), 1.0)

    def shown(azimuth: float) -> float:
        # The front view gets a bonus, so that the choice between similar views does not depend on round-off.
        return float(np.abs(areas @ _towards(azimuth, elevation)).sum()) * (1.05 if azimuth == corner else 1.0)

    return max((corner, -corner, 180.0 - corner, corner - 180.0), key=shown), elevation


def area_vectors(replay: Replay, frame: int) -> Points:
    """Compute half the cross product of two edges of each triangle [m^2], shape (f, 3)."""
    p = replay.positions[frame].astype(np.float64)
    a, b, c = (p[corner] for corner in replay.triangles.T)
    return np.cross(b - a, c - a) / 2.0


def _towards(azimuth: float, elevation: float) -> Points:
    """Return the unit vector from the scene to the viewer at these angles [degrees]."""
    azimuth, elevation = np.radians(azimuth), np.radians(elevation)
    level = np.cos(elevation)
    return np.array([np.sin(azimuth) * level, np.sin(elevation), np.cos(azimuth) * level])


def frame_all(points: Points, *, aspect: float, angles: tuple[float, float]) -> View:
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
    ground = _ground(points)
    a, b, c = axes @ np.concatenate([points, _cast(points, ground)]).astype(np.float64).T
    tan = (1.0 - 2.0 * _MARGIN) * np.tan(_HALF_ANGLE)
    eye, distance = np.zeros(3), 0.0
    for k, (side, slope) in enumerate([(a, aspect * tan), (b, tan)]):
        above, below = (side + slope * c).max(), (slope * c - side).max()
        eye[k] = (above - below) / 2.0
        distance = max(distance, (above + below) / (2.0 * slope))
    middle = (c.min() + c.max()) / 2.0
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    eye[2] = max(distance, middle + 1e-3 * (float(np.linalg.norm(high - low)) or 1.0))
    return View(eye @ axes, np.array([eye[0], eye[1], middle]) @ axes, ground, low, high)


def _camera_axes(angles: tuple[float, float]) -> Points:
    """Return the directions right, up and towards the viewer as rows (3, 3)."""
    towards = _towards(*angles)
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _ground(points: Points) -> float:
    """Return the height [m] of the plane that receives the shadow of points (q, 3)."""
    return float(points[:, 1].min() - 0.02 * _extent(points))


def shape(points: Points, angles: tuple[float, float]) -> float:
    """Return width / height of points (q, 3) [m] and their shadow.

    They are seen from far away at these angles.
    """
    whole = np.concatenate([points, _cast(points, _ground(points))])
    across, up, _ = np.ptp(_camera_axes(angles) @ whole.astype(np.float64).T, axis=1)
    return float(across / max(up, 1e-30))


def _extent(p: Points) -> float:
    """Return the diagonal of the points' bounding box [m], at least 1e-30."""
    return max(float(np.linalg.norm(np.ptp(p, axis=0).astype(np.float64))), 1e-30)


def _cast(p: Points, ground: float) -> Points:
    """Project points (q, 3) onto the ground along the light from the upper left."""
    fall = p[:, 1] - ground
    return np.stack([p[:, 0] + 0.18 * fall, np.full(len(p), ground), p[:, 2] - 0.22 * fall], axis=1)


def _is_closed(triangles: NDArray[np.int64]) -> bool:
    """Return whether every edge has two triangles.

    Such surfaces bound a solid and get sharp edges.
    """
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges @ [triangles.max() + 1, 1], return_counts=True)[1] == 2).all())


def _balls(at: Points, radius: float) -> pv.PolyData:
    """Make a sphere at each point (q, 3)."""
    ball = pv.Sphere(radius=radius, theta_resolution=16, phi_resolution=12)
    return cast(pv.PolyData, pv.PolyData(at).glyph(geom=ball, orient=False, scale=False))


class _Sizes(NamedTuple):
    """Diagonal of the framed box and mean rest length, in picture units."""

    extent: float
    spacing: float


class Studio:
    """One off-screen window, reused for all frames; a context manager.

    Args:
        width: width of the pictures [pixels].
        height: height of the pictures [pixels].
        mesh_lines: pixels per vertex from which on mesh lines are drawn.
        background: background colour; None for a transparent background without a shadow.
    Raises:
        RunFailed: if the system cannot draw.
    """

    def __init__(
        self, width: int, height: int, *, mesh_lines: int = _MESH_LINES, background: str | None = PAGE
    ) -> None:
        opengl.require()
        self._mesh_lines, self._page = mesh_lines, background
        self._pixels, self._height = width * height, height
        size = [_SUPERSAMPLING * width, _SUPERSAMPLING * height]
        self._plotter = pv.Plotter(off_screen=True, window_size=size, lighting="none")
        self._plotter.background_color = pv.Color(background or "white")
        self._plotter.disable_anti_aliasing()
        # Lights are attached to the camera (key light at the upper left), so that all views are lit alike; the fill
        # light preserves the colours of the scale.
        for place, strength in (((-1.2, 1.5, 1.6), 0.7), ((0.6, -0.5, 2.0), 0.55)):
            light = pv.Light(position=place, intensity=strength, light_type="camera light")
            self._plotter.add_light(light)

    def __enter__(self) -> Studio:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._plotter.close()

    def draw(
        self, replay: Replay, frame: int, view: View, more: Sequence[pv.PolyData] = (), dots: Sequence[Dots] = ()
    ) -> NDArray[np.uint8]:
        """Render a recorded frame, which must be finite.

        Args:
            replay: recording.
            frame: index among the recorded frames.
            view: camera.
            more: solids that are drawn in addition to the obstacles.
            dots: pairs of points (q, 3) and their colour.
        Returns: pixels (height, width, 3), or 4 channels without a background.
        """
        plotter = self._plotter
        plotter.clear_actors()
        # Scaling by a power of two is exact: scenes of all sizes render alike, and scenes of size 1 are unchanged.
        unit = 2.0 ** -round(math.log2(float(np.linalg.norm(view.position - view.target))))
        view = view.scaled(unit)
        plotter.camera.position = tuple(view.position)
        plotter.camera.focal_point = tuple(view.target)
        plotter.camera.up = (0.0, 1.0, 0.0)
        plotter.camera.view_angle = 2.0 * np.degrees(_HALF_ANGLE)
        p = np.ascontiguousarray(unit * replay.positions[frame].astype(np.float64), np.float32)
        sizes = _Sizes(_extent(view.near(p)), unit * spacing(replay))
        if self._page is not None:
            self._shadow(replay, p, view, sizes, self._page)
        if len(replay.triangles):
            self._surface(replay, frame, p)
        else:
            self._springs(replay, frame, p, sizes)
        self._dots(replay, sizes, p[replay.pinned], PIN_COLOUR)
        for at, colour in dots:
            self._dots(replay, sizes, unit * at, colour)
        for solid in (*solids(replay, frame), *more):
            shape = solid.copy()
            shape.points = unit * np.asarray(solid.points, np.float64)
            plotter.add_mesh(shape, color=_SOLID, smooth_shading=solid.n_cells > 6, **_MATERIAL)
        plotter.reset_camera_clipping_range()
        plotter.render()
        clear = self._page is None
        pixels = np.asarray(plotter.screenshot(None, return_img=True, transparent_background=clear))
        return np.asarray(Image.fromarray(pixels if clear else pixels[..., :3]).reduce(_SUPERSAMPLING))

    def _surface(self, replay: Replay, frame: int, p: NDArray[np.float32]) -> None:
        mesh = pv.PolyData.from_regular_faces(p, replay.triangles)
        mesh.point_data["strain"] = vertex_strain(replay, frame)
        limit = replay.strain_range
        self._plotter.add_mesh(
            mesh,
            scalars="strain",
            cmap=STRAIN_MAP,
            clim=(-limit, limit),
            smooth_shading=True,
            split_sharp_edges=_is_closed(replay.triangles),
            feature_angle=50.0,
            **_MATERIAL,
            show_edges=len(p) * self._mesh_lines <= self._pixels,
            edge_color=INK,
            edge_opacity=0.14,
            line_width=1.5,
            show_scalar_bar=False,
        )

    def _springs(self, replay: Replay, frame: int, p: NDArray[np.float32], sizes: _Sizes) -> None:
        m, radius = len(replay.springs), self._tube(sizes)
        if not m:
            self._plotter.add_mesh(_balls(p, 1.5 * radius), color=_JOINT, smooth_shading=True, **_MATERIAL)
            return
        lines = pv.PolyData(p, lines=np.c_[np.full(m, 2), replay.springs].ravel())
        lines.cell_data["strain"] = spring_strain(replay, frame)
        look: dict[str, Any] = {
            "scalars": "strain",
            "cmap": STRAIN_MAP,
            "clim": (-replay.strain_range, replay.strain_range),
            "show_scalar_bar": False,
            **_MATERIAL,
        }
        if m > _TUBES:
            self._plotter.add_mesh(lines, line_width=1.5, **look)
            return
        tubes = cast(pv.PolyData, lines.tube(radius=radius, n_sides=12))
        self._plotter.add_mesh(tubes, smooth_shading=True, **look)
        self._plotter.add_mesh(_balls(p, 1.5 * radius), color=_JOINT, smooth_shading=True, **_MATERIAL)

    def _tube(self, sizes: _Sizes) -> float:
        """Return the radius of a spring's tube.

        It is thin relative to its length and the scene, but at least about a pixel.
        """
        thin = min(0.07 * sizes.spacing, 0.007 * sizes.extent)
        return max(thin, 1.1 * sizes.extent / self._height)

    def _dots(self, replay: Replay, sizes: _Sizes, at: Points, colour: str) -> None:
        if len(at):
            spaced = min(0.3 * sizes.spacing, 0.009 * sizes.extent)
            radius = max(spaced, 0.004 * sizes.extent, 0.0 if len(replay.triangles) else 2.2 * self._tube(sizes))
            self._plotter.add_mesh(_balls(at, radius), color=colour, smooth_shading=True, **_MATERIAL)

    def _shadow(self, replay: Replay, p: NDArray[np.float32], view: View, sizes: _Sizes, behind: str) -> None:
        """Add a soft shadow on the ground.

        The scene is projected from the light, as a blurred texture on an unlit plane.
        """
        ground = view.ground
        flat, near = (_cast(points, ground)[:, [0, 2]] for points in (p, view.near(p)))
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
        page, shade = (np.array(pv.Color(c).int_rgb, np.float32) for c in (behind, _SHADE))
        texture = pv.Texture((page + dark * (shade - page)).round().astype(np.uint8))
        plane = pv.Plane(center=(centre[0], ground, centre[1]), direction=(0, 1, 0), i_size=side, j_size=side)
        corner = (plane.points[:, [0, 2]] - centre) / side + 0.5
        plane.active_texture_coordinates = np.c_[corner[:, 0], 1.0 - corner[:, 1]].astype(np.float32)
        self._plotter.add_mesh(plane, texture=texture, lighting=False)
