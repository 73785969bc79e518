"""Which primitives patches of a surface own, and which of those of two patches may come near each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from solvers.compiling import inner, kernel
from solvers.contact.boxes import Indices, box, enclose, hull, met, share_vertex
from solvers.vectors.eights import lowest


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


@kernel
def among(owned, patches, x, y, limits, here, there, out):
    """Write the vertices of primitives of pairs of patches (k, 2) that may come to their limits, by their boxes on the
    way from x to y, (n, 4) both, to `out` (room, 4): points and triangles, then edges. How many are of the first
    kind, and of both; more than there is room for where that does not suffice. here, there: scratch."""
    points, edges, triangles = owned
    count = 0
    for k in range(len(patches)):
        if count > len(out):
            break
        a, b = patches[k, 0], patches[k, 1]
        count = _against(points, a, triangles, b, x, y, limits, here, there, out, count)
        if a != b:
            count = _against(points, b, triangles, a, x, y, limits, here, there, out, count)
    first = count
    for k in range(len(patches)):
        if count > len(out):
            break
        count = _against(edges, patches[k, 0], edges, patches[k, 1], x, y, limits, here, there, out, count)
    return first, count


@inner
def _against(one, a, other, b, x, y, limits, here, there, out, count):
    """Those of a kind of patch a with another kind of patch b; how many there are then."""
    begin, end, wide = other.starts[b], other.starts[b + 1], one.corners.shape[1]
    eights = (end - begin + 7) // 8
    for f in range(begin, end):
        node, slot = (f - begin) // 8, (f - begin) % 8
        enclose(other.corners, f, x, here[node], slot)
        enclose(other.corners, f, y, there[node], slot)
    _above(here, eights, end - begin)
    _above(there, eights, end - begin)
    for e in range(one.starts[a], one.starts[a + 1]):
        low, high = box(one.corners, e, x)
        lower, upper = box(one.corners, e, y)
        for above in range(0, eights, 8):
            near = met(here, there, eights + above // 8, low, high, lower, upper, limits)
            while near != 0:
                node = above + lowest(near)
                near &= near - 1
                first = begin + 8 * node
                own = node < eights and (wide == 1 or a != b or first + 7 > e)
                left = met(here, there, node, low, high, lower, upper, limits) if own else 0
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


@inner
def _above(boxes, eights, many):
    """Write the boxes of eights of so many boxes, eight by eight, after them."""
    for node in range(eights):
        low, high = hull(boxes[node], min(8, many - 8 * node))
        above, slot = boxes[eights + node // 8], node % 8
        for axis in range(3):
            above[axis, slot], above[3 + axis, slot] = low[axis], high[axis]
