"""Active collisions at a position: the distinct closest point pairs of all candidates.

If a closest point is a vertex or lies on an edge, all triangles and edges around it share it. One point-point or
point-edge collision then represents many pairs, with the sum of their stiffnesses (counted in the same way by Li et al.
2020, "Incremental potential contact", section 5). Pairs with a mollifier, which depends on four vertices, and pairs
with scaled distances remain separate. Distances are computed in 8-lane packets.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.contact.closest import dot, edge_edge_way, point_triangle_way
from solvers.vectors.eights import bits, lowest, rows, stored

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

POINTS, POINT_EDGE, POINT_TRIANGLE, EDGES = 2, 3, 4, 5
"""Kinds of collisions."""


class Pairs(NamedTuple):
    """Candidate pairs: point-triangle pairs, then edge-edge pairs.

    Attributes:
        vertices: vertices of each pair (k, 4).
        points: number of point-triangle pairs.
        scale: factor on `thickness` and `reach`, at most 1, (k,).
        stiffness: barrier stiffness [N/m], (k,).
        parallel: e of the mollifier [m^4], 0 for point-triangle pairs, (k,).
        thickness: minimum distance [m].
        reach: barrier activation distance beyond the minimum distance [m].
    """

    vertices: Indices
    points: int
    scale: Array
    stiffness: Array
    parallel: Array
    thickness: float
    reach: float


class Contacts(NamedTuple):
    """Active collisions.

    Attributes:
        vertices: (a, 4); point-point collisions repeat their second vertex, point-edge ones their third.
        kind: kind of each collision (a,).
        weights: c of the distance vector (a, 4).
        between: z [m], (a, 3).
        stiffness: sum over all pairs that the collision represents [N/m], (a,).
        scale: as for candidates, (a,).
        parallel: as for candidates, 0 where no mollifier is active, (a,).
        crossed: |u x v|^2 of edge pairs [m^4], (a,).
        thickness: minimum distance [m].
        reach: barrier activation distance beyond the minimum distance [m].
    """

    vertices: Indices
    kind: Indices
    weights: Array
    between: Array
    stiffness: Array
    scale: Array
    parallel: Array
    crossed: Array
    thickness: float
    reach: float


def room(many: int, thickness: float, reach: float) -> Contacts:
    """Allocate uninitialised collisions.

    Args:
        many: number of collisions.
        thickness: minimum distance [m].
        reach: barrier activation distance [m].
    """
    return Contacts(
        vertices=np.empty((many, 4), np.int64),
        kind=np.empty(many, np.int64),
        weights=np.empty((many, 4)),
        between=np.empty((many, 3)),
        stiffness=np.empty(many),
        scale=np.empty(many),
        parallel=np.empty(many),
        crossed=np.empty(many),
        thickness=thickness,
        reach=reach,
    )


def in_range(pairs: Pairs, x: Array, space: Contacts) -> Contacts:
    """Build the active collisions at a position.

    Args:
        pairs: candidate pairs.
        x: positions (n, 4) [m]; column 3 is padding.
        space: collisions of at least the number of candidates; overwritten.

    Returns:
        Collisions that are views of the buffer.
    """
    slots = np.empty(1 << (2 * len(pairs.vertices)).bit_length(), np.int32)
    count = gather(pairs, x, np.empty((9, 8)), slots, space)
    written: Any = (a[:count] for a in space[:-2])
    return Contacts(*written, thickness=pairs.thickness, reach=pairs.reach)


@kernel
def gather(pairs, x, tile, slots, out):
    """Write the active collisions to `out`, and return their number.

    Args:
        pairs: candidate pairs.
        x: positions (n, 4) [m]; column 3 is padding.
        tile: scratch (9, 8).
        slots: hash table, (2^s,), of more entries than candidates; overwritten.
        out: collisions of at least the number of candidates.
    """
    slots[:] = -1
    count, end, edges = 0, pairs.points, False
    limit = (pairs.thickness + pairs.reach) ** 2
    for _ in range(2):
        begin, end = (end, len(pairs.vertices)) if edges else (0, end)
        for first in range(begin, end, 8):
            left = eight(pairs.vertices, x, first, end - 1, edges, limit, tile)
            while left != 0:
                lane = lowest(left)
                left &= left - 1
                if first + lane < end:
                    count = take(pairs, first + lane, edges, tile, lane, slots, out, count)
        edges = True
    return count


@inner
def eight(vertices, x, first, last, edges, limit, tile):
    """Return as bits which of eight pairs have |z|^2 below a limit.

    The rows of the tile (9, 8) get c, z, |z|^2 and |u x v|^2. Lanes beyond `last` repeat that pair.
    """
    a, b = rows(x, vertices, first, last, 0), rows(x, vertices, first, last, 1)
    c, d = rows(x, vertices, first, last, 2), rows(x, vertices, first, last, 3)
    if edges:
        c0, c1, c2, c3, z, area = edge_edge_way(a, b, c, d)
    else:
        c0, c1, c2, c3, z = point_triangle_way(a, b, c, d)
        area = 0.0 * c0
    squared = dot(z, z)
    stored(c0, tile, 0)
    stored(c1, tile, 8)
    stored(c2, tile, 16)
    stored(c3, tile, 24)
    stored(z[0], tile, 32)
    stored(z[1], tile, 40)
    stored(z[2], tile, 48)
    stored(squared, tile, 56)
    stored(area, tile, 64)
    return bits(squared < limit)


@inner
def take(pairs, e, edges, tile, lane, slots, out, count):
    """Add a pair if it is active, merging equal point-point and point-edge ones; return the new count."""
    scale = pairs.scale[e]
    if scale < 1.0 and not tile[7, lane] < (scale * (pairs.thickness + pairs.reach)) ** 2:
        return count
    x, c0, c1, c2, c3 = pairs.vertices[e], tile[0, lane], tile[1, lane], tile[2, lane], tile[3, lane]
    one, two = c0 != 0.0 and c1 != 0.0, c2 != 0.0 and c3 != 0.0
    sign, parallel = 1.0, pairs.parallel[e] if tile[8, lane] < pairs.parallel[e] else 0.0
    if parallel > 0.0 or (edges and one and two):
        kind, i, a, b, s, t = EDGES, x[0], x[1], x[2], c1, c2
    elif edges and one:
        kind, i, a, b, s, t, sign = POINT_EDGE, x[2] if c3 == 0.0 else x[3], x[0], x[1], -c0, -c1, -1.0
    elif edges:
        kind, i, a, b, s, t = POINT_EDGE if two else POINTS, x[0] if c1 == 0.0 else x[1], x[2], x[3], c2, c3
    else:
        i, a, b, s, t = x[0], x[1], x[2], c1, c2
        kind = POINT_TRIANGLE
        if c3 == 0.0 or c2 == 0.0 or c1 == 0.0:
            if c1 == 0.0:
                a, s, b, t = x[3], c3, x[2], c2
            elif c2 == 0.0:
                b, t = x[3], c3
            kind = POINT_EDGE if s != 0.0 and t != 0.0 else POINTS
    if kind == POINTS:
        a = a if s != 0.0 else b
        if a < i:
            i, a, sign = a, i, -sign
        b, s, t = a, -1.0, 0.0
    elif kind == POINT_EDGE and b < a:
        a, b, s, t = b, a, t, s
    if kind <= POINT_EDGE and scale == 1.0:
        # Neighbouring vertices have nearby indices, so nearby slots keep the table in cache.
        slot = (16 * i + ((5 * a + b) & 15)) & (len(slots) - 1)
        while slots[slot] >= 0:
            k = slots[slot]
            known = out.vertices[k]
            if known[0] == i and known[1] == a and known[2] == b:
                out.stiffness[k] += pairs.stiffness[e]
                return count
            slot = (slot + 1) & (len(slots) - 1)
        slots[slot] = count
    found, c, z = out.vertices[count], out.weights[count], out.between[count]
    if kind <= POINT_EDGE:
        found[0], found[1], found[2], found[3] = i, a, b, b
        c[0], c[1], c[2], c[3] = 1.0, s, t, 0.0
    else:
        found[0], found[1], found[2], found[3] = x[0], x[1], x[2], x[3]
        c[0], c[1], c[2], c[3] = c0, c1, c2, c3
    z[0], z[1], z[2] = sign * tile[4, lane], sign * tile[5, lane], sign * tile[6, lane]
    out.kind[count], out.stiffness[count], out.scale[count] = kind, pairs.stiffness[e], scale
    out.parallel[count], out.crossed[count] = parallel, tile[8, lane]
    return count + 1


def padded(p: Array) -> Array:
    """Return positions (n, 3) padded to (n, 4): a row then fits one vector load."""
    x = np.empty((len(p), 4))
    pad(p, x)
    return x


@kernel
def pad(p, x):
    """Copy positions p (n, 3) to x (n, 4), with a zero last column.

    NumPy takes seven times as long for such short rows.
    """
    for i in range(len(p)):
        x[i, 0], x[i, 1], x[i, 2], x[i, 3] = p[i, 0], p[i, 1], p[i, 2], 0.0
