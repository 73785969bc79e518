"""Contact with surfaces of obstacles once more: the barrier of `self_contact` between a mesh and each obstacle, points
with triangles both ways and edges with edges; k is the mean of the mesh's vertices in a pair.

What triangles an obstacle has is declared (`harness.scenes.shapes`); where they are is told by the second opinion's own
motion. In a step they are where they are at the unknown's time.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from harness.simulation.opinion.declared import Array, Declared, Opinion
from harness.simulation.opinion.derivatives import Wide, wide
from harness.simulation.opinion.motion import place
from harness.simulation.opinion.self_contact import Indices, Touching, barriers, near

_SOME = 200
"""Steps, none longer than the mesh's spacing."""
_WAYS = 20
"""That are tried, of which some lead into another obstacle."""


def surface_contact(effect: Any, declared: Declared) -> Opinion:
    """The barriers between the mesh and all obstacles."""
    return barriers(effect, against(effect, declared))


def against(effect: Any, declared: Declared) -> list[Against]:
    """The mesh with each obstacle."""
    shapes = effect.shapes(np.asarray(declared.mesh.rest, float))
    return [Against(declared, one, *shape) for one, shape in zip(effect.obstacles, shapes, strict=True)]


class Against(Touching):
    """A mesh, and an obstacle's points (o, 3) [m], as declared, and triangles (f, 3), whose vertices follow the
    mesh's."""

    def __init__(self, declared: Declared, one: Any, points: Array, triangles: Indices) -> None:
        super().__init__(declared)
        n = len(self.rest)
        self._declared, self._motion, self._faces = wide(points), one.motion, triangles + n
        self._one, self._frames = one, getattr(one, "frames", None)
        sides = {tuple(sorted(pair)) for corners in triangles.tolist() for pair in combinations(corners, 2)}
        self._sides = n + np.array(sorted(sides), int)
        self._corners = n + np.unique(triangles)[:, None]
        self.rest = np.concatenate([self.rest, points])

    def obstacle(self, time: float) -> Wide:
        """Where the obstacle's points are at a time [s], (o, 3) [m]."""
        points = self._declared
        if self._frames:
            x = np.asarray(self._frames.stored, float)
            since = min(max((time - self._frames.begin) * self._frames.rate, 0.0), len(x) - 1.0)
            low, high = int(np.floor(since)), int(np.ceil(since))
            between = (1.0 - (since - low)) * x[low] + (since - low) * x[high]
            points = wide(self._one.scale * between + np.array(self._one.offset))
        return place(self._motion, time).there(points)

    def whole(self, x: Wide, time: float) -> Wide:
        """See Touching."""
        return np.concatenate([x, self.obstacle(time)])

    def near(self, x: Array, reach: float) -> tuple[Indices, Indices]:
        """See Touching."""
        points = near(x, self.points, self._faces, reach), near(x, self._corners, self.triangles, reach)
        return np.concatenate(points), near(x, self.edges, self._sides, reach)

    def apart(self, rows: Indices, edges: bool) -> Wide:
        """See Touching: what is at rest is not beside the obstacle."""
        return wide(np.full(len(rows), np.inf))

    def clear(self, p: Array, time: float, apart: float) -> bool:
        """Whether no pair is nearer than `apart` [m], the mesh at p (n, 3) [m], at a time [s]."""
        return self.nearest(np.concatenate([p, np.asarray(self.obstacle(time), float)]), apart) >= apart


Rng = np.random.Generator
Beside = tuple[Any, Against]
"""An effect, and the mesh with one of its obstacles."""


def met(all_: list[Beside], k: int, p: Array, spacing: float, times: tuple[float, float], rng: Rng) -> list[Array]:
    """Positions (n, 3) [m] as a whole near to obstacle k, where it is at each of two times [s]; at the first one free
    of all obstacles, as every step starts. spacing [m]: of the mesh."""
    effect, one = all_[k % len(all_)]
    found = list[Array]()
    for _ in range(_WAYS):
        way = rng.normal(size=3)
        found = [brought(effect, one, p, spacing, time, way / np.linalg.norm(way), rng) for time in times]
        if all(other.clear(found[0], times[0], its.thickness) for its, other in all_):
            break
    return found


def brought(effect: Any, one: Against, p: Array, spacing: float, time: float, way: Array, rng: Rng) -> Array:
    """Positions (n, 3) [m] as a whole outside of an obstacle, and so near to it that some pair is in range, at a time
    [s]: from far away along a way (3,), each time by what is free. spacing [m]: of the mesh."""
    reach = effect.thickness if effect.range is None else effect.range
    there = np.asarray(one.obstacle(time), float)
    middle = 0.5 * (there.max(axis=0) + there.min(axis=0))
    at = p - p.mean(axis=0)
    out = float(((there - middle) @ way).max() - (at @ way).min()) + effect.thickness + reach  # a plane between them
    wanted = effect.thickness + reach * rng.uniform(0.3, 0.7)
    for _ in range(_SOME):
        free = one.nearest(np.concatenate([middle + out * way + at, there]), wanted + spacing) - wanted
        if free < 1e-3 * reach:
            break
        out -= free
    return middle + out * way + at
