"""Effects that a scene does not list and its motion calls for, each with the evidence.

Each finder looks at a motion and answers with evidence in words, or with nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from harness.experiments.ablation.difference import rest_length
from harness.scenes.bind import Scene

STRETCH = 0.1
"""Cloth that stretches further than this looks like rubber (Provot 1995)."""
NEAR = 0.5
"""Of the mean rest length: vertices that come closer than that lie as good as inside each other."""
SHARP = np.deg2rad(60.0)
"""More than this from triangle to triangle, and the mesh shows its edges."""
ALIVE = 0.1
"""Of the largest kinetic energy: more than this, on average over the last quarter, and the scene does not rest."""
FEW = 0.01
"""Of springs, and of edges: fewer are the corners that hang on a pin, where strain and curvature grow without bound as
the mesh is refined."""
DAMPING = ("air-drag", "dashpots", "ether-drag", "rayleigh")
LOOKS = 30
"""How many frames are looked at for vertices that come close, evenly spread."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A scene with the kinds of its effects, and its motion: positions [m], velocities [m/s], (frames, n, 3)."""

    scene: Scene
    kinds: Collection[str]
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]

    def time(self, frame: int) -> float:
        """Of a frame's end [s]; counted from 0."""
        return (frame + 1) * self.scene.system.time_step


class Suggestion(NamedTuple):
    """An effect by name, and why."""

    effect: str
    evidence: str


def suggestions(seen: Seen) -> list[Suggestion]:
    """What the motion calls for; in a fixed order."""
    found = ((effect, find(seen)) for effect, find in _FINDERS.items())
    return [Suggestion(effect, evidence) for effect, evidence in found if evidence]


def _overstretched(seen: Seen) -> str:
    springs = seen.scene.springs
    rest = springs.rest_length
    if "strain-limits" in seen.kinds or not rest.any():
        return ""
    strain = np.array([springs.lengths(p)[rest > 0.0] / rest[rest > 0.0] - 1.0 for p in seen.positions])
    ever = int((strain.max(axis=0) > STRETCH).sum())
    if ever <= FEW * len(rest):
        return ""
    frame = int(strain.max(axis=1).argmax())
    return (
        f"{ever} of {len(rest)} springs stretch by more than {100 * STRETCH:.0f} %, one by {100 * strain.max():.0f} % "
        f"at {seen.time(frame):.2f} s"
    )


def _too_close(seen: Seen) -> str:
    scene, frames, n = seen.scene, len(seen.positions), len(seen.scene.mesh.rest)
    reach = NEAR * rest_length(scene)
    known = _codes(np.concatenate([scene.mesh.springs, _pairs(scene.mesh.rest, reach)]), n)
    most, closest, at = 0, np.inf, 0
    for frame in np.unique(np.linspace(0, frames - 1, LOOKS).astype(int)):
        p = seen.positions[frame]
        pairs = _pairs(p, reach)
        pairs = pairs[~np.isin(_codes(pairs, n), known)]
        if len(pairs) > most:
            most, at = len(pairs), int(frame)
        if len(pairs):
            closest = min(closest, float(np.linalg.norm(p[pairs[:, 0]] - p[pairs[:, 1]], axis=1).min()))
    if not most:
        return ""
    return (
        f"{most} pairs of vertices without a spring between them are closer than {NEAR:g} mean rest lengths at "
        f"{seen.time(at):.2f} s, two come as close as {closest / rest_length(scene):.2g}; contact with obstacles "
        "does not keep them apart, and contact of a mesh with itself is not among the effects yet"
    )


def _restless(seen: Seen) -> str:
    driven, mass, v = bool(seen.scene.forces or seen.scene.moving), seen.scene.system.mass, seen.velocities
    if driven or set(DAMPING) & set(seen.kinds) or len(v) < 8:
        return ""
    most = float(_kinetic(mass, v).max())
    if not len(seen.scene.system.pins.vertices):  # what nothing holds may fly, fall or slide on as a whole
        v = v - np.einsum("i,fix->fx", mass / mass.sum(), v)[:, None]
    late = float(_kinetic(mass, v[-len(v) // 4 :]).mean())
    if not most or late <= ALIVE * most:
        return ""
    return (
        f"nothing drives the motion or damps it; in the last quarter of {seen.time(len(v) - 1):.2f} s it still "
        f"has {100 * late / most:.0f} % of its largest kinetic energy, and only the time integrator's own "
        "damping, which depends on the time step, would ever bring it to rest"
    )


def _creased(seen: Seen) -> str:
    mesh = seen.scene.mesh
    hinges = _hinges(mesh.triangles)
    if "bending" in seen.kinds or mesh.dimension != 2 or not len(hinges):
        return ""
    flat = _angles(mesh.rest, hinges)
    turned = np.array([np.abs(_angles(p, hinges) - flat) for p in seen.positions[-len(seen.positions) // 4 :]])
    turned = np.minimum(turned, 2.0 * np.pi - turned)
    share = float((turned > SHARP).mean())
    if share <= FEW:
        return ""
    return (
        f"over the last quarter of the motion {100 * share:.1f} % of the edges between triangles are bent by more than "
        f"{np.rad2deg(SHARP):.0f} degrees, the sharpest by {np.rad2deg(turned.max()):.0f}: folds as sharp as the mesh"
    )


_FINDERS: dict[str, Callable[[Seen], str]] = {
    "strain-limits": _overstretched,
    "self-contact": _too_close,
    "air-drag": _restless,
    "bending": _creased,
}


def _kinetic(mass: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """The kinetic energy in each frame [J]."""
    return 0.5 * np.einsum("i,fix,fix->f", mass, v, v)


def _pairs(p: NDArray[np.float64], reach: float) -> NDArray[np.int64]:
    """Pairs of vertices (k, 2) that are closer than `reach` [m]."""
    return KDTree(p).query_pairs(reach, output_type="ndarray").astype(np.int64)


def _codes(pairs: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """One number for each pair, whichever end comes first."""
    return pairs.min(axis=1) * n + pairs.max(axis=1)


def _hinges(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """The edges that two triangles share, with the corners across: (k, 4)."""
    if not len(triangles):
        return np.empty((0, 4), np.int64)
    rolled = np.concatenate([np.roll(triangles, -k, axis=1) for k in range(3)])  # an edge, then the corner across
    code = _codes(rolled[:, :2], int(triangles.max()) + 1)
    order = np.argsort(code, kind="stable")
    twice = np.flatnonzero(code[order][1:] == code[order][:-1])
    first, second = rolled[order[twice]], rolled[order[twice + 1]]
    return np.column_stack([first, second[:, 2]])


def _angles(p: NDArray[np.float64], hinges: NDArray[np.int64]) -> NDArray[np.float64]:
    """The signed angle by which the second triangle turns away from the plane of the first [rad], (k,)."""
    a, b, c, d = (p[corner] for corner in hinges.T)
    edge = b - a
    left, right = np.cross(edge, c - a), np.cross(d - a, edge)
    length = np.linalg.norm(edge, axis=1)
    along = np.einsum("ij,ij->i", np.cross(left, right), edge / np.where(length > 0.0, length, 1.0)[:, None])
    return np.arctan2(along, np.einsum("ij,ij->i", left, right))
