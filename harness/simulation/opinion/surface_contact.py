"""Reference terms of contact with obstacle surfaces: the barrier of self-contact between a mesh and each obstacle.

Pairs are points with triangles in both directions and edges with edges; k is the mean over the mesh's vertices in a
pair.

The triangles of an obstacle are declared (`harness.scenes.shapes`); their positions are computed by the reference
implementation's own motion. In a step they are at the time of the stage.
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
"""Maximum number of moves towards an obstacle, none longer than the mesh spacing."""
_WAYS = 20
"""Number of directions that are tried, since some lead into another obstacle."""


def surface_contact(effect: Any, declared: Declared) -> Opinion:
    """Build the barriers between the mesh and all obstacles."""
    return barriers(effect, against(effect, declared))


def against(effect: Any, declared: Declared) -> list[Against]:
    """Build the pairs of the mesh and each obstacle."""
    shapes = effect.shapes(np.asarray(declared.mesh.rest, float))
    return [Against(declared, one, *shape) for one, shape in zip(effect.obstacles, shapes, strict=True)]


class Against(Touching):
    """A mesh and one obstacle.

    The obstacle has points (o, 3) [m], as declared, and triangles (f, 3), whose vertices are numbered after the mesh's.
    """

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
        """Return the positions (o, 3) [m] of the obstacle's points at a time [s]."""
        points = self._declared
        if self._frames:
            x = np.asarray(self._frames.stored, float)
            since = min(max((time - self._frames.begin) * self._frames.rate, 0.0), len(x) - 1.0)
            low, high = int(np.floor(since)), int(np.ceil(since))
            between = (1.0 - (since - low)) * x[low] + (since - low) * x[high]
            points = wide(self._one.scale * between + np.array(self._one.offset))
        return place(self._motion, time).there(points)

    def whole(self, x: Wide, time: float) -> Wide:
        """Return the positions of mesh and obstacle vertices at a time [s]."""
        return np.concatenate([x, self.obstacle(time)])

    def near(self, x: Array, reach: float) -> tuple[Indices, Indices]:
        """Find the pairs of mesh and obstacle closer than a distance [m]."""
        points = near(x, self.points, self._faces, reach), near(x, self._corners, self.triangles, reach)
        return np.concatenate(points), near(x, self.edges, self._sides, reach)

    def apart(self, rows: Indices, edges: bool) -> Wide:
        """Return infinite rest distances: the rest shape is not near the obstacle."""
        return wide(np.full(len(rows), np.inf))

    def clear(self, p: Array, time: float, apart: float) -> bool:
        """Return whether no pair is closer than a distance.

        Args:
          p: positions of the mesh (n, 3) [m].
          time: time [s].
          apart: distance [m].
        """
        return self.nearest(np.concatenate([p, np.asarray(self.obstacle(time), float)]), apart) >= apart


Rng = np.random.Generator
Beside = tuple[Any, Against]
"""An effect, and the mesh with one of its obstacles."""


def met(all_: list[Beside], k: int, p: Array, spacing: float, times: tuple[float, float], rng: Rng) -> list[Array]:
    """Translate positions near to an obstacle at each of two times.

    At the first time they are separated from all obstacles, as at the start of every step.

    Args:
      all_: effects with mesh and obstacle.
      k: index of the obstacle.
      p: positions (n, 3) [m].
      spacing: mesh spacing [m].
      times: two times [s].
      rng: random generator.
    """
    effect, one = all_[k % len(all_)]
    found = list[Array]()
    for _ in range(_WAYS):
        way = rng.normal(size=3)
        found = [brought(effect, one, p, spacing, time, way / np.linalg.norm(way), rng) for time in times]
        if all(other.clear(found[0], times[0], its.thickness) for its, other in all_):
            break
    return found


def brought(effect: Any, one: Against, p: Array, spacing: float, time: float, way: Array, rng: Rng) -> Array:
    """Translate positions to an obstacle until some pair is in range.

    The mesh starts far away and moves against a direction, each time by the free distance.

    Args:
      effect: contact effect.
      one: mesh and obstacle.
      p: positions (n, 3) [m].
      spacing: mesh spacing [m].
      time: time [s].
      way: unit vector (3,) from the obstacle.
      rng: random generator.
    """
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
