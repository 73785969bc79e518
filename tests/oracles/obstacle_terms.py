"""Reference terms of contact with obstacle surfaces: the barrier of self-contact between a mesh and each obstacle.

Pairs are points with triangles in both directions and edges with edges; k is the mean over the mesh's vertices in a
pair.

The triangles of an obstacle are declared (`springbench.harness.scenes.surface_obstacles`); their positions are
computed by the reference
implementation's own motion. In a step they are at the time of the stage.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from tests.oracles.complex_step import ExtendedArray, to_extended
from tests.oracles.key_frame_motion import place_at
from tests.oracles.scene_declaration import Array, EffectTerms, SceneDeclaration
from tests.oracles.self_contact_terms import (
    ContactPairs,
    IndexArray,
    build_barriers,
    find_near_primitives,
)

_MAX_TRIALS = 200
"""Maximum number of moves towards an obstacle."""
_RANGE_TOLERANCE = 0.05
"""Distance from the target at which a move ends, relative to the activation distance: the pair is in range already."""
_NUM_DIRECTIONS = 20
"""Number of directions that are tried, since some lead into another obstacle."""


def build_surface_contact_terms(effect: Any, declared: SceneDeclaration) -> EffectTerms:
    """Build the barriers between the mesh and all obstacles."""
    return build_barriers(effect, build_obstacle_pairs(effect, declared))


def build_obstacle_pairs(effect: Any, declared: SceneDeclaration) -> list[ObstaclePairs]:
    """Build the pairs of the mesh and each obstacle."""
    shapes = effect.build_obstacle_surfaces(np.asarray(declared.mesh.rest_positions, float))
    return [ObstaclePairs(declared, one, *shape) for one, shape in zip(effect.obstacles, shapes, strict=True)]


class ObstaclePairs(ContactPairs):
    """A mesh and one obstacle.

    The obstacle has points (o, 3) [m], as declared, and triangles (f, 3), whose vertices are numbered after the mesh's.
    """

    def __init__(self, declared: SceneDeclaration, one: Any, points: Array, triangles: IndexArray) -> None:
        super().__init__(declared)
        n = len(self.rest_positions)
        self._declared, self._motion, self._faces = to_extended(points), one.motion, triangles + n
        self._one, self._frames = one, getattr(one, "frames", None)
        sides = {tuple(sorted(pair)) for corners in triangles.tolist() for pair in combinations(corners, 2)}
        self._sides = n + np.array(sorted(sides), int)
        self._corners = n + np.unique(triangles)[:, None]
        self.rest_positions = np.concatenate([self.rest_positions, points])

    def obstacle_positions(self, time: float) -> ExtendedArray:
        """Return the positions (o, 3) [m] of the obstacle's points at a time [s]."""
        points = self._declared
        if self._frames:
            x = np.asarray(self._frames.frame_positions, float)
            since = min(max((time - self._frames.start_time) * self._frames.frame_rate, 0.0), len(x) - 1.0)
            low, high = int(np.floor(since)), int(np.ceil(since))
            between = (1.0 - (since - low)) * x[low] + (since - low) * x[high]
            points = to_extended(self._one.scale * between + np.array(self._one.offset))
        return place_at(self._motion, time).transform(points)

    def all_positions(self, x: ExtendedArray, time: float) -> ExtendedArray:
        """Return the positions of mesh and obstacle vertices at a time [s]."""
        return np.concatenate([x, self.obstacle_positions(time)])

    def find_near_pairs(self, x: Array, max_distance: float) -> tuple[IndexArray, IndexArray]:
        """Find the pairs of mesh and obstacle closer than a distance [m]."""
        points = (
            find_near_primitives(x, self.points, self._faces, max_distance),
            find_near_primitives(x, self._corners, self.triangles, max_distance),
        )
        return np.concatenate(points), find_near_primitives(x, self.edges, self._sides, max_distance)

    def rest_distance(self, rows: IndexArray, edges: bool) -> ExtendedArray:
        """Return infinite rest distances: the rest shape is not near the obstacle."""
        return to_extended(np.full(len(rows), np.inf))

    def is_separated(self, p: Array, time: float, distance: float) -> bool:
        """Return whether no pair is closer than a distance.

        Args:
          p: positions of the mesh (n, 3) [m].
          time: time [s].
          distance: distance [m].
        """
        positions = np.concatenate([p, np.asarray(self.obstacle_positions(time), float)])
        return self.min_distance(positions, distance) >= distance


RandomGenerator = np.random.Generator
EffectPairs = tuple[Any, ObstaclePairs]
"""An effect, and the mesh with one of its obstacles."""


def sample_contact_positions(
    all_: list[EffectPairs], k: int, p: Array, spacing: float, times: tuple[float, float], rng: RandomGenerator
) -> list[Array]:
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
    for _ in range(_NUM_DIRECTIONS):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        found = [move_to_obstacle(effect, one, p, spacing, time, direction, rng) for time in times]
        if all(other.is_separated(found[0], times[0], its.min_distance) for its, other in all_):
            break
    return found


def move_to_obstacle(
    effect: Any, one: ObstaclePairs, p: Array, spacing: float, time: float, direction: Array, rng: RandomGenerator
) -> Array:
    """Translate positions to an obstacle until some pair is in range.

    The mesh starts far away and moves against a direction, each time by the free distance.

    Args:
      effect: contact effect.
      one: mesh and obstacle.
      p: positions (n, 3) [m].
      spacing: mesh spacing [m].
      time: time [s].
      direction: unit vector (3,) from the obstacle.
      rng: random generator.
    """
    dhat = effect.min_distance if effect.dhat is None else effect.dhat
    there = np.asarray(one.obstacle_positions(time), float)
    middle = 0.5 * (there.max(axis=0) + there.min(axis=0))
    at = p - p.mean(axis=0)
    # A plane separates them at first.
    out = float(((there - middle) @ direction).max() - (at @ direction).min()) + effect.min_distance + dhat
    distance, max_move = effect.min_distance + dhat * rng.uniform(0.3, 0.7), spacing
    for _ in range(_MAX_TRIALS):
        free = one.min_distance(np.concatenate([middle + out * direction + at, there]), distance + max_move) - distance
        if free < _RANGE_TOLERANCE * dhat:
            break
        out -= free
        max_move = 2.0 * free  # as long as nothing is found, twice as far each time
    return middle + out * direction + at
