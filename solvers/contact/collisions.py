"""Active collisions at a position: the distinct closest point pairs of all candidates.

If a closest point is a vertex or lies on an edge, all triangles and edges around it share it. One point-point or
point-edge collision then represents many pairs, with the sum of their stiffnesses (counted likewise by Li et al.
2020, "Incremental potential contact", section 5). Pairs with a mollifier, which depends on four vertices, and pairs
with scaled distances remain separate. Distances are computed in 8-lane packets.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.geometry.distance import (
    dot3,
    edge_edge_distance_vector,
    point_triangle_distance_vector,
)
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.simd.float64x8 import gather_rows, lowest_set_bit, mask_to_bits, store_packet

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

POINT_POINT, POINT_EDGE, POINT_TRIANGLE, EDGE_EDGE = 2, 3, 4, 5
"""Kinds of collisions, in this order: equal collisions up to POINT_EDGE are merged."""


class Candidates(NamedTuple):
    """Candidate pairs: point-triangle pairs, then edge-edge pairs.

    Attributes:
        vertices: vertices of each pair (k, 4).
        num_point_triangle: number of point-triangle pairs.
        distance_scale: factor on `min_distance` and `dhat`, at most 1, (k,).
        stiffness: barrier stiffness [N/m], (k,).
        mollifier_threshold: e of the mollifier [m^4], 0 for point-triangle pairs, (k,).
        min_distance: minimum distance [m].
        dhat: barrier activation distance beyond the minimum distance [m].
    """

    vertices: IndexArray
    num_point_triangle: int
    distance_scale: FloatArray
    stiffness: FloatArray
    mollifier_threshold: FloatArray
    min_distance: float
    dhat: float


class Collisions(NamedTuple):
    """Active collisions.

    Attributes:
        vertices: (a, 4); point-point collisions repeat their second vertex, point-edge ones their third.
        kind: kind of each collision (a,).
        coefficients: c of the distance vector (a, 4).
        distance_vector: z [m], (a, 3).
        stiffness: sum over all pairs that the collision represents [N/m], (a,).
        distance_scale: as for candidates, (a,).
        mollifier_threshold: as for candidates, 0 where no mollifier is active, (a,).
        cross_squarednorm: |u x v|^2 of edge pairs [m^4], (a,).
        min_distance: minimum distance [m].
        dhat: barrier activation distance beyond the minimum distance [m].
    """

    vertices: IndexArray
    kind: IndexArray
    coefficients: FloatArray
    distance_vector: FloatArray
    stiffness: FloatArray
    distance_scale: FloatArray
    mollifier_threshold: FloatArray
    cross_squarednorm: FloatArray
    min_distance: float
    dhat: float


def allocate_collisions(capacity: int, min_distance: float, dhat: float) -> Collisions:
    """Allocate uninitialised collisions.

    Args:
        capacity: number of collisions.
        min_distance: minimum distance [m].
        dhat: barrier activation distance [m].
    """
    return Collisions(
        vertices=np.empty((capacity, 4), np.int64),
        kind=np.empty(capacity, np.int64),
        coefficients=np.empty((capacity, 4)),
        distance_vector=np.empty((capacity, 3)),
        stiffness=np.empty(capacity),
        distance_scale=np.empty(capacity),
        mollifier_threshold=np.empty(capacity),
        cross_squarednorm=np.empty(capacity),
        min_distance=min_distance,
        dhat=dhat,
    )


def build_collisions(candidates: Candidates, x: FloatArray, buffer: Collisions) -> Collisions:
    """Build the active collisions at a position.

    Args:
        candidates: candidate pairs.
        x: positions (n, 4) [m]; column 3 is padding.
        buffer: collisions of at least the number of candidates; overwritten.

    Returns:
        Collisions that are views of the buffer.
    """
    slots = np.empty(1 << (2 * len(candidates.vertices)).bit_length(), np.int32)
    count = gather_collisions(candidates, x, np.empty((9, 8)), slots, buffer)
    written: Any = (a[:count] for a in buffer[:-2])
    return Collisions(*written, min_distance=candidates.min_distance, dhat=candidates.dhat)


@jit_kernel
def gather_collisions(candidates, x, tile, slots, out):
    """Write the active collisions to `out`, and return their number.

    Args:
        candidates: candidate pairs.
        x: positions (n, 4) [m]; column 3 is padding.
        tile: scratch (9, 8).
        slots: hash table, (2^s,), of more entries than candidates; overwritten.
        out: collisions of at least the number of candidates.
    """
    slots[:] = -1
    count, end, edges = 0, candidates.num_point_triangle, False
    limit = (candidates.min_distance + candidates.dhat) ** 2
    for _ in range(2):
        begin, end = (end, len(candidates.vertices)) if edges else (0, end)
        for first in range(begin, end, 8):
            left = compute_packet_distances(candidates.vertices, x, first, end - 1, edges, limit, tile)
            while left != 0:
                lane = lowest_set_bit(left)
                left &= left - 1
                if first + lane < end:
                    count = insert_collision(candidates, first + lane, edges, tile, lane, slots, out, count)
        edges = True
    return count


@jit_inner
def compute_packet_distances(vertices, x, first, last, edges, limit, tile):
    """Return as bits which of eight pairs have |z|^2 below a limit.

    Args:
        vertices: vertices of each pair (k, 4).
        x: positions (n, 4) [m]; column 3 is padding.
        first: first of the eight pairs.
        last: last pair, which is repeated in lanes beyond it.
        edges: True for edge-edge pairs, False for point-triangle pairs.
        limit: limit of the squared distance [m^2].
        tile: output (9, 8); its rows get c (4), z (3) [m], |z|^2 [m^2] and |u x v|^2 [m^4], 0 for point-triangle pairs.
    """
    a, b = gather_rows(x, vertices, first, last, 0), gather_rows(x, vertices, first, last, 1)
    c, d = gather_rows(x, vertices, first, last, 2), gather_rows(x, vertices, first, last, 3)
    if edges:
        c0, c1, c2, c3, z, area = edge_edge_distance_vector(a, b, c, d)
    else:
        c0, c1, c2, c3, z = point_triangle_distance_vector(a, b, c, d)
        area = 0.0 * c0
    squared = dot3(z, z)
    store_packet(c0, tile, 0)
    store_packet(c1, tile, 8)
    store_packet(c2, tile, 16)
    store_packet(c3, tile, 24)
    store_packet(z[0], tile, 32)
    store_packet(z[1], tile, 40)
    store_packet(z[2], tile, 48)
    store_packet(squared, tile, 56)
    store_packet(area, tile, 64)
    return mask_to_bits(squared < limit)


@jit_inner
def insert_collision(candidates, e, edges, tile, lane, slots, out, count):
    """Add a pair if it is active, merging equal point-point and point-edge ones.

    Args:
        candidates: candidate pairs.
        e: index of the pair.
        edges: whether it is an edge-edge pair.
        tile: result of `compute_packet_distances` (9, 8).
        lane: column of the pair in the tile.
        slots: hash table (2^s,) of the indices of collisions, -1 for none; updated.
        out: collisions; row `count` is written, or the stiffness of an earlier one increased.
        count: number of collisions so far.

    Returns:
        The new number of collisions.
    """
    scale = candidates.distance_scale[e]
    if scale < 1.0 and not tile[7, lane] < (scale * (candidates.min_distance + candidates.dhat)) ** 2:
        return count
    x, c0, c1, c2, c3 = candidates.vertices[e], tile[0, lane], tile[1, lane], tile[2, lane], tile[3, lane]
    one, two = c0 != 0.0 and c1 != 0.0, c2 != 0.0 and c3 != 0.0
    sign, parallel = (
        1.0,
        candidates.mollifier_threshold[e] if tile[8, lane] < candidates.mollifier_threshold[e] else 0.0,
    )
    if parallel > 0.0 or (edges and one and two):
        kind, i, a, b, s, t = EDGE_EDGE, x[0], x[1], x[2], c1, c2
    elif edges and one:
        kind, i, a, b, s, t, sign = POINT_EDGE, x[2] if c3 == 0.0 else x[3], x[0], x[1], -c0, -c1, -1.0
    elif edges:
        kind, i, a, b, s, t = POINT_EDGE if two else POINT_POINT, x[0] if c1 == 0.0 else x[1], x[2], x[3], c2, c3
    else:
        i, a, b, s, t = x[0], x[1], x[2], c1, c2
        kind = POINT_TRIANGLE
        if c3 == 0.0 or c2 == 0.0 or c1 == 0.0:
            if c1 == 0.0:
                a, s, b, t = x[3], c3, x[2], c2
            elif c2 == 0.0:
                b, t = x[3], c3
            kind = POINT_EDGE if s != 0.0 and t != 0.0 else POINT_POINT
    if kind == POINT_POINT:
        a = a if s != 0.0 else b
        if a < i:
            i, a, sign = a, i, -sign
        b, s, t = a, -1.0, 0.0
    elif kind == POINT_EDGE and b < a:
        a, b, s, t = b, a, t, s
    if kind <= POINT_EDGE and scale == 1.0:
        # Neighbouring vertices have nearby indices, so nearby slots let the table stay in cache.
        slot = (16 * i + ((5 * a + b) & 15)) & (len(slots) - 1)
        while slots[slot] >= 0:
            k = slots[slot]
            known = out.vertices[k]
            if known[0] == i and known[1] == a and known[2] == b:
                out.stiffness[k] += candidates.stiffness[e]
                return count
            slot = (slot + 1) & (len(slots) - 1)
        slots[slot] = count
    found, c, z = out.vertices[count], out.coefficients[count], out.distance_vector[count]
    if kind <= POINT_EDGE:
        found[0], found[1], found[2], found[3] = i, a, b, b
        c[0], c[1], c[2], c[3] = 1.0, s, t, 0.0
    else:
        found[0], found[1], found[2], found[3] = x[0], x[1], x[2], x[3]
        c[0], c[1], c[2], c[3] = c0, c1, c2, c3
    z[0], z[1], z[2] = sign * tile[4, lane], sign * tile[5, lane], sign * tile[6, lane]
    out.kind[count], out.stiffness[count], out.distance_scale[count] = kind, candidates.stiffness[e], scale
    out.mollifier_threshold[count], out.cross_squarednorm[count] = parallel, tile[8, lane]
    return count + 1


def pad_positions(p: FloatArray) -> FloatArray:
    """Return positions (n, 3) padded to (n, 4): a row then fits one vector load."""
    x = np.empty((len(p), 4))
    copy_padded(p, x)
    return x


@jit_kernel
def copy_padded(p, x):
    """Copy positions to padded ones, with a zero last column.

    NumPy takes seven times as long for such short rows.

    Args:
        p: positions (n, 3) [m].
        x: output (n, 4) [m].
    """
    for i in range(len(p)):
        x[i, 0], x[i, 1], x[i, 2], x[i, 3] = p[i, 0], p[i, 1], p[i, 2], 0.0
