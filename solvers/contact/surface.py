"""What a mesh has that may touch itself: points, edges and triangles, and which of their pairs are near at rest."""

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
"""Of a proportion: round-off at rest is no force."""

_LOOKED = 4.0
"""Of the range: pairs that are farther apart at rest are not looked at one by one."""

_NOTHING = np.empty(0)


@dataclass(frozen=True, eq=False)
class Surface:
    """Points (q, 1), edges (m, 2) and triangles (f, 3) of a mesh at rest, that keep a thickness [m] from each other and
    feel each other within a range [m] beyond it.

    Pairs that share a vertex are none. Those that are nearer at rest than thickness and range have both in proportion
    to their distance there: they are free of force at rest, and do not pass through each other either.
    stiffness (n,): [N/m]; near: the keys of such pairs, sorted, and that proportion.
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
        """The surface of a rest shape (n, 3) [m]."""
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
        """Pairs that may be nearer than `reach` [m] at x (n, 4), by their numbers (k, 2): of points and triangles, so
        many, then of edges."""
        limits = Limits(reach, reach, 0.0, 0.0)
        one = found(self.points, self.triangles, x, x, limits)
        return np.concatenate([one, found(self.edges, self.edges, x, x, limits)]), len(one)

    @cached_property
    def _patches(self) -> Patches:
        return Patches.of(self.rest, self.points, self.edges, self.triangles, _LOOKED * (self.thickness + self.reach))

    def clear(self, p: Positions, q: Positions, limits: Limits) -> Gaps | None:
        """See `solvers.contact.known.Surfaces`."""
        return self._patches.clear(p, q, limits)

    def unevenness(self, p: Positions, q: Positions) -> float:
        """See `solvers.contact.known.Surfaces`."""
        return self._patches.unevenness(p, q)

    def within(self, p: Positions, reach: float) -> Pairs:
        """Pairs that are nearer than `reach` [m] at p (n, 3) [m]."""
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
        """See `solvers.contact.known.Surfaces`; without what they press with."""
        one, other = (self.edges, self.edges) if edges else (self.points, self.triangles)
        met = found(one, other, x, y, limits)
        first = 0 if edges else len(met)
        return self._bare(met, first)._replace(scale=self._scale(met, first))

    def _bare(self, met: Indices, first: int) -> Pairs:
        """Pairs by their numbers (k, 2), the first ones of points and triangles; no more than where they are."""
        vertices = np.empty((len(met), 4), np.int64)
        name(met, first, self._parts, vertices)
        return Pairs(vertices, first, _NOTHING, _NOTHING, _NOTHING, self.thickness, self.reach)

    def _scale(self, met: Indices, first: int) -> Array:
        """The proportion (k,) in which pairs keep thickness and range."""
        keys, share = self.near
        if not (len(keys) and len(met)):
            return np.ones(len(met))
        wanted = self._keys(met, first)
        at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return np.where(keys[at] == wanted, share[at], 1.0)

    def _keys(self, met: Indices, first: int) -> Indices:
        """A number of each pair."""
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
    """Write the vertices (k, 4) of pairs (k, 2), the first ones of points and triangles; parts: points, triangles and
    edges."""
    for e in range(len(found)):
        _name(found, e, e >= first, parts, vertices, e)


@kernel
def nearer(pairs, found, parts, lengths, stiffness, x, reach):
    """Leave those of found pairs (k, 2) that are nearer than `reach` at x (n, 4), and write their vertices, stiffness
    and e to `pairs`; how many are of points and triangles, and of both kinds."""
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
    """Which of eight pairs are nearer than the root of a limit, as bits."""
    a, b = rows(x, vertices, first, last, 0), rows(x, vertices, first, last, 1)
    c, d = rows(x, vertices, first, last, 2), rows(x, vertices, first, last, 3)
    z = edge_edge_way(a, b, c, d)[4] if edges else point_triangle_way(a, b, c, d)[4]
    return bits(dot(z, z) < limit)
