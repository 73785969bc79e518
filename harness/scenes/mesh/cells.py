"""Contents of a mesh file, cells on points, and their conversion to a spring network."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from harness.base.errors import InputError, Mistake
from harness.base.files import HEAD, misnamed
from harness.scenes.mesh.base import SHEAR, STRETCH, Mesh
from harness.scenes.mesh.generator import MAX_VERTICES
from harness.scenes.mesh.polygons import (
    MAX_CONCAVE_CORNERS,
    find_covers,
    repeated_rows,
    triangulate,
    vertex_areas,
)
from harness.scenes.mesh.topology import (
    NO_PAIRS,
    NO_TRIANGLES,
    Indices,
    Points,
    assemble,
    box_parts,
    by_area,
    by_length,
    by_volume,
    corner_pairs,
    sides,
    signed_volumes,
    unique_pairs,
)

SpringRule = Literal["edges", "face_pairs"]

MAX_BYTES = 2**30
"""Maximum size of a file; larger files are rejected before reading."""
MAX_COORDINATE = 1e12
"""Maximum coordinate [m]: squares of lengths must stay finite with digits to spare."""
_MAX_PAIRS = 200_000_000
_MOST_MISTAKES, _MOST_REPEATS = 20, 5
_LOG = logging.getLogger("springbench")


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Points and cells of a mesh file.

    Attributes:
        points: (n, 3) [m].
        polygons: number of corners k >= 2 -> (f, k).
        places: k -> line of each polygon, (f,), or its number in the file.
        counted: which of the two.
        segments: (s, 2).
        tetrahedra: (t, 4).
        groups: points of the groups named in the file.
        attributes: point attributes, each (n,).
        first_vertex: number of the first point in the file.
    """

    points: Points
    polygons: Mapping[int, Indices] = field(default_factory=dict[int, Indices])
    places: Mapping[int, Indices] = field(default_factory=dict[int, Indices])
    segments: Indices = field(default_factory=lambda: NO_PAIRS)
    tetrahedra: Indices = field(default_factory=lambda: np.empty((0, 4), np.int64))
    groups: Mapping[str, Indices] = field(default_factory=dict[str, Indices])
    attributes: Mapping[str, Points] = field(default_factory=dict[str, Points])
    counted: Literal["line", "face"] = "face"
    first_vertex: int = 0

    @property
    def lines_only(self) -> bool:
        """Whether every cell has two vertices."""
        return not len(self.tetrahedra) and set(self.polygons) <= {2}


def check_file(path: Path, *, most: int = MAX_BYTES) -> None:
    """Raise InputError unless `path` is a nonempty regular file of at most `most` and no placeholder."""
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(Mistake(f"cannot be opened ({reason}); give the path of a mesh file", path)) from None
    if not path.is_file():
        raise InputError(Mistake("is no file; give the path of a mesh file", path))
    if size > most:
        raise InputError(Mistake(f"has {size:,} bytes; at most {most:,} are read", path))
    try:
        with path.open("rb") as file:
            problem = misnamed(file.read(HEAD), size)
    except OSError as error:
        raise InputError(Mistake(f"cannot be read ({error.strerror})", path)) from None
    if problem:
        raise InputError(Mistake(problem, path))


def network(cells: Cells, rule: SpringRule, path: Path) -> Mesh:
    """Build the spring network of a file's cells.

    If every cell has two vertices, each is a spring (STRETCH), in file order: polygons, then segments.
    Otherwise the springs are unique pairs in lexicographic order: the sides of polygons, the segments and the
    edges of tetrahedra (STRETCH), then with `face_pairs` the other pairs of corners of a face (SHEAR).
    Triangles: those of the polygons, or the surface of the tetrahedra, facing outwards. Mass is proportional to volume
    if there are tetrahedra, else to area, else to length; a vertex without such a cell has none. A cell that
    repeats another, or is a part of it, counts once, with a warning.

    Args:
        cells: the contents of the file.
        rule: springs along edges, or between all pairs of face corners.
        path: the file, for messages.

    Raises:
        InputError: without vertices or springs, with too many of them, without any extent, and for self-crossing faces.
    """
    rest, groups = cells.points, list(cells.polygons.values())
    pairs = sum(len(g) * (g.shape[1] if rule == "edges" else g.shape[1] ** 2 // 2) for g in groups)
    if not len(rest) or not (pairs or len(cells.segments) or len(cells.tetrahedra)):
        raise InputError(Mistake("holds no vertices or no cells (faces, lines, tetrahedra) on them", path))
    if len(rest) > MAX_VERTICES or pairs > _MAX_PAIRS:
        raise InputError(
            Mistake(
                f"holds {len(rest):,} vertices and about {pairs:,} pairs on faces; "
                f"at most {MAX_VERTICES:,} and {_MAX_PAIRS:,} are allowed",
                path,
            )
        )

    along = np.concatenate([NO_PAIRS, *map(sides, groups), cells.segments, _edges(cells.tetrahedra)])
    if cells.lines_only:
        springs = {STRETCH: np.concatenate([NO_PAIRS, *groups, cells.segments])}
    else:
        springs = {STRETCH: unique_pairs(along)}
        if rule == "face_pairs":
            springs[SHEAR] = _without(
                unique_pairs(np.concatenate([NO_PAIRS, *map(corner_pairs, groups)])), springs[STRETCH]
            )
    triangles, areas = _surface_of_faces(cells, path)
    if len(cells.tetrahedra):
        tetrahedra = _distinct_tetrahedra(cells.tetrahedra, path)
        triangles, areas = _surface(rest, tetrahedra), None
        dimension, weights = 3, by_volume(rest, tetrahedra)
    elif len(triangles):
        dimension, weights = 2, by_area(rest, triangles) if areas is None else areas
    else:
        dimension, weights = 1, by_length(rest, springs[STRETCH])
    if not weights.any():
        raise InputError(Mistake("holds cells without any size: all their vertices coincide or line up", path))

    i, j = springs[STRETCH].T
    return assemble(
        rest=rest,
        springs=springs,
        triangles=triangles,
        weights=weights,
        dimension=dimension,
        spacing=float(np.median(np.linalg.norm(rest[i] - rest[j], axis=1))),
        resolution=0,
        parts=box_parts(rest) | dict(cells.groups),
        attributes=cells.attributes,
        areas=areas,
        first_vertex=cells.first_vertex,
    )


def _surface_of_faces(cells: Cells, path: Path) -> tuple[Indices, Points | None]:
    """Triangulate the faces (f, 3), each part of the surface once.

    Returns:
        The triangles, and the vertex areas (n,) [m^2], None if they are thirds of the triangles.
    """
    faces = {k: polygons for k, polygons in cells.polygons.items() if k >= 3}
    places = {k: cells.places.get(k, np.arange(len(polygons))) for k, polygons in faces.items()}
    surfaces = {k: triangulate(cells.points, polygons) for k, polygons in faces.items()}
    crossed = [(int(places[k][i]), k) for k, made in surfaces.items() for i in np.flatnonzero(made.failed).tolist()]
    if crossed:
        raise InputError([_crossed_face(cells, path, *one) for one in sorted(crossed)[:_MOST_MISTAKES]])
    first = {k: repeated_rows(polygons) for k, polygons in faces.items()}
    new = {k: first[k] == np.arange(len(first[k])) for k in faces}
    repeats = [
        (int(places[k][i]), int(places[k][first[k][i]])) for k in faces for i in np.flatnonzero(~new[k]).tolist()
    ]
    for cover in find_covers(cells.points, faces, surfaces):
        larger = places[cover.larger][cover.larger_rows].tolist()
        fresh = new[cover.corners][cover.rows]
        mine = places[cover.corners][cover.rows]
        repeats += [(int(a), int(b)) for a, b in zip(mine[fresh], np.array(larger)[fresh], strict=True)]
        new[cover.corners][cover.rows] = False
    if repeats:
        _warn_of_repeats(cells, path, sorted(repeats))
    kept = {k: surfaces[k].chosen(new[k]) for k in faces}
    triangles = np.concatenate([NO_TRIANGLES, *(made.triangles.reshape(-1, 3) for made in kept.values())])
    if set(faces) <= {3}:
        return triangles, None
    areas = [vertex_areas(cells.points, faces[k][new[k]], kept[k]) for k in faces]
    return triangles, np.sum(areas, axis=0)


def _crossed_face(cells: Cells, path: Path, place: int, corners: int) -> Mistake:
    problem = "the sides of this face cross each other; list its corners in order around it, or split it into triangles"
    if corners > MAX_CONCAVE_CORNERS:
        problem = f"this face of {corners:,} corners is not convex; split it ({MAX_CONCAVE_CORNERS:,} corners at most)"
    if cells.counted == "line":
        return Mistake(problem, path, place)
    return Mistake(f"face {place} (counted from 0): {problem}", path)


def _warn_of_repeats(cells: Cells, path: Path, repeats: list[tuple[int, int]]) -> None:
    """Warn about faces that repeat others; pairs of locations, the repetition first."""
    what = "line" if cells.counted == "line" else "face, counted from 0"
    listed = ", ".join(f"{place} repeats {other}" for place, other in repeats[:_MOST_REPEATS])
    more = f", and {len(repeats) - _MOST_REPEATS:,} more" if len(repeats) > _MOST_REPEATS else ""
    problem = f"{len(repeats):,} faces repeat others, or a part of them; each counts once ({what}: {listed}{more})"
    _LOG.warning("%s", Mistake(problem, path, repeats[0][0] if cells.counted == "line" else None))


def _distinct_tetrahedra(tetrahedra: Indices, path: Path) -> Indices:
    """Remove tetrahedra with the same corners as an earlier one."""
    new = repeated_rows(tetrahedra) == np.arange(len(tetrahedra))
    if not new.all():
        at = int(np.flatnonzero(~new)[0])
        problem = (
            f"{int((~new).sum()):,} tetrahedra repeat others; each counts once (the first is {at}, counted from 0)"
        )
        _LOG.warning("%s", Mistake(problem, path))
    return tetrahedra[new]


def _edges(tetrahedra: Indices) -> Indices:
    """Return the six edges of each tetrahedron, (6 t, 2), with repetitions."""
    return np.concatenate([tetrahedra[:, [i, j]] for i, j in combinations(range(4), 2)])


def _without(pairs: Indices, others: Indices) -> Indices:
    """Return the pairs that are not among the others; both are sorted within a pair."""
    base = int(max(pairs.max(initial=0), others.max(initial=0))) + 1
    return pairs[~np.isin(pairs @ [base, 1], others @ [base, 1])]


def _surface(rest: Points, tetrahedra: Indices) -> Indices:
    """Return the faces of exactly one tetrahedron, facing outwards, (f, 3)."""
    inverted = signed_volumes(rest, tetrahedra) < 0
    tetrahedra = np.where(inverted[:, None], tetrahedra[:, [1, 0, 2, 3]], tetrahedra)
    faces = np.concatenate([tetrahedra[:, f] for f in ([0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]
