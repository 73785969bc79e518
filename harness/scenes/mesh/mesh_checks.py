"""Checks of meshes from other programs: suspicious features, their places, and a remedy.

Topology is that of the triangles: an edge with one triangle is on the boundary, one with three or more is not
manifold. Orientations are compared by the two-fold cover of the surface: two copies of each triangle, one flipped,
are connected where their orientations agree across an edge with two triangles. A surface is orientable if its copies
stay apart. Self-intersections are decided exactly, by `springbench.harness.scenes.edge_triangle_intersections`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.mesh.mesh_cleaning import FLAT_RATIO, find_weld_targets
from springbench.harness.scenes.mesh.mesh_topology import (
    NO_PAIRS,
    NO_TRIANGLES,
    IndexArray,
    PointArray,
    find_connected_parts,
)

NO_VERTICES: IndexArray = np.empty(0, np.int64)

_MIN_EXTENT, _MAX_EXTENT, _TYPICAL_EXTENT = 0.01, 20.0, 1.5
"""Smallest and largest plausible extent of cloth [m], and a typical one, from which a unit is guessed."""
_GUESSED_UNITS = (("millimetres", 0.001), ("centimetres", 0.01), ("inches", 0.0254), ("kilometres", 1000.0))
_FAR_RATIO = 1e5
"""Distance from the origin relative to the extent beyond which single precision loses the shape."""
_NEAR_RATIO = 0.05
"""Distance of vertices, relative to their shortest edges, below which they nearly coincide."""
_JUNCTION_RATIO = 1e-4
"""Distance of a vertex from an edge, relative to the edge's length, below which the vertex lies on the edge."""
_SLIVER_RATIO = 50.0
"""Aspect ratio above which a triangle is a sliver."""
_SHORT_RATIO = 0.01
"""Length of an edge relative to the median below which it is suspiciously short."""
_MAX_INTERSECTION_TRIANGLES = 200_000
"""Number of triangles above which self-intersections are not searched, because the search would take minutes."""


class MeshFinding(NamedTuple):
    """One kind of fault or remark, with its places in the mesh.

    Attributes:
        name: identifier, the same for all meshes.
        num_places: number of places.
        problem: what was found.
        remedy: what to do; may be empty.
        is_suspicious: whether `--strict` fails.
        vertices: (k,).
        edges: (k, 2).
        triangles: (k, 3).
        faces: lines or numbers of faces in the file, (k,).
    """

    name: str
    num_places: int
    problem: str
    remedy: str = ""
    is_suspicious: bool = True
    vertices: IndexArray = NO_VERTICES
    edges: IndexArray = NO_PAIRS
    triangles: IndexArray = NO_TRIANGLES
    faces: IndexArray = NO_VERTICES


class EdgeTable(NamedTuple):
    """Edges of triangles.

    Attributes:
        edges: (m, 2), the lower vertex first.
        side_edges: edge of each side of each triangle, (f, 3).
        is_forward: whether a side runs from the lower vertex to the higher, (f, 3).
        num_triangles: number of triangles at each edge, (m,).
    """

    edges: IndexArray
    side_edges: IndexArray
    is_forward: NDArray[np.bool_]
    num_triangles: IndexArray


def build_edge_table(triangles: IndexArray) -> EdgeTable:
    """Build the edges of triangles (f, 3)."""
    if not len(triangles):
        return EdgeTable(NO_PAIRS, NO_TRIANGLES, np.empty((0, 3), np.bool_), NO_VERTICES)
    first, second = triangles, np.roll(triangles, -1, axis=1)
    base = int(triangles.max()) + 1
    code, side, count = np.unique(
        np.minimum(first, second) * base + np.maximum(first, second), return_inverse=True, return_counts=True
    )
    edges = np.stack(np.divmod(code, base), axis=1)
    return EdgeTable(edges, side.reshape(-1, 3).astype(np.int64), first < second, count.astype(np.int64))


class MeshSupport(NamedTuple):
    """Supports of a mesh: vertices (q,) with pins or attachments, and pairs (k, 2) that effects join."""

    fixed_vertices: IndexArray = NO_VERTICES
    joined_pairs: IndexArray = NO_PAIRS


def check_parts(num_vertices: int, pairs: IndexArray, support: MeshSupport | None = None) -> list[MeshFinding]:
    """Check for connected parts without a support.

    Args:
        num_vertices: number of vertices.
        pairs: edges (m, 2).
        support: supports of the mesh; None if they are unknown.
    """
    joined = pairs if support is None else np.concatenate([pairs, support.joined_pairs])
    part = find_connected_parts(num_vertices, joined)
    used = np.zeros(num_vertices, np.bool_)
    used[pairs.ravel()] = True
    parts = np.unique(part[used])
    if support is None or not len(support.fixed_vertices):
        if len(parts) < 2:
            return []
        problem = f"parts that no edge joins: {len(parts):,}"
        return [MeshFinding("parts", len(parts), problem, is_suspicious=False)]
    loose = np.setdiff1d(parts, part[support.fixed_vertices])
    if not len(loose):
        return []
    vertices = np.flatnonzero(np.isin(part, loose) & used)
    problem = f"parts without a support: {len(loose):,} of {len(parts):,}, with {len(vertices):,} vertices"
    fix = "they fall; pin them, or join them by `weld` or sewing"
    return [MeshFinding("loose-parts", len(loose), problem, fix, vertices=vertices)]


def guess_unit(extent: float) -> tuple[str, float] | None:
    """Guess the unit of a mesh from its largest extent, in units of the file.

    Returns:
        The unit and its metres; None if metres are plausible, or no unit gives the extent of a cloth.
    """
    if extent <= 0.0 or _MIN_EXTENT <= extent <= _MAX_EXTENT:
        return None
    plausible = [unit for unit in _GUESSED_UNITS if _MIN_EXTENT <= extent * unit[1] <= _MAX_EXTENT]
    return min(plausible, key=lambda unit: abs(math.log(extent * unit[1] / _TYPICAL_EXTENT)), default=None)


def check_size(points: PointArray) -> list[MeshFinding]:
    """Check the extent of points (n, 3) [m] and their distance from the origin."""
    extents = np.ptp(points, axis=0)
    extent, offset = float(extents.max()), float(np.linalg.norm(points.mean(axis=0)))
    found: list[MeshFinding] = []
    if unit := guess_unit(extent):
        problem = f"the mesh is {extent:,.4g} m wide, high or deep: is it in {unit[0]}?"
        found.append(MeshFinding("units", 1, problem, f"`scale: {unit[1]:g}` makes it {extent * unit[1]:.3g} m"))
    elif extent and not _MIN_EXTENT <= extent <= _MAX_EXTENT:
        problem = f"the mesh is {extent:,.4g} m wide, high or deep, which is unusual for cloth"
        found.append(MeshFinding("units", 1, problem, "state `units` if it is not in metres", is_suspicious=False))
    if extent and offset > _FAR_RATIO * extent:
        problem = f"the mesh is {offset:.3g} m from the origin and {extent:.3g} m large"
        found.append(MeshFinding("far-from-origin", 1, problem, "subtract an offset in the file"))
    return found


def find_near_vertices(points: PointArray, pairs: IndexArray) -> tuple[IndexArray, PointArray]:
    """Find pairs of vertices whose distance is a small fraction of their edges.

    Args:
        points: positions (n, 3) [m].
        pairs: edges (m, 2); vertices without an edge are ignored.

    Returns:
        The pairs (k, 2), without those that an edge joins, and their distances (k,) [m].
    """
    from scipy.spatial import cKDTree

    used = np.unique(pairs)
    if len(used) < 2:
        return NO_PAIRS, np.empty(0)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    shortest = np.full(len(points), np.inf)
    for k in range(2):
        np.minimum.at(shortest, pairs[length > 0.0, k], length[length > 0.0])
    radius = np.where(np.isfinite(shortest), _NEAR_RATIO * shortest, 0.0)[used]
    place = points[used]
    target = find_weld_targets(place, 0.0)
    same, first = np.flatnonzero(target != np.arange(len(used))), np.flatnonzero(target == np.arange(len(used)))
    tree: Any = cKDTree(place[first])  # one vertex for each place, because a thousand may coincide
    lists: list[list[int]] = tree.query_ball_point(place[first], radius[first]).tolist()
    i = np.repeat(first, [len(some) for some in lists])
    j = first[np.array([one for some in lists for one in some], np.int64)]
    distance = np.linalg.norm(place[i] - place[j], axis=1)
    near = (i < j) & (distance <= np.minimum(radius[i], radius[j]))
    found = used[np.concatenate([np.column_stack([target[same], same]), np.column_stack([i[near], j[near]])])]
    distances = np.concatenate([np.zeros(len(same)), distance[near]])
    codes = [np.sort(some, axis=1) @ [len(points), 1] for some in (found, pairs)]
    joined = np.isin(codes[0], codes[1])
    return found[~joined], distances[~joined]


def _check_seams(points: PointArray, pairs: IndexArray) -> list[MeshFinding]:
    found, distance = find_near_vertices(points, pairs)
    results: list[MeshFinding] = []
    same, near = found[distance == 0.0], found[distance > 0.0]
    if len(same):
        results.append(
            MeshFinding(
                "coincident-vertices",
                len(same),
                f"vertices in the place of another one, without an edge to it (a seam?): {len(same):,}",
                "`weld: 0` joins them",
                vertices=np.unique(same),
            )
        )
    if len(near):
        widest = float(distance.max())
        distance_to_weld = _round_up(widest)
        results.append(
            MeshFinding(
                "near-vertices",
                len(near),
                f"pairs of vertices that nearly coincide, at most {widest:.3g} m apart (a seam?): {len(near):,}",
                f"`weld: {distance_to_weld:g}` joins them",
                vertices=np.unique(near),
            )
        )
    return results


def _round_up(value: float) -> float:
    """Round up to one digit."""
    unit = 10.0 ** math.floor(math.log10(value))
    return float(f"{math.ceil(value / unit * (1 + 1e-9)) * unit:.1g}")


def find_t_junctions(points: PointArray, table: EdgeTable) -> tuple[IndexArray, IndexArray]:
    """Find boundary vertices in the interior of a boundary edge.

    Args:
        points: positions (n, 3) [m].
        table: edges of the triangles.

    Returns:
        The vertices (k,), and the edges (k, 2).
    """
    from scipy.spatial import cKDTree

    edges = table.edges[table.num_triangles == 1]
    if not len(edges):
        return NO_VERTICES, NO_PAIRS
    vertices = np.unique(edges)
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    roundoff = float(np.finfo(np.float32).eps) * float(np.abs(points[vertices]).max())
    tolerance = np.maximum(_JUNCTION_RATIO * length, roundoff)
    tree: Any = cKDTree(points[vertices])
    lists: list[list[int]] = tree.query_ball_point((a + b) / 2, length / 2).tolist()
    e = np.repeat(np.arange(len(edges)), [len(some) for some in lists])
    v = vertices[np.array([one for some in lists for one in some], np.int64)]
    along = b[e] - a[e]
    share = np.einsum("ij,ij->i", points[v] - a[e], along) / np.maximum(length[e] ** 2, 1e-300)
    off = np.linalg.norm(points[v] - a[e] - share[:, None] * along, axis=1)
    inside = (share * length[e] > tolerance[e]) & ((1 - share) * length[e] > tolerance[e])
    on = inside & (off <= tolerance[e]) & (edges[e] != v[:, None]).all(axis=1)
    return v[on], edges[e[on]]


class OrientationCheck(NamedTuple):
    """Orientation of a surface.

    Attributes:
        flipped: whether a triangle is oriented against the majority of its connected part, (f,).
        is_orientable: whether a consistent orientation exists.
        is_consistent: whether the orientation of the triangles is consistent.
    """

    flipped: NDArray[np.bool_]
    is_orientable: bool
    is_consistent: bool


def check_orientation(table: EdgeTable) -> OrientationCheck:
    """Compare the orientations of triangles across edges with two of them."""
    f = len(table.side_edges)
    left, right, agrees = _pair_sides(table)
    shift = np.where(agrees, 0, f)
    pairs = np.concatenate(
        [np.column_stack([left, right + shift]), np.column_stack([left + f, (right + f + shift) % (2 * f)])]
    )
    part = find_connected_parts(2 * f, pairs)
    same, other = part[:f], part[f:]
    is_first = same <= other  # of each triangle, whether its unflipped copy lies in the first of the two covers
    surface = np.minimum(same, other)
    votes = np.bincount(surface, np.where(is_first, 1.0, -1.0), minlength=2 * f)
    orientable = same != other
    flipped = orientable & np.where(votes[surface] >= 0, ~is_first, is_first)
    return OrientationCheck(flipped, bool(orientable.all()), bool(agrees.all()))


def _pair_sides(table: EdgeTable) -> tuple[IndexArray, IndexArray, NDArray[np.bool_]]:
    """Return the two triangles of each manifold inner edge, and whether their orientations agree."""
    sides = table.side_edges.ravel()
    inner = np.flatnonzero(table.num_triangles[sides] == 2) if len(sides) else NO_VERTICES
    order = inner[np.argsort(sides[inner], kind="stable")].reshape(-1, 2)
    forward = table.is_forward.ravel()
    return order[:, 0] // 3, order[:, 1] // 3, forward[order[:, 0]] != forward[order[:, 1]]


def _find_pinched_vertices(triangles: IndexArray, table: EdgeTable) -> IndexArray:
    """Find vertices whose triangles are not connected through edges at them.

    Surfaces touch in a point there.
    """
    sides = table.side_edges.ravel()
    order = np.argsort(sides, kind="stable")
    follows = sides[order[1:]] == sides[order[:-1]]  # triangles around one edge, also where it has three or more
    one, two = order[:-1][follows], order[1:][follows]

    def corners(half_edges: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Return the corners (3 triangle + k) at the lower and the higher vertex of half edges."""
        start, end = half_edges, half_edges // 3 * 3 + (half_edges + 1) % 3
        forward = table.is_forward.ravel()[half_edges]
        return np.where(forward, start, end), np.where(forward, end, start)

    pairs = [np.column_stack(both) for both in zip(corners(one), corners(two), strict=True)]
    fan = find_connected_parts(triangles.size, np.concatenate(pairs))
    fans = np.unique(np.column_stack([triangles.ravel(), fan]), axis=0)[:, 0]
    vertices, count = np.unique(fans, return_counts=True)
    return vertices[count > 1].astype(np.int64)


def compute_aspect_ratios(points: PointArray, triangles: IndexArray) -> PointArray:
    """Compute the aspect ratio of each triangle, 1 for an equilateral one, (f,).

    It is the longest side over the shortest altitude, relative to that of an equilateral triangle.

    Args:
        points: positions (n, 3) [m].
        triangles: vertex indices (f, 3); the ratio is infinite where they have no area.
    """
    a, b, c = (points[triangles[:, k]] for k in range(3))
    doubled = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    squared = np.max([np.square(x).sum(axis=1) for x in (b - a, c - b, a - c)], axis=0)
    return np.divide(math.sqrt(3) / 2 * squared, doubled, out=np.full(len(triangles), np.inf), where=doubled > 0)


def check_surface(points: PointArray, triangles: IndexArray) -> list[MeshFinding]:
    """Check the triangles of a surface: seams between panels, orientation, edges, shapes.

    Args:
        points: positions (n, 3) [m].
        triangles: vertex indices (f, 3); there are no findings without triangles.
    """
    if not len(triangles):
        return []
    table = build_edge_table(triangles)
    found: list[MeshFinding] = []
    junctions, edges = find_t_junctions(points, table)
    vertices = np.unique(junctions)
    if len(vertices):
        problem = f"vertices on an edge of another panel, not joined to it (T-junctions): {len(vertices):,}"
        fix = "split these edges at the vertices in the program that made the mesh"
        found.append(MeshFinding("t-junctions", len(vertices), problem, fix, vertices=vertices, edges=edges))
    many = table.edges[table.num_triangles > 2]
    if len(many):
        problem = f"edges with three or more triangles (not manifold): {len(many):,}"
        found.append(
            MeshFinding("non-manifold-edges", len(many), problem, "bending and gas need two at most", edges=many)
        )
    pinched = _find_pinched_vertices(triangles, table)
    if len(pinched):
        problem = f"vertices where surfaces touch that share no edge there: {len(pinched):,}"
        found.append(MeshFinding("pinched-vertices", len(pinched), problem, vertices=pinched))
    found += _check_facing(points, triangles, table)
    ratio = compute_aspect_ratios(points, triangles)
    flat = ratio * FLAT_RATIO >= math.sqrt(3) / 2
    if flat.any():
        problem = f"triangles without area: {int(flat.sum()):,}"
        fix = "`faces: drop-degenerate` drops them"
        found.append(MeshFinding("flat-triangles", int(flat.sum()), problem, fix, triangles=triangles[flat]))
    sliver = ~flat & (ratio > _SLIVER_RATIO)
    if sliver.any():
        problem = f"slivers, triangles of an aspect ratio up to {ratio[sliver].max():.3g}: {int(sliver.sum()):,}"
        fix = "they make steps ill-conditioned; remesh"
        found.append(MeshFinding("slivers", int(sliver.sum()), problem, fix, triangles=triangles[sliver]))
    return found


def _check_facing(points: PointArray, triangles: IndexArray, table: EdgeTable) -> list[MeshFinding]:
    """Check that neighbouring triangles face the same side, and that a closed surface faces outwards."""
    facing = check_orientation(table)
    if not facing.is_orientable:
        problem = "a surface has one side only (a Moebius strip, or faces joined so)"
        return [MeshFinding("one-sided", 1, problem, "gas and wind on triangles need two sides")]
    if facing.flipped.any():
        count = int(facing.flipped.sum())
        problem = f"triangles that face against the others of their surface: {count:,}"
        fix = "wind, gas and bending use the orientation; make normals consistent"
        return [MeshFinding("flipped-triangles", count, problem, fix, triangles=triangles[facing.flipped])]
    if (table.num_triangles == 2).all():
        a, b, c = (points[triangles[:, k]] - points.mean(axis=0) for k in range(3))
        if float(np.einsum("ij,ij->", a, np.cross(b, c))) < 0:
            return [MeshFinding("inside-out", 1, "a closed surface faces inwards", "flip its faces")]
    return []


def check_edges(points: PointArray, pairs: IndexArray) -> list[MeshFinding]:
    """Check edges for coincident ends and lengths far below the median.

    Args:
        points: positions (n, 3) [m]; vertices that nearly coincide without an edge are found too.
        pairs: edges (m, 2).
    """
    found = _check_seams(points, pairs)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    if not len(length):
        return found
    short = length < _SHORT_RATIO * float(np.median(length))
    if short.any():
        problem = f"edges shorter than a hundredth of the median, down to {length.min():.3g} m: {int(short.sum()):,}"
        fix = f"`weld: {_round_up(float(length[short].max())):g}` with `faces: drop-degenerate` removes them"
        found.append(MeshFinding("short-edges", int(short.sum()), problem, fix, edges=pairs[short]))
    return found


def check_self_intersections(points: PointArray, triangles: IndexArray) -> list[MeshFinding]:
    """Find triangles that pass through each other.

    Contact at coincident vertices and at T-junctions does not count.

    Args:
        points: positions (n, 3) [m].
        triangles: vertex indices (f, 3); if there are too many, the only finding is that nothing was searched.
    """
    from springbench.harness.scenes.edge_triangle_intersections import find_edge_triangle_intersections

    if not len(triangles):
        return []
    if len(triangles) > _MAX_INTERSECTION_TRIANGLES:
        problem = f"self-intersections were not searched: more than {_MAX_INTERSECTION_TRIANGLES:,} triangles"
        return [MeshFinding("intersections-not-searched", 1, problem, is_suspicious=False)]
    joined = find_weld_targets(points, 0.0)[triangles]
    ratio = compute_aspect_ratios(points, joined)
    joined = joined[ratio * FLAT_RATIO < math.sqrt(3) / 2]
    table = build_edge_table(joined)
    on_edges, _ = find_t_junctions(points, table)
    is_junction = np.zeros(len(points), np.bool_)
    is_junction[on_edges] = True
    edges = table.edges[~is_junction[table.edges].any(axis=1)]
    crossed = find_edge_triangle_intersections(points, edges, joined[~is_junction[joined].any(axis=1)])
    if not crossed:
        return []
    through = np.unique(np.array([triangle for _, triangle in crossed], np.int64), axis=0)
    problem = f"edges that pass through triangles (self-intersections): {len(crossed):,}"
    fix = "`self-contact` needs a start without any"
    crossing = np.unique(np.array([edge for edge, _ in crossed], np.int64), axis=0)
    return [
        MeshFinding("self-intersections", len(crossed), problem, fix, edges=crossing, triangles=through),
    ]
