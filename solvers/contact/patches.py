"""Whether nothing of a surface comes near anything else of it on a way, told without looking at its primitives.

The surface is cut into patches of some vertices each, which own the points, edges and triangles whose first vertex
along the curve is theirs. Patches that are near each other at rest are told by how they lie (`solvers.contact.flat`),
all others by boxes around them; primitives are looked at only where neither tells. What is kept of a surface is its
rest shape alone, so that a motion as long as it likes costs no more than a short one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact import boxes, flat, ways
from solvers.contact.barrier import distances
from solvers.contact.boxes import Indices, Tree, box, enclose, met, share_vertex
from solvers.contact.contacts import Pairs, padded
from solvers.contact.flat import Lie, Rest
from solvers.contact.ways import unevenness
from solvers.problem import Positions
from solvers.vectors.eights import lowest

Array = NDArray[np.float64]

_PATCH = 16
"""Vertices of a patch, beside those of its neighbours that its primitives have."""

_FEW = 4096
"""Primitives that are looked at; where more may come near, something is."""


class Owned(NamedTuple):
    """Primitives (m, k) in the order of the patches that own them, and where those of each begin (patches + 1,)."""

    corners: Indices
    starts: Indices

    @classmethod
    def of(cls, corners: Indices, rank: Indices, many: int) -> Owned:
        """Primitives of which each belongs to the patch of lowest rank (n,) among its vertices."""
        owner = rank[corners].min(axis=1)
        starts = np.append(0, np.cumsum(np.bincount(owner, minlength=many)))
        return cls(np.ascontiguousarray(corners[np.argsort(owner, kind="stable")]), starts)

    def members(self) -> Indices:
        """Patches and the vertices of their primitives (k, 2)."""
        patch = np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))
        return np.column_stack([np.repeat(patch, self.corners.shape[1]), self.corners.ravel()])


class Scratch(NamedTuple):
    """Memory of a look: tile (3 k, 8); stack; met: pairs of patches (k, 2); apart (k,): of these at rest [m]; doubtful:
    those of them that nothing tells apart; here, there (k, 6, 8): boxes of a patch's primitives; found (k, 4): pairs of
    primitives."""

    tile: Array
    stack: Indices
    met: Indices
    apart: Array
    doubtful: Indices
    here: Array
    there: Array
    found: Indices


@dataclass(frozen=True, eq=False)
class Patches:
    """Those of a surface. known (k, 2): pairs that are near each other at rest, sorted, and apart (k,): by how much
    [m]; looked [m]: all others are farther apart; seen: how patches lay at the last two positions; crowded: whether so
    many are near each other at rest, as in a stack of sheets, that patches tell nothing."""

    rest: Rest
    tree: Tree
    points: Owned
    edges: Owned
    triangles: Owned
    looked: float
    known: Indices
    apart: Array
    scratch: Scratch
    seen: list[_Seen] = field(default_factory=list["_Seen"])
    crowded: bool = False

    @classmethod
    def of(cls, rest: Positions, points: Tree, edges: Tree, triangles: Tree, looked: float) -> Patches:
        """Those of a rest shape (n, 3) [m]."""
        many = max(1, -(-len(points.corners) // _PATCH))
        rank = np.zeros(len(rest), np.int64)
        rank[points.corners[:, 0]] = np.arange(len(points.corners)) // _PATCH
        owned = [Owned.of(tree.corners, rank, many) for tree in (points, edges, triangles)]
        at_rest = flat.rest(rest, np.concatenate([one.members() for one in owned]), many)
        tree, most = Tree.over(many), max(int(np.diff(one.starts).max()) for one in owned)
        room, eights = 24 * many + 8, -(-most // 8)
        scratch = Scratch(
            tile=np.empty((3 * at_rest.vertices.shape[1], 8)),
            stack=boxes.stack(),
            met=np.empty((room, 2), np.int64),
            apart=np.empty(room + 8),
            doubtful=np.empty((room, 2), np.int64),
            here=np.empty((eights, 6, 8)),
            there=np.empty((eights, 6, 8)),
            found=np.empty((_FEW, 4), np.int64),
        )
        bare = cls(at_rest, tree, owned[0], owned[1], owned[2], looked, scratch.met[:0], scratch.apart[:0], scratch)
        return bare._knowing(rest)

    def clear(self, p: Positions, q: Positions, reach: float, share: float) -> bool:
        """Whether no two primitives that share no vertex come nearer than `reach` [m], and `share` of their distance at
        p, on the straight way from p to q, (n, 3) both. False does not say that some do."""
        if self.crowded:
            return False
        begin, end, memory = self._lies(p), self._lies(q), self.scratch
        count = self._met(begin, end, reach, share)
        if count > len(memory.met):
            return False
        count = flat.doubtful(
            self.rest, begin.lie, end.lie, memory.met, count, memory.apart, reach, share, memory.doubtful
        )
        if not count:
            return True
        pairs = self._pairs(memory.doubtful[:count], begin.x, end.x, reach, share)
        if pairs is None:
            return False
        scratch = np.empty(4, np.int64), np.empty((4, 3)), np.empty((4, 3))
        return ways.largest(pairs, begin.x, padded(q - p), 1.0, *scratch) == 1.0

    def _lies(self, p: Positions) -> _Seen:
        for one in self.seen:
            if one.p.shape == p.shape and unevenness(one.p, p) == 0.0:
                return one
        one = self.seen.pop(0) if len(self.seen) > 1 else _Seen.of(self.rest, self.tree)
        one = one._replace(p=p.copy(), x=padded(p))
        leaf = self.tree.nodes - len(self.rest.centre) // 8
        flat.lie(self.rest, one.x, leaf, one.boxes, self.scratch.tile, one.lie)
        boxes.lift(one.boxes, len(self.tree.corners))
        self.seen.append(one)
        return one

    def _met(self, begin: _Seen, end: _Seen, reach: float, share: float) -> int:
        """How many pairs of patches have to be looked at: those that are known, and others whose boxes meet."""
        memory, known = self.scratch, len(self.known)
        memory.met[:known], memory.apart[:known] = self.known, self.apart
        here, there = begin.boxes, end.boxes
        others = boxes.look(
            self.tree, self.tree, (here, here), (there, there), reach, share, True, memory.stack, memory.met[known:]
        )
        if known + others > len(memory.met):
            return known + others
        return known + strange(self.known, memory.met, memory.apart, known, others, self.looked)

    def _pairs(self, patches: Indices, x: Array, y: Array, reach: float, share: float) -> Pairs | None:
        """Pairs of primitives of pairs of patches (k, 2) whose boxes may meet on the way from x to y, (n, 4) both; None
        where there are many."""
        memory = self.scratch
        owned = self.points, self.edges, self.triangles
        first, many = among(owned, patches, x, y, reach, share, memory.here, memory.there, memory.found)
        if many > len(memory.found):
            return None
        nothing = np.empty(0)
        return Pairs(memory.found[:many], first, np.ones(many), nothing, nothing, reach, 0.0)

    def _knowing(self, rest: Positions) -> Patches:
        """The same with pairs known that are near each other at rest (n, 3)."""
        many, at = len(self.tree.corners), self._lies(rest)
        others = self._met(at, at, self.looked, 0.0)
        if others > len(self.scratch.met) // 2:
            return replace(self, seen=[], crowded=True)
        each = np.arange(many)
        met = np.concatenate([np.column_stack([each, each]), self.scratch.met[:others]])
        met = np.ascontiguousarray(met[np.lexsort((met[:, 1], met[:, 0]))])
        apart = np.full(len(met), self.looked)
        for k in range(len(met)):
            pairs = self._pairs(met[k : k + 1], at.x, at.x, self.looked, 0.0)
            apart[k] = distances(pairs, rest).min(initial=self.looked) if pairs else 0.0
        return replace(self, known=met, apart=apart, seen=[])


class _Seen(NamedTuple):
    """How patches lie at p (n, 3), x: that with a column more; boxes: around them."""

    p: Positions
    x: Array
    lie: Lie
    boxes: Array

    @classmethod
    def of(cls, rest: Rest, tree: Tree) -> _Seen:
        """Space for it."""
        many = len(rest.centre)
        around = np.empty((tree.nodes, 6, 8))
        around[:, :3], around[:, 3:] = np.inf, -np.inf
        lies = Lie(*(np.zeros((many, 4)) for _ in Lie._fields))
        return cls(np.empty(0), np.empty(0), lies, around)


@kernel
def strange(known, met, apart, first, many, looked):
    """Leave those of many pairs of patches from the first one on that are not known (k, 2), `looked` [m] apart at rest;
    how many."""
    count = first
    for e in range(first, first + many):
        low, high = 0, len(known)
        while low < high:
            k = (low + high) // 2
            if known[k, 0] < met[e, 0] or (known[k, 0] == met[e, 0] and known[k, 1] < met[e, 1]):
                low = k + 1
            else:
                high = k
        if low == len(known) or known[low, 0] != met[e, 0] or known[low, 1] != met[e, 1]:
            met[count, 0], met[count, 1], apart[count] = met[e, 0], met[e, 1], looked
            count += 1
    return count - first


@kernel
def among(owned, patches, x, y, reach, share, here, there, out):
    """Write the vertices of primitives of pairs of patches (k, 2) that may come nearer than `reach` [m], and `share` of
    their distance at x, by their boxes on the way from x to y, (n, 4) both, to `out` (room, 4), as far as there is
    room: points and triangles, then edges. How many are of the first kind, and of both. here, there: scratch."""
    points, edges, triangles = owned
    count = 0
    for k in range(len(patches)):
        a, b = patches[k, 0], patches[k, 1]
        count = _against(points, a, triangles, b, x, y, reach, share, here, there, out, count)
        if a != b:
            count = _against(points, b, triangles, a, x, y, reach, share, here, there, out, count)
    first = count
    for k in range(len(patches)):
        count = _against(edges, patches[k, 0], edges, patches[k, 1], x, y, reach, share, here, there, out, count)
    return first, count


@inner
def _against(one, a, other, b, x, y, reach, share, here, there, out, count):
    """Those of a kind of patch a with another kind of patch b; how many there are then."""
    begin, end, wide = other.starts[b], other.starts[b + 1], one.corners.shape[1]
    for f in range(begin, end):
        node, slot = (f - begin) // 8, (f - begin) % 8
        enclose(other.corners, f, x, here[node], slot)
        enclose(other.corners, f, y, there[node], slot)
    for e in range(one.starts[a], one.starts[a + 1]):
        low, high = box(one.corners, e, x)
        lower, upper = box(one.corners, e, y)
        for first in range(begin, end, 8):
            left = met(here, there, (first - begin) // 8, low, high, lower, upper, reach, share)
            while left != 0:
                f = first + lowest(left)
                left &= left - 1
                own = f < end and (wide == 1 or a != b or f > e)
                if own and not share_vertex(one.corners, e, other.corners, f):
                    if count < len(out):
                        for c in range(wide):
                            out[count, c] = one.corners[e, c]
                        for c in range(4 - wide):
                            out[count, wide + c] = other.corners[f, c]
                    count += 1
    return count
