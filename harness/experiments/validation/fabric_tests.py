# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# SciPy's and NumPy's stubs leave the types of some results unknown.
"""Textile tests of published fabrics, simulated: the cantilever test and Cusick's drape test.

Cantilever test (ASTM D1388): a strip is pushed over an edge until the line from the edge to its tip is 41.5 degrees
below the horizontal. The bending length c is half the overhang. The band follows from the smallest and largest measured
flexural rigidity B and the weight per area w: c = (B/w)^(1/3).

Drape test (BS 5058): a disc of 30 cm is clamped between discs of 18 cm. The drape coefficient is the shadow of the
annulus over its flat area. The band is that of Cusick's regression over woven fabrics (The dependence of fabric drape
on bending and shear stiffness, J. Text. Inst. 56(11), 1965), for the bending lengths above and shear angles A of 15 to
45 degrees:

    DC = 35.6 c - 3.61 c^2 - 2.59 A + 0.0461 A^2 + 17.0    [%], c in cm, A in degrees

The coefficients are those that textbooks quote; they were not compared with the paper.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.harness.experiments.validation.closed_forms import hang_strip
from springbench.harness.experiments.validation.validation_scenes import (
    GRAVITY,
    build_sheet,
    build_validation_scene,
    simulate_to_rest,
)
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.fabric_table import PublishedFabric
from springbench.harness.scenes.mesh.mesh_topology import lump_areas
from springbench.harness.scenes.orthotropic_cloth import OrthotropicStiffness
from springbench.harness.scenes.start_positions import PerturbedStart
from springbench.solvers.model.step_problem import Positions, Solver

TESTED_FABRICS = ("gray-interlock", "11oz-black-denim", "white-dots-on-blk", "royal-target", "tango-red-jet-set")
"""Fabrics of the table whose tests are simulated."""
TEST_ANGLE = np.deg2rad(41.5)
"""Inclination at which the overhang is measured [rad]."""
DISC_RADIUS, SUPPORT_RADIUS = 0.15, 0.09
"""Radii of the specimen and of its support [m]."""
STRIP_CELLS, DISC_SPACING = 24, 0.0075
"""Cells along the overhang, and spacing of the disc's lines [m]."""
DRAPE_STEP = 0.02
"""Time step [s] of the drape test."""
MIN_STRIP_STIFFNESS = 200.0
"""Membrane stiffness [N/m] of the strip at least, so that its stretch is no part of the overhang."""


class MeasuredBand(NamedTuple):
    """A measured value and the published band for it."""

    value: float
    low: float
    high: float

    @property
    def is_inside(self) -> bool:
        """Whether the value lies in the band."""
        return self.low <= self.value <= self.high


def measure_bending_length(fabric: PublishedFabric, solver: Solver) -> MeasuredBand:
    """Simulate the cantilever test of a fabric.

    Args:
        fabric: fabric with its density and its flexural rigidity.
        solver: solver of the scene.

    Returns:
        Bending length [m], and its band from the smallest and the largest measured rigidity.
    """
    stretch = max(fabric.warp, MIN_STRIP_STIFFNESS)

    def compute_excess(overhang: float) -> float:
        p = hang_strip(overhang, STRIP_CELLS, fabric.rigidity, fabric.density, stretch, solver, clamped=True)
        # The tip is the pair of vertices that are farthest from the edge.
        tip = p[np.argsort(np.hypot(p[:, 0], p[:, 1]))[-2:]].mean(axis=0)
        return float(np.arctan2(-tip[1], tip[0]) - TEST_ANGLE)

    weight = fabric.density * GRAVITY
    guess = 2.0 * (fabric.rigidity / weight) ** (1 / 3)
    overhang = scipy.optimize.brentq(compute_excess, 0.6 * guess, 1.6 * guess, xtol=1e-3 * guess)
    low, high = ((rigidity / weight) ** (1 / 3) for rigidity in fabric.rigidity_range)
    return MeasuredBand(float(overhang) / 2.0, low, high)


def measure_drape(
    fabric: PublishedFabric, solver: Solver, spacing: float = DISC_SPACING
) -> tuple[MeasuredBand, Positions, NDArray[np.int64]]:
    """Simulate the drape test of a fabric.

    Args:
        fabric: the fabric.
        solver: the solver.
        spacing: spacing of the disc's lines [m].

    Returns:
        Drape coefficient and its band [%], positions (n, 3) [m] of the specimen at rest, and its triangles (t, 3).
    """
    half = round(DISC_RADIUS / spacing) * spacing
    lines = np.linspace(-half, half, 2 * round(half / spacing) + 1)
    mesh = build_sheet(lines, lines, DISC_RADIUS * 1.0001)
    distance = np.hypot(mesh.rest_positions[:, 0], mesh.rest_positions[:, 2])
    weave: Any = OrthotropicStiffness(warp=fabric.warp, weft=fabric.weft, bias=fabric.shear, direction=(1.0, 0.0, 0.0))
    effects = [
        SpringsEffect(stretch=weave, shear=fabric.shear),
        BendingEffect(stiffness=fabric.rigidity),
        GravityEffect(),
        EtherDragEffect(decay_rate=5.0),
        PinsEffect(indices=tuple(np.flatnonzero(distance <= SUPPORT_RADIUS).tolist()), weight="exact"),
    ]
    # A random perturbation breaks the symmetry, so that folds form.
    start = PerturbedStart(standard_deviation=1e-4, seed=1)
    mass = fabric.density * float(lump_areas(mesh.rest_positions, mesh.triangles).sum())
    scene = build_validation_scene(mesh, effects, time_step=DRAPE_STEP, mass=mass, start=start)
    p = simulate_to_rest(scene, solver)
    flat = compute_shadow_area(mesh.rest_positions, mesh.triangles)
    support = compute_shadow_area(
        mesh.rest_positions, mesh.triangles[(distance[mesh.triangles] <= SUPPORT_RADIUS).all(axis=1)]
    )
    value = 100.0 * (compute_shadow_area(p, mesh.triangles) - support) / (flat - support)
    c = [100.0 * (rigidity / (fabric.density * GRAVITY)) ** (1 / 3) for rigidity in fabric.rigidity_range]
    found = [_predict_drape(one, angle) for one in c for angle in np.linspace(15.0, 45.0, 31)]
    return MeasuredBand(value, max(0.0, min(found)), min(100.0, max(found))), p, mesh.triangles


def _predict_drape(c: float, angle: float) -> float:
    """Return Cusick's drape coefficient [%] for a bending length [cm] and a shear angle [degrees]."""
    return 35.6 * c - 3.61 * c**2 - 2.59 * angle + 0.0461 * angle**2 + 17.0


def compute_shadow_area(p: Positions, triangles: NDArray[np.int64], pixel: float = 5e-4) -> float:
    """Return the area [m^2] of the shadow of triangles on the plane y = 0.

    Args:
        p: positions (n, 3) [m].
        triangles: vertex indices (t, 3).
        pixel: side [m] of the square pixels that are counted.
    """
    points = p[:, [0, 2]]
    low = points.min(axis=0) - pixel
    shape = np.ceil((points.max(axis=0) - low) / pixel).astype(int) + 2
    covered = np.zeros(shape, np.bool_)
    for a, b, c in points[triangles]:
        corners = np.array([a, b, c])
        first = np.floor((corners.min(axis=0) - low) / pixel).astype(int)
        last = np.ceil((corners.max(axis=0) - low) / pixel).astype(int)
        x = low[0] + pixel * (np.arange(first[0], last[0] + 1) + 0.5)[:, None]
        z = low[1] + pixel * (np.arange(first[1], last[1] + 1) + 0.5)[None, :]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        u = ((x - a[0]) * (c[1] - a[1]) - (z - a[1]) * (c[0] - a[0])) / area
        v = ((b[0] - a[0]) * (z - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        covered[first[0] : last[0] + 1, first[1] : last[1] + 1] |= (u >= 0) & (v >= 0) & (u + v <= 1)
    return float(covered.sum()) * pixel**2
