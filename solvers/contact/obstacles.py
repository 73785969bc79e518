"""Obstacle collision mesh: points against triangles of both sides, and edges against edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from solvers.contact import boxes, ways
from solvers.contact.barrier import distances
from solvers.contact.boxes import Gaps, Limits
from solvers.contact.contacts import Pairs, padded
from solvers.contact.mollifier import MOLLIFIED
from solvers.contact.trees import Tree, found
from solvers.problem import Positions

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Side(NamedTuple):
    """Primitives of one side, by global vertex indices.

    Attributes:
        points, edges, triangles: trees over the primitives.
        length: at rest [m], (m,).
    """

    points: Tree
    edges: Tree
    triangles: Tree
    length: Array

    @classmethod
    def of(cls, rest: Positions, edges: Indices, triangles: Indices, first: int = 0) -> Self:
        """Build the primitives of a shape.

        Args:
            rest: rest shape (n, 3) [m].
            edges: vertex indices (m, 2).
            triangles: vertex indices (f, 3).
            first: global index of the first vertex.
        """
        points = np.unique(np.append(edges.ravel(), triangles.ravel())).astype(np.int64)
        trees = Tree.of(rest, points[:, None]), Tree.of(rest, edges), Tree.of(rest, triangles)
        length = np.linalg.norm(rest[trees[1].corners[:, 0]] - rest[trees[1].corners[:, 1]], axis=1)
        one, two, three = (tree._replace(corners=tree.corners + first) for tree in trees)
        return cls(one, two, three, length)


@dataclass(frozen=True, eq=False)
class Against:
    """A mesh and obstacles, whose vertices follow those of the mesh.

    Attributes:
        mesh: primitives of the mesh.
        others: primitives of the obstacles.
        stiffness: barrier stiffness of the mesh's vertices [N/m], (n,).
        thickness: minimum distance between both [m].
        reach: barrier activation distance beyond the minimum distance [m].
    """

    mesh: Side
    others: Side
    stiffness: Array
    thickness: float
    reach: float

    def clear(self, p: Positions, q: Positions, limits: Limits) -> Gaps | None:
        """Return clearance bounds at q from one box around each side, or None."""
        n = len(self.stiffness)
        return Gaps(limits.reach, limits.reach) if boxes.apart((0, n), (n, len(p)), p, q, limits) else None

    def unevenness(self, p: Positions, q: Positions) -> float:
        """Return the largest relative displacement [m] of any two vertices."""
        return ways.unevenness(p, q)

    def within(self, p: Positions, reach: float) -> Pairs:
        """Return the pairs closer than `reach` [m] at p (n, 3) [m]."""
        x, limits = padded(p), Limits(reach, reach, 0.0, 0.0)
        one, two = (self.on_way(x, x, limits, edges) for edges in (False, True))
        pairs = one._replace(
            vertices=np.concatenate([one.vertices, two.vertices]),
            scale=np.concatenate([one.scale, two.scale]),
            stiffness=np.concatenate([one.stiffness, two.stiffness]),
            parallel=np.concatenate([one.parallel, two.parallel]),
        )
        close = distances(pairs, p) < reach
        return pairs._replace(
            vertices=pairs.vertices[close],
            points=int(close[: pairs.points].sum()),
            scale=pairs.scale[close],
            stiffness=pairs.stiffness[close],
            parallel=pairs.parallel[close],
        )

    def on_way(self, x: Array, y: Array, limits: Limits, edges: bool) -> Pairs:
        """Return the pairs that may violate a limit on the displacement from x to y."""
        a, b = self.mesh, self.others
        if edges:
            e, f = found(a.edges, b.edges, x, y, limits).T
            vertices = np.column_stack([a.edges.corners[e], b.edges.corners[f]])
            parallel = MOLLIFIED * (a.length[e] * b.length[f]) ** 2
        else:
            one, two = (found(i.points, j.triangles, x, y, limits).T for i, j in ((a, b), (b, a)))
            vertices = np.concatenate(
                [
                    np.column_stack([a.points.corners[one[0]], b.triangles.corners[one[1]]]),
                    np.column_stack([b.points.corners[two[0]], a.triangles.corners[two[1]]]),
                ]
            )
            parallel = np.zeros(len(vertices))
        own, points = vertices < len(self.stiffness), 0 if edges else len(vertices)
        stiffness = np.where(own, self.stiffness[np.where(own, vertices, 0)], 0.0).sum(axis=1) / own.sum(axis=1)
        return Pairs(vertices, points, np.ones(len(vertices)), stiffness, parallel, self.thickness, self.reach)
