"""What a mesh has that may touch itself: points, edges and triangles, and which of their pairs are near at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from solvers.contact import boxes
from solvers.contact.barrier import Pairs, distances
from solvers.contact.boxes import Indices, Tree, Trees
from solvers.contact.mollifier import MOLLIFIED
from solvers.problem import Positions

Array = NDArray[np.float64]

_LESS = 1.0 - 1e-12
"""Of a proportion: round-off at rest is no force."""

_NOTHING = np.empty(0)


@dataclass(frozen=True, eq=False)
class Surface:
    """Points (q,), edges (m, 2) and triangles (f, 3) of a mesh at rest, that keep a thickness [m] from each other and
    feel each other within a range [m] beyond it.

    Pairs that share a vertex are none. Those that are nearer at rest than thickness and range have both in proportion
    to their distance there: they are free of force at rest, and do not pass through each other either.
    stiffness (n,): [N/m]; near: the keys of such pairs, sorted, and that proportion.
    """

    points: Indices
    edges: Tree
    triangles: Tree
    length: Array
    stiffness: Array
    thickness: float
    reach: float
    near: tuple[Indices, Array]

    @classmethod
    def of(
        cls, rest: Positions, edges: Indices, triangles: Indices, stiffness: Array, thickness: float, reach: float
    ) -> Surface:
        """The surface of a rest shape (n, 3) [m]."""
        points = np.unique(np.append(edges.ravel(), triangles.ravel())).astype(np.int64)
        rest = np.array(rest, order="C")
        lengths = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
        none = np.empty(0, np.int64), np.empty(0)
        trees = Tree.of(rest, edges), Tree.of(rest, triangles)
        bare = cls(points, *trees, lengths, np.array(stiffness), thickness, reach, none)
        found, first = boxes.near(points, bare._trees, rest, rest, thickness + reach)
        apart = distances(bare._bare(found, first), rest)
        close = apart < thickness + reach
        keys, share = bare._keys(found, first)[close], _LESS * apart[close] / (thickness + reach)
        order = np.argsort(keys)
        near = keys[order], share[order]
        return cls(points, *trees, lengths, np.array(stiffness), thickness, reach, near)

    @property
    def _trees(self) -> Trees:
        return self.triangles, self.edges

    def within(self, p: Positions, reach: float) -> Pairs:
        """Pairs that are nearer than `reach` [m] at p (n, 3) [m]."""
        found, first = boxes.near(self.points, self._trees, p, p, reach)
        bare = self._bare(found, first)
        close = distances(bare, p) < reach
        found, vertices = found[close], bare.vertices[close]
        first = int(close[:first].sum())
        two, parallel = found[first:].T, np.zeros(len(found))
        parallel[first:] = MOLLIFIED * (self.length[two[0]] * self.length[two[1]]) ** 2
        stiffness = self.stiffness[vertices].mean(axis=1)
        return Pairs(vertices, first, self._scale(found, first), stiffness, parallel, self.thickness, self.reach)

    def on_way(self, p: Positions, q: Positions, reach: float) -> Pairs:
        """Pairs that may come nearer than `reach` [m] on the straight way from p to q, (n, 3) [m] both; without what
        they press with."""
        found, first = boxes.near(self.points, self._trees, p, q, reach)
        return self._bare(found, first)._replace(scale=self._scale(found, first))

    def _bare(self, found: Indices, first: int) -> Pairs:
        """Pairs by their numbers (k, 2), the first ones of points and triangles; no more than where they are."""
        one, two = found[:first].T, found[first:].T
        vertices = np.empty((len(found), 4), np.int64)
        vertices[:first, 0], vertices[:first, 1:] = self.points[one[0]], self.triangles.corners[one[1]]
        vertices[first:, :2], vertices[first:, 2:] = self.edges.corners[two[0]], self.edges.corners[two[1]]
        return Pairs(vertices, first, _NOTHING, _NOTHING, _NOTHING, self.thickness, self.reach)

    def _scale(self, found: Indices, first: int) -> Array:
        """The proportion (k,) in which pairs keep thickness and range."""
        keys, share = self.near
        if not (len(keys) and len(found)):
            return np.ones(len(found))
        wanted = self._keys(found, first)
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(keys[at] == wanted, share[at], 1.0)

    def _keys(self, found: Indices, first: int) -> Indices:
        """A number of each pair."""
        many = max(len(self.triangles.corners), len(self.edges.corners), 1)
        key = found[:, 0] * many + found[:, 1]
        key[first:] += len(self.points) * many
        return key
