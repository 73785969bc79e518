"""Points and cells of a mesh file, and their conversion to a spring network."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from springbench.harness.atomic_files import HEAD_BYTES, describe_misnamed_file
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.mesh.mesh import SHEAR, STRETCH, Mesh
from springbench.harness.scenes.mesh.mesh_generator import MAX_VERTICES
from springbench.harness.scenes.mesh.mesh_topology import (
    NO_PAIRS,
    NO_TRIANGLES,
    IndexArray,
    PointArray,
    assemble_mesh,
    compute_signed_volumes,
    find_box_parts,
    list_polygon_corner_pairs,
    list_polygon_sides,
    lump_areas,
    lump_lengths,
    lump_volumes,
    sort_unique_pairs,
)
from springbench.harness.scenes.mesh.polygon_triangulation import (
    MAX_CONCAVE_CORNERS,
    compute_vertex_areas,
    find_face_covers,
    find_repeated_rows,
    triangulate_polygons,
)

SpringRule = Literal["edges", "face-pairs"]

MAX_FILE_BYTES = 2**30
"""Maximum size of a file; larger files are rejected before reading."""
MAX_COORDINATE = 1e12
"""Maximum coordinate [m]: squares of lengths must stay finite with digits to spare."""
_MAX_PAIRS = 200_000_000
_MAX_MISTAKES, _MAX_REPEATS = 20, 5
_LOG = logging.getLogger("springbench")


@dataclass(frozen=True, slots=True, eq=False)
class MeshCells:
    """Points and cells of a mesh file.

    Attributes:
        points: (n, 3) [m].
        polygons: number of corners k >= 2 -> (f, k).
        polygon_locations: k -> line of each polygon, (f,), or its number in the file.
        location_unit: whether `polygon_locations` are lines or numbers.
        segments: (s, 2).
        segment_locations: line of each segment, (s,), or empty.
        tetrahedra: (t, 4).
        vertex_groups: points of the groups named in the file.
        attributes: point attributes, each (n,).
        file_numbers: number of each point in the file, (n,); None if it has none.
        segment_attributes: cell data of the segments, each (s,).
    """

    points: PointArray
    polygons: Mapping[int, IndexArray] = field(default_factory=dict[int, IndexArray])
    polygon_locations: Mapping[int, IndexArray] = field(default_factory=dict[int, IndexArray])
    segments: IndexArray = field(default_factory=lambda: NO_PAIRS)
    segment_locations: IndexArray = field(default_factory=lambda: np.empty(0, np.int64))
    tetrahedra: IndexArray = field(default_factory=lambda: np.empty((0, 4), np.int64))
    vertex_groups: Mapping[str, IndexArray] = field(default_factory=dict[str, IndexArray])
    attributes: Mapping[str, PointArray] = field(default_factory=dict[str, PointArray])
    location_unit: Literal["line", "face"] = "face"
    file_numbers: IndexArray | None = None
    segment_attributes: Mapping[str, PointArray] = field(default_factory=dict[str, PointArray])

    @property
    def has_only_segments(self) -> bool:
        """Whether every cell has two vertices."""
        return not len(self.tetrahedra) and set(self.polygons) <= {2}


def describe_repeated_corner(num_corners: int) -> str:
    """Describe the mistake of a face or line that names a vertex twice."""
    fix = "`faces: drop-degenerate` of the mesh repairs this"
    if num_corners == 2:
        return f"a line joins a vertex to itself; its ends must differ ({fix})"
    return f"a face names a vertex twice; each corner must be another vertex ({fix})"


def check_mesh_file(path: Path, *, max_bytes: int = MAX_FILE_BYTES) -> None:
    """Check that a file can be read and may contain a mesh.

    Args:
        path: the file.
        max_bytes: maximum size of the file [bytes].

    Raises:
        InputError: `path` is no readable regular file, or it is empty, too large, a Git LFS pointer or a web page.
    """
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(InputMistake(f"cannot be opened ({reason}); give the path of a mesh file", path)) from None
    if not path.is_file():
        raise InputError(InputMistake("is no file; give the path of a mesh file", path))
    if size > max_bytes:
        raise InputError(InputMistake(f"has {size:,} bytes; at most {max_bytes:,} are read", path))
    try:
        with path.open("rb") as file:
            problem = describe_misnamed_file(file.read(HEAD_BYTES), size)
    except OSError as error:
        raise InputError(InputMistake(f"cannot be read ({error.strerror})", path)) from None
    if problem:
        raise InputError(InputMistake(problem, path))


def build_spring_network(cells: MeshCells, spring_rule: SpringRule, path: Path) -> Mesh:
    """Build the spring network of a file's cells.

    If every cell has two vertices, each is a spring (STRETCH), in file order: polygons, then segments.
    Otherwise the springs are unique pairs in lexicographic order: the sides of polygons, the segments and the
    edges of tetrahedra (STRETCH), then with `face-pairs` the other pairs of corners of a face (SHEAR).
    Triangles: those of the polygons, or the surface of the tetrahedra, facing outwards. Mass is proportional to volume
    if there are tetrahedra, else to area, else to length; a vertex without such a cell has none. A cell that
    repeats another, or is a part of it, counts once, with a warning.

    Args:
        cells: the contents of the file.
        spring_rule: springs along edges, or between all pairs of face corners.
        path: the file, for messages.

    Raises:
        InputError: without vertices or springs, with too many of them, without any extent, and for self-crossing faces.
    """
    rest, groups = cells.points, list(cells.polygons.values())
    pairs = sum(len(g) * (g.shape[1] if spring_rule == "edges" else g.shape[1] ** 2 // 2) for g in groups)
    if not len(rest) or not (pairs or len(cells.segments) or len(cells.tetrahedra)):
        raise InputError(InputMistake("contains no vertices or no cells (faces, lines, tetrahedra); was it cut?", path))
    if len(rest) > MAX_VERTICES or pairs > _MAX_PAIRS:
        raise InputError(
            InputMistake(
                f"contains {len(rest):,} vertices and about {pairs:,} pairs on faces; "
                f"at most {MAX_VERTICES:,} and {_MAX_PAIRS:,} are allowed",
                path,
            )
        )

    if cells.has_only_segments:
        springs = {STRETCH: np.concatenate([NO_PAIRS, *groups, cells.segments])}
    else:
        springs = {STRETCH: list_cell_edges(cells)}
        if spring_rule == "face-pairs":
            springs[SHEAR] = _exclude_pairs(
                sort_unique_pairs(np.concatenate([NO_PAIRS, *map(list_polygon_corner_pairs, groups)])), springs[STRETCH]
            )
    surface = triangulate_cells(cells)
    if surface.crossed:
        raise InputError([_make_crossed_face_error(cells, path, *one) for one in surface.crossed[:_MAX_MISTAKES]])
    if surface.repeats:
        _warn_repeated_faces(cells, path, surface.repeats)
    triangles, areas, spring_areas = surface.triangles, surface.areas, None
    if len(cells.tetrahedra):
        tetrahedra = _drop_repeated_tetrahedra(cells.tetrahedra, path)
        triangles, areas = find_boundary_triangles(rest, tetrahedra), None
        dimension, weights = 3, lump_volumes(rest, tetrahedra)
        volumes = np.repeat(np.abs(compute_signed_volumes(rest, tetrahedra)), 6)
        edges = np.stack([tetrahedra[:, [i, j]] for i, j in combinations(range(4), 2)], axis=1).reshape(-1, 2)
        spring_areas = _sum_by_pair(np.concatenate(list(springs.values())), edges, volumes, len(rest))
    elif len(triangles):
        dimension, weights = 2, lump_areas(rest, triangles) if areas is None else areas
        spring_areas = _distribute_areas(surface, springs, len(rest))
    else:
        dimension, weights = 1, lump_lengths(rest, springs[STRETCH])
    if not weights.any():
        raise InputError(InputMistake("contains cells without any size: all their vertices coincide or line up", path))

    i, j = springs[STRETCH].T
    return assemble_mesh(
        rest_positions=rest,
        springs=springs,
        triangles=triangles,
        vertex_weights=weights,
        dimension=dimension,
        spacing=float(np.median(np.linalg.norm(rest[i] - rest[j], axis=1))),
        resolution=0,
        parts=find_box_parts(rest) | dict(cells.vertex_groups),
        attributes=cells.attributes,
        vertex_areas=areas,
        spring_areas=spring_areas,
        file_numbers=cells.file_numbers,
    )


class FaceTriangulation(NamedTuple):
    """Triangles of all faces of a file, each part of the surface once.

    Attributes:
        triangles: (f, 3).
        areas: vertex areas (n,) [m^2]; None if they are thirds of the triangles.
        crossed: place and number of corners of faces whose sides cross; these have no triangles.
        repeats: pairs of places: a face that repeats another one or a part of it, and that other face.
        faces: number of corners k -> the triangulated faces (f, k), and their areas (f,) [m^2].
    """

    triangles: IndexArray
    areas: PointArray | None
    crossed: list[tuple[int, int]]
    repeats: list[tuple[int, int]]
    faces: Mapping[int, tuple[IndexArray, PointArray]]


def triangulate_cells(cells: MeshCells) -> FaceTriangulation:
    """Triangulate the faces of a file."""
    faces = {k: polygons for k, polygons in cells.polygons.items() if k >= 3}
    places = {k: cells.polygon_locations.get(k, np.arange(len(polygons))) for k, polygons in faces.items()}
    surfaces = {k: triangulate_polygons(cells.points, polygons) for k, polygons in faces.items()}
    crossed = [
        (int(places[k][i]), k) for k, made in surfaces.items() for i in np.flatnonzero(made.is_self_crossing).tolist()
    ]
    first = {k: find_repeated_rows(polygons) for k, polygons in faces.items()}
    new = {k: (first[k] == np.arange(len(first[k]))) & ~surfaces[k].is_self_crossing for k in faces}
    repeats = [
        (int(places[k][i]), int(places[k][first[k][i]]))
        for k in faces
        for i in np.flatnonzero(first[k] != np.arange(len(first[k]))).tolist()
    ]
    for cover in [] if crossed else find_face_covers(cells.points, faces, surfaces):
        larger = places[cover.larger_corners][cover.larger_rows].tolist()
        fresh = new[cover.corners][cover.rows]
        mine = places[cover.corners][cover.rows]
        repeats += [(int(a), int(b)) for a, b in zip(mine[fresh], np.array(larger)[fresh], strict=True)]
        new[cover.corners][cover.rows] = False
    selected = {k: surfaces[k].select_rows(new[k]) for k in faces}
    triangles = np.concatenate([NO_TRIANGLES, *(made.triangles.reshape(-1, 3) for made in selected.values())])
    measured = {k: (faces[k][new[k]], _sum_triangle_areas(cells.points, selected[k].triangles)) for k in faces}
    if set(faces) <= {3}:
        return FaceTriangulation(triangles, None, sorted(crossed), sorted(repeats), measured)
    areas = [compute_vertex_areas(cells.points, faces[k][new[k]], selected[k]) for k in faces]
    return FaceTriangulation(triangles, np.sum(areas, axis=0), sorted(crossed), sorted(repeats), measured)


def _sum_triangle_areas(points: PointArray, triangles: IndexArray) -> PointArray:
    """Return the area of each face (f,) [m^2] from its triangles (f, t, 3)."""
    a, b, c = (points[triangles[:, :, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=2).sum(axis=1) / 2


def _distribute_areas(surface: FaceTriangulation, springs: Mapping[str, IndexArray], num_vertices: int) -> PointArray:
    """Return the area that each spring represents, (m,) [m^2], sides first, then diagonals.

    A side of a triangle represents the area of the triangle, and a side of a face of k corners 2/k of the face's area.
    The diagonals of a face together represent four times its area.
    """
    pairs, shares = [NO_PAIRS], [np.empty(0)]
    for k, (faces, area) in surface.faces.items():
        pairs.append(list_polygon_sides(faces))
        shares.append(np.repeat(area if k == 3 else 2 * area / k, k))
    areas = [_sum_by_pair(springs[STRETCH], np.concatenate(pairs), np.concatenate(shares), num_vertices)]
    if SHEAR in springs:
        pairs, shares = [NO_PAIRS], [np.empty(0)]
        for k, (faces, area) in surface.faces.items():
            if count := k * (k - 3) // 2:
                i, j = np.array([(i, j) for i, j in combinations(range(k), 2) if j - i not in (1, k - 1)]).T
                pairs.append(np.stack([faces[:, i], faces[:, j]], axis=2).reshape(-1, 2))
                shares.append(np.repeat(4 * area / count, count))
        areas.append(_sum_by_pair(springs[SHEAR], np.concatenate(pairs), np.concatenate(shares), num_vertices))
    return np.concatenate(areas)


def _sum_by_pair(springs: IndexArray, pairs: IndexArray, values: PointArray, num_vertices: int) -> PointArray:
    """Sum the values (p,) of pairs (p, 2) that are springs (m, 2), for each spring, (m,)."""
    codes, expected = (np.sort(some, axis=1) @ [num_vertices, 1] for some in (springs, pairs))
    order = np.argsort(codes, kind="stable")
    if not len(order):
        return np.empty(0)
    found = order[np.minimum(np.searchsorted(codes, expected, sorter=order), len(order) - 1)]
    valid = codes[found] == expected
    return np.bincount(found[valid], values[valid], minlength=len(springs)).astype(np.float64, copy=False)


def _make_crossed_face_error(cells: MeshCells, path: Path, place: int, corners: int) -> InputMistake:
    problem = "the sides of this face cross each other; list its corners in order around it, or split it into triangles"
    if corners > MAX_CONCAVE_CORNERS:
        problem = f"this face of {corners:,} corners is not convex; split it ({MAX_CONCAVE_CORNERS:,} corners at most)"
    if cells.location_unit == "line":
        return InputMistake(problem, path, place)
    return InputMistake(f"face {place} (counted from 0): {problem}", path)


def _warn_repeated_faces(cells: MeshCells, path: Path, repeats: list[tuple[int, int]]) -> None:
    """Warn about faces that repeat others, given as pairs of locations with the repetition first."""
    what = "line" if cells.location_unit == "line" else "face, counted from 0"
    listed = ", ".join(f"{place} repeats {other}" for place, other in repeats[:_MAX_REPEATS])
    more = f", and {len(repeats) - _MAX_REPEATS:,} more" if len(repeats) > _MAX_REPEATS else ""
    problem = f"{len(repeats):,} faces repeat others, or a part of them; each counts once ({what}: {listed}{more})"
    _LOG.warning("%s", InputMistake(problem, path, repeats[0][0] if cells.location_unit == "line" else None))


def _drop_repeated_tetrahedra(tetrahedra: IndexArray, path: Path) -> IndexArray:
    """Remove tetrahedra with the same corners as an earlier one."""
    new = find_repeated_rows(tetrahedra) == np.arange(len(tetrahedra))
    if not new.all():
        at = int(np.flatnonzero(~new)[0])
        problem = (
            f"{int((~new).sum()):,} tetrahedra repeat others; each counts once (the first is {at}, counted from 0)"
        )
        _LOG.warning("%s", InputMistake(problem, path))
    return tetrahedra[new]


def list_cell_edges(cells: MeshCells) -> IndexArray:
    """List the sides of polygons, the segments and the edges of tetrahedra, each once, sorted, (m, 2)."""
    sides = map(list_polygon_sides, cells.polygons.values())
    return sort_unique_pairs(np.concatenate([NO_PAIRS, *sides, cells.segments, _tetrahedron_edges(cells.tetrahedra)]))


def _tetrahedron_edges(tetrahedra: IndexArray) -> IndexArray:
    """Return the six edges of each tetrahedron, (6 t, 2), with repetitions."""
    return np.concatenate([tetrahedra[:, [i, j]] for i, j in combinations(range(4), 2)])


def _exclude_pairs(pairs: IndexArray, others: IndexArray) -> IndexArray:
    """Return the pairs that are not among the others; both are sorted within a pair."""
    base = int(max(pairs.max(initial=0), others.max(initial=0))) + 1
    return pairs[~np.isin(pairs @ [base, 1], others @ [base, 1])]


def find_boundary_triangles(rest: PointArray, tetrahedra: IndexArray) -> IndexArray:
    """Return the faces of exactly one tetrahedron, facing outwards, (f, 3).

    Args:
        rest: rest positions (n, 3) [m].
        tetrahedra: vertices of each tetrahedron (t, 4), in either orientation.
    """
    inverted = compute_signed_volumes(rest, tetrahedra) < 0
    tetrahedra = np.where(inverted[:, None], tetrahedra[:, [1, 0, 2, 3]], tetrahedra)
    faces = np.concatenate([tetrahedra[:, f] for f in ([0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]
