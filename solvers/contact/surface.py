"""Collision mesh: the points, edges and triangles of a mesh that may collide.

Pairs that are close at rest have scaled distances.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.barrier import distances
from solvers.contact.boxes import Gaps, Indices, Limits
from solvers.contact.closest import dot, edge_edge_way, point_triangle_way
from solvers.contact.contacts import Pairs, padded
from solvers.contact.mollifier import MOLLIFIED
from solvers.contact.patches import Patches
from solvers.contact.trees import Tree, found
from solvers.problem import Positions
from solvers.vectors.eights import bits, lowest, rows

Array = NDArray[np.float64]

_LESS = 1.0 - 1e-12
"""Factor on the scale of distances: without it, round-off would produce forces at rest."""

_LOOKED = 4.0
"""Distance, relative to the activation distance, up to which pairs are tested one by one at rest."""

_NOTHING = np.empty(0)


@dataclass(frozen=True, eq=False)
class Surface:
    """Points, edges and triangles of a mesh, in contact with each other.

    Pairs that share a vertex are excluded. Pairs that are closer at rest than the activation distance have both
    distances scaled in proportion. They exert no force at rest, and still cannot interpenetrate.

    Attributes:
        rest: rest shape (n, 3) [m].
        points, edges, triangles: trees over the primitives.
        length: at rest [m], (m,).
        stiffness: barrier stiffness of each vertex [N/m], (n,).
        thickness: minimum distance [m].
        reach: barrier activation distance beyond the minimum distance [m].
        near: sorted keys of the pairs with scaled distances, and their scales.
    """

    rest: Positions
    points: Tree
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
        """Build the collision mesh of a rest shape.

        Args:
            rest: rest shape (n, 3) [m].
            edges: vertex indices (m, 2).
            triangles: vertex indices (f, 3).
            stiffness: barrier stiffness of each vertex [N/m], (n,).
            thickness: minimum distance [m].
            reach: barrier activation distance beyond the minimum distance [m].
        """
        points = np.unique(np.append(edges.ravel(), triangles.ravel())).astype(np.int64)
        rest = np.array(rest, order="C")
        none = np.empty(0, np.int64), np.empty(0)
        trees = Tree.of(rest, points[:, None]), Tree.of(rest, edges), Tree.of(rest, triangles)
        lengths = _lengths(rest, trees[1].corners)
        bare = cls(rest, *trees, lengths, np.array(stiffness), thickness, reach, none)
        near, first = bare._near(padded(rest), thickness + reach)
        apart = distances(bare._bare(near, first), rest)
        close = apart < thickness + reach
        keys, share = bare._keys(near, first)[close], _LESS * apart[close] / (thickness + reach)
        order = np.argsort(keys)
        near = keys[order], share[order]
        return cls(rest, *trees, lengths, np.array(stiffness), thickness, reach, near)

    def _near(self, x: Array, reach: float) -> tuple[Indices, int]:
        """Return index pairs (k, 2) that may be closer than a radius at x (n, 4), and how many are point-triangle."""
        limits = Limits(reach, reach, 0.0, 0.0)
        one = found(self.points, self.triangles, x, x, limits)
        return np.concatenate([one, found(self.edges, self.edges, x, x, limits)]), len(one)

    @cached_property
    def _patches(self) -> Patches:
        return Patches.of(self.rest, self.points, self.edges, self.triangles, _LOOKED * (self.thickness + self.reach))

    def clear(self, p: Positions, q: Positions, limits: Limits) -> Gaps | None:
        """Return lower bounds of the distances at q, if the displacement from p to q violates no limit."""
        return self._patches.clear(p, q, limits)

    def unevenness(self, p: Positions, q: Positions) -> float:
        """Return the largest relative displacement [m] of two vertices that are close to each other at rest."""
        return self._patches.unevenness(p, q)

    def within(self, p: Positions, reach: float) -> Pairs:
        """Return the pairs closer than `reach` [m] at p (n, 3) [m]."""
        x = padded(p)
        met, first = self._near(x, reach)
        many = len(met)
        vertices, numbers = np.empty((many, 4), np.int64), (np.empty(many), np.empty(many))
        pairs = Pairs(vertices, first, _NOTHING, *numbers, self.thickness, self.reach)
        points, count = nearer(pairs, met, self._parts, self.length, self.stiffness, x, reach)
        scale = self._scale(met[:count], points)
        return pairs._replace(
            vertices=pairs.vertices[:count],
            points=points,
            scale=scale,
            stiffness=pairs.stiffness[:count],
            parallel=pairs.parallel[:count],
        )

    @property
    def _parts(self) -> tuple[Indices, Indices, Indices]:
        return self.points.corners, self.triangles.corners, self.edges.corners

    def on_way(self, x: Array, y: Array, limits: Limits, edges: bool) -> Pairs:
        """Return the pairs that may violate a limit between x and y, without barrier parameters."""
        one, other = (self.edges, self.edges) if edges else (self.points, self.triangles)
        met = found(one, other, x, y, limits)
        first = 0 if edges else len(met)
        return self._bare(met, first)._replace(scale=self._scale(met, first))

    def _bare(self, met: Indices, first: int) -> Pairs:
        """Return candidates of index pairs (k, 2), the first ones point-triangle, without scales and stiffnesses."""
        vertices = np.empty((len(met), 4), np.int64)
        name(met, first, self._parts, vertices)
        return Pairs(vertices, first, _NOTHING, _NOTHING, _NOTHING, self.thickness, self.reach)

    def _scale(self, met: Indices, first: int) -> Array:
        """Return the factors (k,) on the distances of pairs."""
        keys, share = self.near
        if not (len(keys) and len(met)):
            return np.ones(len(met))
        wanted = self._keys(met, first)
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(keys[at] == wanted, share[at], 1.0)

    def _keys(self, met: Indices, first: int) -> Indices:
        """Return a unique key of each pair."""
        many = max(len(self.triangles.corners), len(self.edges.corners), 1)
        key = met[:, 0] * many + met[:, 1]
        key[first:] += len(self.points.corners) * many
        return key


def _lengths(x: Positions, edges: Indices) -> Array:
    return np.asarray(np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1), np.float64)


@inner
def _name(found, e, edges, parts, vertices, k):
    """Write the vertices of pair e to row k."""
    points, triangles, sides = parts
    i, j = found[e, 0], found[e, 1]
    if edges:
        vertices[k, 0], vertices[k, 1], vertices[k, 2], vertices[k, 3] = (
            sides[i, 0],
            sides[i, 1],
            sides[j, 0],
            sides[j, 1],
        )
    else:
        vertices[k, 0] = points[i, 0]
        vertices[k, 1], vertices[k, 2], vertices[k, 3] = triangles[j, 0], triangles[j, 1], triangles[j, 2]


@kernel
def name(found, first, parts, vertices):
    """Write the vertices (k, 4) of index pairs.

    Args:
        found: primitive indices (k, 2).
        first: number of point-triangle pairs, which come first.
        parts: points, triangles and edges.
        vertices: output (k, 4).
    """
    for e in range(len(found)):
        _name(found, e, e >= first, parts, vertices, e)


@kernel
def nearer(pairs, found, parts, lengths, stiffness, x, reach):
    """Remove the pairs that are not closer than a radius, and write the others to `pairs`.

    Args:
        pairs: vertices, stiffness and mollifier threshold are overwritten.
        found: primitive indices (k, 2), compacted in place.
        parts: points, triangles and edges.
        lengths: edge lengths at rest [m], (m,).
        stiffness: stiffness of each vertex [N/m], (n,).
        x: positions (n, 4) [m].
        reach: radius [m].

    Returns:
        Number of point-triangle pairs, and of all pairs.
    """
    count, points, begin, limit = 0, 0, 0, reach * reach
    for edges in (False, True):
        end = len(found) if edges else pairs.points
        for first in range(begin, end, 8):
            many = min(8, end - first)
            for k in range(many):
                _name(found, first + k, edges, parts, pairs.vertices, count + k)
            left, last = _near(pairs.vertices, x, count, count + many - 1, edges, limit), count
            while left != 0:
                lane = lowest(left)
                left &= left - 1
                if lane < many:
                    e = first + lane
                    i, j = found[e, 0], found[e, 1]
                    found[count, 0], found[count, 1] = i, j
                    v = pairs.vertices[count]
                    for a in range(4):
                        v[a] = pairs.vertices[last + lane, a]
                    pairs.stiffness[count] = 0.25 * (
                        stiffness[v[0]] + stiffness[v[1]] + stiffness[v[2]] + stiffness[v[3]]
                    )
                    pairs.parallel[count] = MOLLIFIED * (lengths[i] * lengths[j]) ** 2 if edges else 0.0
                    count += 1
        begin, points = end, points if edges else count
    return points, count


@inner
def _near(vertices, x, first, last, edges, limit):
    """Return as bits which of eight pairs have a squared distance below a limit."""
    a, b = rows(x, vertices, first, last, 0), rows(x, vertices, first, last, 1)
    c, d = rows(x, vertices, first, last, 2), rows(x, vertices, first, last, 3)
    z = edge_edge_way(a, b, c, d)[4] if edges else point_triangle_way(a, b, c, d)[4]
    return bits(dot(z, z) < limit)
