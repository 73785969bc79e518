"""Polygonal faces: triangulation, vertex areas and duplicates, independent of a face's first corner.

Triangles: a convex quadrangle is split along its shorter diagonal; a convex face with more corners is a fan from its
lowest-numbered vertex; other faces are triangulated by ear clipping, shortest diagonal first (Meisters 1975,
"Polygons have ears"). Lengths that differ by less than a millionth count as equal; the diagonal with the lowest
vertex numbers is then chosen. Convexity is tested in the plane normal to the vector area of the face.

Areas: for a convex face, the mean over the fans from all corners. In a quadrangle that is half of each diagonal's
thirds, which also equals the integral of the bilinear map; in a triangle it is thirds:

    a_i = (t_(i-1) + t_i)/3 + sum(t)/(3 k),     t_i the area of the mean of the k corners, corner i and corner i + 1

The area of a face that is not planar is that of its triangles; the a_i are scaled to that sum. Faces that are not
convex give each corner a third of its triangles.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.mesh.mesh_topology import IndexArray, PointArray, lump_areas

MAX_CONCAVE_CORNERS = 2_000
"""Maximum number of corners of a concave face, because ear clipping searches all corners for each ear."""
_ROUNDOFF = 16.0 * float(np.finfo(np.float64).eps)
"""Round-off of an area, relative to coordinates times face size."""
_EQUAL_TOLERANCE = 1e-6
"""Relative difference below which squared lengths count as equal."""
_INSIDE_TOLERANCE = 1e-9
"""Tolerance of point-in-triangle tests, relative to the triangle."""
_TESTS_PER_CHUNK = 1_000_000
"""Number of corners processed per chunk."""


class Triangulation(NamedTuple):
    """Triangulation of f faces of k corners.

    Attributes:
        triangles: (f, k - 2, 3), in the orientation of the faces.
        is_convex: (f,).
        is_self_crossing: (f,), faces with a self-crossing boundary, whose triangles are invalid.
    """

    triangles: IndexArray
    is_convex: NDArray[np.bool_]
    is_self_crossing: NDArray[np.bool_]

    def select_rows(self, rows: NDArray[np.bool_]) -> Triangulation:
        """Return the triangulation of some of the faces, rows (f,)."""
        return Triangulation(self.triangles[rows], self.is_convex[rows], self.is_self_crossing[rows])


def triangulate_polygons(rest: PointArray, polygons: IndexArray) -> Triangulation:
    """Triangulate faces of one number of corners.

    Args:
        rest: rest positions (n, 3) [m].
        polygons: vertices of each face (f, k), at least three.

    Returns:
        The triangulation. Faces that are not strictly convex count as self-crossing beyond MAX_CONCAVE_CORNERS corners.
    """
    f, k = polygons.shape
    if k == 3:
        return Triangulation(polygons.reshape(f, 1, 3), np.ones(f, np.bool_), np.zeros(f, np.bool_))
    some = max(1, _TESTS_PER_CHUNK // k)
    parts = [_triangulate_chunk(rest, polygons[i : i + some]) for i in range(0, f, some)]
    return Triangulation(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _triangulate_chunk(rest: PointArray, polygons: IndexArray) -> Triangulation:
    f, k = polygons.shape
    around: IndexArray = (polygons.argmin(axis=1)[:, None] + np.arange(k, dtype=np.int64)) % k
    corners = np.take_along_axis(polygons, around, axis=1)
    flat, slack = _project_to_plane(rest, corners)
    turns = _signed_double_areas(np.roll(flat, 1, axis=1), flat, np.roll(flat, -1, axis=1))
    convex = (turns >= -slack[:, None]).all(axis=1) & _winds_once(flat, slack)
    strict = convex & (turns > slack[:, None]).all(axis=1)
    triangles, failed = np.empty((f, k - 2, 3), np.int64), np.zeros(f, np.bool_)
    triangles[strict] = _split_quadrangles(rest, corners[strict]) if k == 4 else _fan_triangles(corners[strict])
    rows = np.flatnonzero(~strict)
    if len(rows) and k > MAX_CONCAVE_CORNERS:
        failed[rows] = True
    elif len(rows):
        triangles[rows], failed[rows] = _clip_ears(rest, corners[rows], flat[rows], slack[rows])
        rows = rows[~convex[rows]]
        failed[rows] |= _has_crossing_sides(flat[rows], slack[rows])
    return Triangulation(triangles, convex, failed)


def _split_quadrangles(rest: PointArray, corners: IndexArray) -> IndexArray:
    """Split convex quadrangles (f, 4) into triangles (f, 2, 3), the lowest corner first."""
    one, two = (((rest[corners[:, i + 2]] - rest[corners[:, i]]) ** 2).sum(axis=1) for i in (0, 1))
    other = one > (1.0 + _EQUAL_TOLERANCE) * two
    cuts = np.where(other[:, None], [0, 1, 3, 1, 2, 3], [0, 1, 2, 0, 2, 3])
    return _rotate_lowest_first(np.take_along_axis(corners, cuts, axis=1).reshape(-1, 2, 3))


def _fan_triangles(corners: IndexArray) -> IndexArray:
    """Split faces (f, k) into fans (f, k - 2, 3) around their first corners."""
    first = np.repeat(corners[:, :1], corners.shape[1] - 2, axis=1)
    return np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=2)


def _rotate_lowest_first(triangles: IndexArray) -> IndexArray:
    """Rotate each triangle (..., 3) so that its lowest corner is first."""
    lowest = triangles.argmin(axis=-1)[..., None]
    return np.take_along_axis(triangles, (lowest + np.arange(3)) % 3, axis=-1)


def compute_vertex_areas(rest: PointArray, polygons: IndexArray, surface: Triangulation) -> PointArray:
    """Compute the area of faces that each vertex represents.

    Args:
        rest: rest positions (n, 3) [m].
        polygons: vertices of each face (f, k).
        surface: triangulation of these faces.

    Returns:
        Area of each vertex, summed over its faces, (n,) [m^2].
    """
    if polygons.shape[1] == 3:
        return lump_areas(rest, polygons)
    faces = polygons[surface.is_convex]
    areas = lump_areas(rest, surface.triangles[~surface.is_convex].reshape(-1, 3))
    p = rest[faces]
    p = p - p[:, :1]
    p = p - p.mean(axis=1, keepdims=True)
    t = np.linalg.norm(np.cross(p, np.roll(p, -1, axis=1)), axis=2) / 2
    shares = (t + np.roll(t, 1, axis=1)) / 3 + t.sum(axis=1, keepdims=True) / (3 * faces.shape[1])
    a, b, c = (rest[surface.triangles[surface.is_convex][..., i]] for i in range(3))
    whole = np.linalg.norm(np.cross(b - a, c - a), axis=2).sum(axis=1) / 2
    around = t.sum(axis=1)
    shares *= np.divide(whole, around, out=np.zeros_like(whole), where=around > 0.0)[:, None]
    return areas + np.bincount(faces.ravel(), shares.ravel(), minlength=len(rest))


def find_repeated_rows(cells: IndexArray) -> IndexArray:
    """Return for each cell (f, k) the index of the first cell with the same vertices, (f,).

    The order of vertices is ignored.
    """
    rows = np.sort(cells, axis=1)
    order = np.lexsort(rows.T[::-1]) if len(rows) > 1 else np.arange(len(rows))  # stable: the first one leads
    new = np.ones(len(rows), np.bool_)
    new[1:] = (rows[order][1:] != rows[order][:-1]).any(axis=1)
    first = np.empty(len(rows), np.int64)
    first[order] = order[np.flatnonzero(new)][np.cumsum(new) - 1]
    return first


class FaceCover(NamedTuple):
    """Faces that are parts of larger faces.

    Attributes:
        corners: number of corners of the smaller faces.
        rows: indices of these faces, (c,).
        larger_corners: number of corners of the larger faces.
        larger_rows: index of the larger face that contains each of them, (c,).
    """

    corners: int
    rows: IndexArray
    larger_corners: int
    larger_rows: IndexArray


def find_face_covers(
    rest: PointArray, polygons: Mapping[int, IndexArray], surfaces: Mapping[int, Triangulation]
) -> list[FaceCover]:
    """Find faces that are part of a larger face.

    Their corners are corners of the larger face, and they lie inside it.

    Args:
        rest: rest positions (n, 3) [m].
        polygons: number of corners k -> vertices of each face (f, k).
        surfaces: number of corners k -> triangulation of these faces.

    Returns:
        For each two numbers of corners, the smaller faces, each with one larger face that contains it.
    """
    sizes = [k for k in sorted(polygons) if k >= 3 and len(polygons[k])]
    if len(sizes) < 2:
        return []
    from scipy.sparse import csr_array

    def incidence(faces: IndexArray) -> csr_array:
        ends = np.arange(len(faces) + 1) * faces.shape[1]
        return csr_array((np.ones(faces.size, np.int32), faces.ravel(), ends), shape=(len(faces), len(rest)))

    found: list[FaceCover] = []
    for small, large in combinations(sizes, 2):
        common = (incidence(polygons[small]) @ incidence(polygons[large]).T).tocoo()
        shared = common.data == small
        part, whole = (np.asarray(x[shared], np.int64) for x in common.coords)
        inside = _covers_midpoints(rest, surfaces[large].triangles[whole], surfaces[small].triangles[part])
        rows, first = np.unique(part[inside], return_index=True)
        if len(rows):
            found.append(FaceCover(small, rows, large, whole[inside][first]))
    return found


def _covers_midpoints(rest: PointArray, large: IndexArray, small: IndexArray) -> NDArray[np.bool_]:
    """Return whether the midpoints of triangles small (c, s, 3) lie in triangles of large (c, l, 3).

    The test is in the projection along the normal of the large face.
    """
    a, b, c = (rest[large[..., i]] for i in range(3))
    normal = np.cross(b - a, c - a).sum(axis=1)
    middle = rest[small].mean(axis=2)[:, :, None]
    margin = -_INSIDE_TOLERANCE * (normal**2).sum(axis=1)[:, None, None]
    inside = np.ones((len(large), small.shape[1], large.shape[1]), np.bool_)
    for p, q in ((a, b), (b, c), (c, a)):
        turn = np.cross((q - p)[:, None], middle - p[:, None])
        inside &= np.einsum("csli,ci->csl", turn, normal) >= margin
    return inside.any(axis=2).all(axis=1)


def _project_to_plane(rest: PointArray, corners: IndexArray) -> tuple[PointArray, PointArray]:
    """Project corners (f, k) to the plane normal to the vector area.

    Return the projections (f, k, 2) [m] and the round-off (f,) of twice the area.
    """
    p = rest[corners]
    farthest = np.abs(p).max(axis=(1, 2))
    p = p - p[:, :1]
    size = np.linalg.norm(np.ptp(p, axis=1), axis=1)
    normal = np.cross(p, np.roll(p, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    slack = _ROUNDOFF * farthest * size
    # Lobes may cancel: then the plane of the largest corner shows how the face crosses itself.
    sides = np.roll(p, -1, axis=1) - p
    turns = np.cross(np.roll(sides, 1, axis=1), sides)
    largest = turns[np.arange(len(p)), np.linalg.norm(turns, axis=2).argmax(axis=1)]
    normal = np.where(length > slack[:, None], normal, largest)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.tile([0.0, 0.0, 1.0], (len(p), 1)), where=length > 0.0)
    axis = np.eye(3)[np.abs(normal).argmin(axis=1)]
    u = np.cross(axis, normal)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normal, u)
    flat = np.stack([np.einsum("fkx,fx->fk", p, u), np.einsum("fkx,fx->fk", p, v)], axis=2)
    return flat, slack


def _signed_double_areas(a: PointArray, b: PointArray, c: PointArray) -> PointArray:
    """Compute twice the signed areas of triangles in the plane, (..., 2) each."""
    one, two = b - a, c - b
    return one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]


def _winds_once(flat: PointArray, slack: PointArray) -> NDArray[np.bool_]:
    """Return whether closed left-turning paths (f, k, 2) have winding number 1; a pentagram has 2."""
    if flat.shape[1] == 4:
        return np.ones(len(flat), np.bool_)
    sides = np.roll(flat, -1, axis=1) - flat
    angle = np.arctan2(sides[..., 1], sides[..., 0])
    turned = np.mod(np.roll(angle, -1, axis=1) - angle + np.pi, 2 * np.pi) - np.pi
    return np.abs(turned.sum(axis=1)) < 3 * np.pi


def _has_crossing_sides(flat: PointArray, slack: PointArray) -> NDArray[np.bool_]:
    """Return whether two sides of a closed path (f, k, 2) cross; contact without crossing does not count."""
    k = flat.shape[1]
    a, b, found = flat, np.roll(flat, -1, axis=1), np.zeros(len(flat), np.bool_)
    for shift in range(2, k // 2 + 1):
        c, d = np.roll(a, -shift, axis=1), np.roll(b, -shift, axis=1)
        sides = [
            _signed_double_areas(a, b, c),
            _signed_double_areas(a, b, d),
            _signed_double_areas(c, d, a),
            _signed_double_areas(c, d, b),
        ]
        apart = np.min(np.abs(sides), axis=0) > slack[:, None]
        found |= (apart & (sides[0] * sides[1] < 0.0) & (sides[2] * sides[3] < 0.0)).any(axis=1)
    return found


def _clip_ears(
    rest: PointArray, corners: IndexArray, flat: PointArray, slack: PointArray
) -> tuple[IndexArray, NDArray[np.bool_]]:
    """Triangulate faces (f, k) by ear clipping.

    Return the triangles (f, k - 2, 3), and which faces (f,) have corners but no ears left.
    """
    f, k = corners.shape
    triangles, failed = np.zeros((f, k - 2, 3), np.int64), np.zeros(f, np.bool_)
    around: IndexArray = np.arange(k, dtype=np.int64)
    before: IndexArray = np.tile(np.roll(around, 1), (f, 1))
    after: IndexArray = np.tile(np.roll(around, -1), (f, 1))
    there, rejected = np.ones((f, k), np.bool_), np.zeros((f, k), np.bool_)
    clipped, since = np.zeros(f, np.int64), np.zeros(f, np.int64)  # since: ears clipped since rejections were cleared
    every: IndexArray = np.arange(f, dtype=np.int64)
    turn = _signed_double_areas(
        np.take_along_axis(flat, before[..., None], 1), flat, np.take_along_axis(flat, after[..., None], 1)
    )
    squared = _squared_diagonals(rest, corners, before, after)
    while len(every):
        r: IndexArray = every
        left = there[r] & ~rejected[r]
        ears = left & (turn[r] > slack[r, None])
        lost: NDArray[np.bool_] = np.logical_not(ears.any(axis=1))
        again = lost & (since[r] > 0) & rejected[r].any(axis=1)
        rejected[r[again]] = False
        since[r[again]] = 0
        empty = left & (np.abs(turn[r]) <= slack[r, None])  # without any ear, corners without area are clipped
        ears = np.where((lost & ~again)[:, None], empty, ears)
        failed[r[lost & ~again & ~ears.any(axis=1)]] = True
        some = np.flatnonzero(ears.any(axis=1))
        r, ears, forced = r[some], ears[some], lost[some]
        tip = _choose_shortest_ear(ears, squared[r], corners[r], before[r], after[r])
        a, c = before[r, tip], after[r, tip]
        blocked = ~forced & _is_ear_blocked(flat[r], there[r], a, tip, c, slack[r])
        rejected[r[blocked], tip[blocked]] = True
        r, a, tip, c = r[~blocked], a[~blocked], tip[~blocked], c[~blocked]
        triangles[r, clipped[r]] = np.stack([corners[r, a], corners[r, tip], corners[r, c]], axis=1)
        there[r, tip] = False
        after[r, a], before[r, c] = c, a
        for end in (a, c):
            b, d = before[r, end], after[r, end]
            turn[r, end] = _signed_double_areas(flat[r, b], flat[r, end], flat[r, d])
            squared[r, end] = ((rest[corners[r, d]] - rest[corners[r, b]]) ** 2).sum(axis=1)
            rejected[r, end] = False
        clipped[r] += 1
        since[r] += 1
        every = every[~failed[every] & (clipped[every] < k - 3)]
    last = np.argsort(~there, axis=1, kind="stable")[:, :3]
    triangles[:, -1] = np.take_along_axis(corners, last, axis=1)
    return _rotate_lowest_first(triangles), failed


def _squared_diagonals(rest: PointArray, corners: IndexArray, before: IndexArray, after: IndexArray) -> PointArray:
    """Compute the squared distance (f, k) [m^2] of each corner's neighbours."""
    one, two = (rest[np.take_along_axis(corners, index, axis=1)] for index in (before, after))
    return ((two - one) ** 2).sum(axis=2)


def _choose_shortest_ear(
    ears: NDArray[np.bool_], squared: PointArray, corners: IndexArray, before: IndexArray, after: IndexArray
) -> IndexArray:
    """Choose the ear with the shortest diagonal, (f,).

    Ties are decided by the lowest vertex numbers.
    """
    shortest = np.where(ears, squared, np.inf)
    tied = ears & (shortest <= (1.0 + _EQUAL_TOLERANCE) * shortest.min(axis=1, keepdims=True))
    one, two = (np.take_along_axis(corners, index, axis=1) for index in (before, after))
    most = np.iinfo(np.int64).max
    for key in (np.minimum(one, two), np.maximum(one, two), corners):
        key = np.where(tied, key, most)
        tied &= key == key.min(axis=1, keepdims=True)
    return tied.argmax(axis=1)


def _is_ear_blocked(
    flat: PointArray, there: NDArray[np.bool_], a: IndexArray, b: IndexArray, c: IndexArray, slack: PointArray
) -> NDArray[np.bool_]:
    """Return whether another corner lies in the triangle of corners a, b, c (f,).

    The sides belong to the triangle, its corners do not.
    """
    rows = np.arange(len(flat))
    p, q, s = (flat[rows, x][:, None] for x in (a, b, c))
    margin = -slack[:, None]
    inside = (
        (_signed_double_areas(p, q, flat) >= margin)
        & (_signed_double_areas(q, s, flat) >= margin)
        & (_signed_double_areas(s, p, flat) >= margin)
    )
    for corner in (p, q, s):
        inside &= ((flat - corner) ** 2).sum(axis=2) > slack[:, None]
    return (inside & there).any(axis=1)
