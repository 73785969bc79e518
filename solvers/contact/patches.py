"""Cluster culling: prove that no primitives of a surface come close, without testing each of them.

The surface is divided into clusters of a few vertices each. A cluster owns the points, edges and triangles whose first
vertex along the Morton curve belongs to it. Cluster pairs that are close at rest are tested by their affine poses
(`solvers.contact.flat`), all others by bounding boxes. Primitives are tested only where both
fail. The result is a lower bound of all distances at the end of the motion. Boxes are tested again only after vertices
have moved relative to each other by as much.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import kernel
from solvers.contact import affine, flat, trees, ways
from solvers.contact.affine import Lie, Rest
from solvers.contact.barrier import distances
from solvers.contact.boxes import Gaps, Indices, Limits
from solvers.contact.contacts import Pairs, pad
from solvers.contact.flat import Beside, Sight
from solvers.contact.owned import Owned, among
from solvers.contact.trees import Tree
from solvers.contact.ways import unevenness
from solvers.problem import Positions

Array = NDArray[np.float64]

_PATCH = 16
"""Vertices of a cluster, in addition to those of its neighbours that its primitives have."""

_WIDER = 1.5
"""Query distance relative to the required one: a larger clearance stays valid for longer."""

_FAR = 4.0
"""Factor on that distance for clusters not close at rest, tried first."""

_SAME = 1e-12
"""Tolerance, relative to the query distance, within which two positions count as the same."""

_FEW = 4096
"""Maximum number of primitive pairs; beyond it, some pair is assumed to come close."""


class Scratch(NamedTuple):
    """Scratch memory of a query.

    Attributes:
        tile: (3 k, 8).
        stack: of the tree traversal.
        sight: of the clusters.
        doubtful: cluster pairs that are not proved to be separated (k, 2).
        here, there: boxes of a cluster's primitives (k, 6, 8).
        found: (k, 4).
        way: of vertices (n, 4).
        low, high: boxes of the displacements of each cluster (m, 4).
    """

    tile: Array
    stack: Indices
    sight: Sight
    doubtful: Indices
    here: Array
    there: Array
    found: Indices
    way: Array
    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Patches:
    """Clusters of a surface.

    Attributes:
        rest: clusters at rest.
        tree: tree over the clusters.
        points, edges, triangles: primitives of the clusters.
        looked: lower bound of the rest distance of all pairs that are not stored [m].
        pairs: first all pairs that are close at rest, sorted, then memory for more.
        scratch: scratch memory.
        starts: first pair of each cluster (clusters + 1,).
        seen: poses at the last two positions.
        apart: position of the last query, and the clearance there of clusters not close at rest [m].
        crowded: whether too many clusters are close at rest, as in a stack of sheets, for culling to be useful.
    """

    rest: Rest
    tree: Tree
    points: Owned
    edges: Owned
    triangles: Owned
    looked: float
    pairs: Beside
    scratch: Scratch
    starts: Indices
    seen: list[_Seen] = field(default_factory=list["_Seen"])
    apart: list[tuple[Positions, float]] = field(default_factory=list[tuple[Positions, float]])
    crowded: bool = False

    @classmethod
    def of(cls, rest: Positions, points: Tree, edges: Tree, triangles: Tree, looked: float) -> Patches:
        """Divide a rest shape into clusters.

        Args:
            rest: rest shape (n, 3) [m].
            points, edges, triangles: trees over the primitives.
            looked: distance up to which cluster pairs count as close at rest [m].
        """
        many = max(1, -(-len(points.corners) // _PATCH))
        rank = np.zeros(len(rest), np.int64)
        rank[points.corners[:, 0]] = np.arange(len(points.corners)) // _PATCH
        owned = (
            Owned.of(points.corners, rank, many),
            Owned.of(edges.corners, rank, many),
            Owned.of(triangles.corners, rank, many),
        )
        at_rest = affine.rest(rest, np.concatenate([one.members() for one in owned]), many)
        tree, most = Tree.over(many), max(int(np.diff(one.starts).max()) for one in owned)
        room, eights = 24 * many + 8, -(-most // 8) + -(-most // 64) + 1
        patches = len(at_rest.centre)
        scratch = Scratch(
            tile=np.empty((3 * at_rest.vertices.shape[1], 8)),
            stack=trees.stack(),
            sight=Sight.room(patches),
            doubtful=np.empty((room, 2), np.int64),
            here=np.empty((eights, 6, 8)),
            there=np.empty((eights, 6, 8)),
            found=np.empty((_FEW, 4), np.int64),
            way=np.empty((len(rest), 4)),
            low=np.empty((patches, 4)),
            high=np.empty((patches, 4)),
        )
        made = cls(at_rest, tree, *owned, looked, Beside.room(room), scratch, np.zeros(many + 1, np.int64))
        return made._knowing(rest)

    def clear(self, p: Positions, q: Positions, limits: Limits) -> Gaps | None:
        """Return clearance bounds at q of primitives without common vertices, if the motion violates no limit.

        Args:
            p: start positions (n, 3) [m].
            q: end positions (n, 3) [m].
            limits: limits of the distances.

        Returns:
            Clearance bounds; None if the test is inconclusive.
        """
        if self.crowded:
            return None
        limits = limits._replace(moved=unevenness(p, q))
        begin, end, memory = self._lies(p, limits), self._lies(q, limits), self.scratch
        wide = limits._replace(reach=_WIDER * limits.reach)
        far, others = self._far(p, q, limits), 0
        if not far:
            for far in (_FAR * wide.reach, wide.reach):
                others = self._met(begin, end, limits._replace(reach=far))
                if not others:
                    self.apart[:] = [(q.copy(), far)]
                    break
            if others < 0:
                return None
        count = self.known + others
        count, near = flat.doubtful(
            begin.lie, end.lie, self.pairs, count, limits, wide.reach, memory.sight, memory.tile, memory.doubtful
        )
        if count:
            pairs = self._pairs(memory.doubtful[:count], begin.x, end.x, wide)
            if pairs is None:
                return None
            pairs, scratch = pairs._replace(thickness=limits.reach), ways.scratch()
            np.subtract(end.x, begin.x, out=memory.way)
            if ways.largest(pairs, begin.x, memory.way, 1.0, *scratch) < 1.0:
                return None
            near = min(near, float(distances(pairs, q).min(initial=wide.reach)))
        return Gaps(near, near if others else far)

    def _far(self, p: Positions, q: Positions, limits: Limits) -> float:
        """Return the known clearance [m] at q of clusters not close at rest.

        The result is 0 unless the known clearances prove that the motion from p to q violates no limit.
        """
        for at, far in self.apart:
            before, after = unevenness(at, p), unevenness(at, q)
            if max(limits.reach, limits.closed + limits.share * (far + before)) <= far - max(before, after):
                return far - after
        return 0.0

    def unevenness(self, p: Positions, q: Positions) -> float:
        """Return the largest relative displacement of two vertices of clusters that are close at rest.

        Args:
            p: start positions, contiguous (n, 3) [m].
            q: end positions, contiguous (n, 3) [m].

        Returns:
            Upper bound [m].
        """
        memory = self.scratch
        return affine.spread(
            self.rest.vertices, self.pairs.patches, self.known, p, q, memory.way, memory.tile, memory.low, memory.high
        )

    def _lies(self, p: Positions, limits: Limits) -> _Seen:
        for k, one in enumerate(self.seen):
            if ways.alike(one.x, p, _SAME * limits.reach):
                self.seen.append(self.seen.pop(k))  # the other one is the first to be overwritten
                return one
        one = self.seen.pop(0) if len(self.seen) > 1 else _Seen.of(self.rest, self.tree, len(p))
        pad(p, one.x)
        leaf = self.tree.nodes - len(self.rest.centre) // 8
        affine.lie(self.rest, one.x, leaf, one.boxes, self.scratch.tile, one.lie)
        self.seen.append(one)
        return one

    def _met(self, begin: _Seen, end: _Seen, limits: Limits) -> int:
        """Find cluster pairs to test in addition to those close at rest; return their number, -1 if out of memory."""
        known, pairs = self.known, self.pairs
        here, there = begin.boxes, end.boxes
        for around in (here, there):
            trees.lift(around, len(self.tree.corners))
        many = trees.look(
            self.tree, self.tree, (here, here), (there, there), limits, True, self.scratch.stack, pairs.patches[known:]
        )
        if known + many > len(pairs.patches):
            return -1
        count = strange(pairs.patches, self.starts, many)
        pairs.apart[known : known + count] = self.looked
        flat.relate(self.rest, known, known + count, pairs)
        return count

    def _pairs(self, patches: Indices, x: Array, y: Array, limits: Limits) -> Pairs | None:
        """Return the primitive pairs of cluster pairs (k, 2) whose boxes may violate the limits; None if too many."""
        memory = self.scratch
        owned = self.points, self.edges, self.triangles
        first, many = among(owned, patches, x, y, limits, memory.here, memory.there, memory.found)
        if many > len(memory.found):
            return None
        nothing = np.empty(0)
        return Pairs(memory.found[:many], first, np.ones(many), nothing, nothing, limits.reach, 0.0)

    def _knowing(self, rest: Positions) -> Patches:
        """Return the clusters with the pairs that are close at rest (n, 3)."""
        limits = Limits(self.looked, self.looked, 0.0, 0.0)
        many, at, pairs = len(self.tree.corners), self._lies(rest, limits), self.pairs
        others = self._met(at, at, limits)
        if not 0 <= others <= len(pairs.patches) // 2:
            return replace(self, seen=[], crowded=True)
        each = np.arange(many)
        met = np.concatenate([np.column_stack([each, each]), pairs.patches[:others]])
        known = len(met)
        pairs.patches[:known] = met[np.lexsort((met[:, 1], met[:, 0]))]
        for k in range(known):
            near = self._pairs(pairs.patches[k : k + 1], at.x, at.x, limits)
            pairs.apart[k] = distances(near, rest).min(initial=self.looked) if near else 0.0
        flat.relate(self.rest, 0, known, pairs)
        starts = np.searchsorted(pairs.patches[:known, 0], np.arange(many + 1))
        return replace(self, starts=starts, seen=[])

    @property
    def known(self) -> int:
        """Number of cluster pairs that are close at rest."""
        return int(self.starts[-1])


class _Seen(NamedTuple):
    """Poses and bounding boxes of clusters at x (n, 4), padded positions."""

    x: Array
    lie: Lie
    boxes: Array

    @classmethod
    def of(cls, rest: Rest, tree: Tree, vertices: int) -> _Seen:
        """Allocate a snapshot."""
        many = len(rest.centre)
        around = np.empty((tree.nodes, 6, 8))
        around[:, :3], around[:, 3:] = np.inf, -np.inf
        lies = Lie(*(np.zeros((many, 4)) for _ in Lie._fields))
        return cls(np.empty((vertices, 4)), lies, around)


@kernel
def strange(pairs, starts, many):
    """Remove the last pairs that are close at rest, which are stored already, and compact the others.

    Args:
        pairs: cluster pairs (k, 2), those close at rest first; updated.
        starts: first pair of each cluster (clusters + 1,).
        many: number of pairs after those close at rest.

    Returns:
        Number of remaining new pairs.
    """
    known = starts[-1]
    count = known
    for e in range(known, known + many):
        a, b = pairs[e, 0], pairs[e, 1]
        new = True
        for k in range(starts[a], starts[a + 1]):
            new &= pairs[k, 1] != b
        if new:
            pairs[count, 0], pairs[count, 1] = a, b
            count += 1
    return count - known
