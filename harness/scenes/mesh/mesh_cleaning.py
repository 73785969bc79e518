"""Cleaning of mesh cells from a file: unit, up axis, welding, degenerate faces, unused vertices.

Each step is omitted unless an option requests it. The steps run in this order, and each logs how many cells it changed.
All lengths are in metres, after scaling.

A face is degenerate if it names a vertex twice, or if its corners lie on a line: the area is below
FLAT_RATIO L^2 / 2, with L the longest distance from the first corner or along a side. Single-precision files store
collinear corners up to that ratio.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.mesh.mesh import sort_unique_vertices
from springbench.harness.scenes.mesh.mesh_topology import IndexArray, PointArray, find_connected_parts
from springbench.harness.scenes.mesh.spring_network import MAX_COORDINATE, MeshCells, describe_repeated_corner

LengthUnit = Literal["km", "m", "dm", "cm", "mm", "um", "nm", "in", "ft", "yd"]
UpAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
UnusedRule = Literal["keep", "drop"]
FaceRule = Literal["strict", "drop-degenerate"]

METRES_PER_UNIT: dict[LengthUnit, float] = {
    "km": 1e3,
    "m": 1.0,
    "dm": 0.1,
    "cm": 0.01,
    "mm": 0.001,
    "um": 1e-6,
    "nm": 1e-9,
    "in": 0.0254,
    "ft": 0.3048,
    "yd": 0.9144,
}
FLAT_RATIO = 1e-6
"""Height of a face relative to its length below which it has no area."""

_UP_AXES: dict[UpAxis, tuple[tuple[int, int, int], tuple[float, float, float]]] = {
    "y": ((0, 1, 2), (1.0, 1.0, 1.0)),
    "-y": ((0, 1, 2), (1.0, -1.0, -1.0)),
    "z": ((0, 2, 1), (1.0, 1.0, -1.0)),
    "-z": ((0, 2, 1), (1.0, -1.0, 1.0)),
    "x": ((1, 0, 2), (-1.0, 1.0, 1.0)),
    "-x": ((1, 0, 2), (1.0, -1.0, 1.0)),
}
"""For each up axis the source column of x, y and z, and their signs: rotations by quarter and half turns."""
_MAX_MISTAKES, _MAX_NAMED_POINTS = 20, 3
_MAX_WELD_PAIRS = 50_000_000
"""Maximum number of vertex pairs within the welding distance, which are stored."""
_LOG = logging.getLogger("springbench")


class CleaningOptions(NamedTuple):
    """Requested changes of the cells of a file.

    Attributes:
        scale: metres per unit of the file.
        up: axis of the file that becomes y.
        weld: distance [m] up to which vertices are joined; None to join none.
        unused: whether vertices without a cell stay.
        faces: whether degenerate faces are errors or dropped.
    """

    scale: float = 1.0
    up: UpAxis = "y"
    weld: float | None = None
    unused: UnusedRule = "keep"
    faces: FaceRule = "strict"


def clean_cells(
    cells: MeshCells, options: CleaningOptions, path: Path, *, accepts_repeated_corners: bool = False
) -> MeshCells:
    """Apply the requested changes to the cells of a file, and log what they changed.

    Args:
        cells: contents of the file.
        options: requested changes.
        path: the file, for messages.
        accepts_repeated_corners: whether cells that name a vertex twice may remain.

    Raises:
        InputError: for coordinates that become too large, a weld that joins almost everything, and cells that name
            a vertex twice, unless these are dropped.
    """
    cells = _transform_points(cells, options, path)
    if options.weld is not None:
        cells = _weld_vertices(cells, options.weld, path)
    if options.faces == "drop-degenerate":
        cells, counts = drop_degenerate_cells(cells)
        for what, count in counts.items():
            if count:
                _LOG.info("%s: %s %s", path, f"{count:,}", what)
    if not accepts_repeated_corners:
        _require_distinct_corners(cells, path, is_welded=options.weld is not None)
    if options.unused == "drop" and len(unused := find_unused_vertices(cells)):
        where = ", ".join(f"({x:g}, {y:g}, {z:g})" for x, y, z in cells.points[unused[:_MAX_NAMED_POINTS]].tolist())
        more = ", ..." if len(unused) > _MAX_NAMED_POINTS else ""
        problem = f"{len(unused):,} points belong to no cell and are left out: at {where}{more} m"
        _LOG.warning("%s", InputMistake(problem, path))
        cells = drop_unused_vertices(cells)
    return cells


def _transform_points(cells: MeshCells, options: CleaningOptions, path: Path) -> MeshCells:
    """Scale and rotate the points; the default changes no bit of them."""
    columns, signs = _UP_AXES[options.up]
    points = cells.points
    if options.scale != 1.0:
        points = points * options.scale
    if options.up != "y":
        points = np.ascontiguousarray(points[:, columns] * signs) + 0.0  # no negative zeros
    if points is not cells.points and not (np.abs(points) <= MAX_COORDINATE).all():
        problem = f"gives coordinates above {MAX_COORDINATE:g} m; expected the metres in a unit of the file"
        raise InputError(InputMistake(problem, path, key="scale"))
    return replace(cells, points=points)


def find_weld_targets(points: PointArray, distance: float) -> IndexArray:
    """Return for each point the first one of its cluster, (n,).

    A cluster is connected by pairs of points within the distance.

    Args:
        points: positions (n, 3) [m].
        distance: welding distance [m], 0 for points in one place.

    Raises:
        ValueError: if the distance joins too many pairs of points.
    """
    from scipy.spatial import cKDTree  # imported only when vertices are welded

    n = len(points)
    if distance == 0.0:
        _, first, label = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
        return np.asarray(first[label.ravel()], np.int64)
    tree: Any = cKDTree(points)
    if (tree.count_neighbors(tree, distance) - n) // 2 > _MAX_WELD_PAIRS:
        raise ValueError(f"{distance:g} m joins too many vertices; expected a distance below the edge lengths")
    pairs = np.asarray(tree.query_pairs(distance, output_type="ndarray"), np.int64).reshape(-1, 2)
    label = find_connected_parts(n, pairs)
    first = np.full(n, n, np.int64)
    np.minimum.at(first, label, np.arange(n))
    return first[label]


def _weld_vertices(cells: MeshCells, distance: float, path: Path) -> MeshCells:
    try:
        target = find_weld_targets(cells.points, distance)
    except ValueError as error:
        raise InputError(InputMistake(str(error), path, key="weld")) from None
    remains = target == np.arange(len(target))
    _LOG.info("%s: `weld: %g` joined %s vertices to others", path, distance, f"{int((~remains).sum()):,}")
    return cells if remains.all() else _renumber_vertices(cells, remains, (np.cumsum(remains) - 1)[target])


def _renumber_vertices(cells: MeshCells, remains: NDArray[np.bool_], number: IndexArray) -> MeshCells:
    """Reduce cells to the vertices `remains` (n,), renumbered by `number` (n,).

    The number is -1 for vertices that no cell uses.
    """
    groups = {name: number[group] for name, group in cells.vertex_groups.items()}
    groups = {name: sort_unique_vertices(group[group >= 0], int(remains.sum())) for name, group in groups.items()}
    return replace(
        cells,
        points=cells.points[remains],
        polygons={k: number[polygons] for k, polygons in cells.polygons.items()},
        segments=number[cells.segments],
        tetrahedra=number[cells.tetrahedra],
        vertex_groups={name: group for name, group in groups.items() if len(group)},
        attributes={name: column[remains] for name, column in cells.attributes.items()},
        file_numbers=None if cells.file_numbers is None else cells.file_numbers[remains],
    )


def find_repeated_corners(cells: IndexArray) -> NDArray[np.bool_]:
    """Return which cells (f, k) name a vertex twice, (f,)."""
    ordered = np.sort(cells, axis=1)
    return np.any(ordered[:, 1:] == ordered[:, :-1], axis=1)


def find_flat_faces(points: PointArray, polygons: IndexArray) -> NDArray[np.bool_]:
    """Return which faces have no area, (f,).

    Args:
        points: positions (n, 3) [m].
        polygons: corners (f, k) of faces with k >= 3 corners.
    """
    spokes = points[polygons[:, 1:]] - points[polygons[:, :1]]
    doubled = np.linalg.norm(np.cross(spokes[:, :-1], spokes[:, 1:]), axis=2).sum(axis=1)
    sides = np.diff(spokes, axis=1)
    squared = np.concatenate([np.square(x).sum(axis=2) for x in (spokes, sides)], axis=1).max(axis=1)
    return doubled <= FLAT_RATIO * squared


def drop_degenerate_cells(cells: MeshCells) -> tuple[MeshCells, dict[str, int]]:
    """Join repeated corners of faces, and drop degenerate cells.

    Degenerate cells are faces without area, and other cells that name a vertex twice.

    Returns:
        The other cells, and the numbers of changes with their descriptions.
    """
    faces: dict[int, list[tuple[IndexArray, IndexArray]]] = {}
    joined = dropped = 0
    for k, polygons in cells.polygons.items():
        places = cells.polygon_locations.get(k, np.arange(len(polygons)))
        repeated = find_repeated_corners(polygons)
        faces.setdefault(k, []).append((polygons[~repeated], places[~repeated]))
        for i in np.flatnonzero(repeated).tolist():
            corners = _join_repeated_corners(polygons[i].tolist())
            if len(corners) < 3:
                dropped += 1
                continue
            joined += 1
            faces.setdefault(len(corners), []).append((np.array([corners]), places[[i]]))
    polygons, locations = dict[int, IndexArray](), dict[int, IndexArray]()
    for k, parts in sorted(faces.items()):
        rows, places = (np.concatenate(some) for some in zip(*parts, strict=True))
        keep = ~find_flat_faces(cells.points, rows) if k >= 3 else np.ones(len(rows), np.bool_)
        dropped += int((~keep).sum())
        order = np.argsort(places[keep], kind="stable")
        if len(order):
            polygons[k], locations[k] = rows[keep][order], places[keep][order]
    has_length = cells.segments[:, 0] != cells.segments[:, 1]
    tetrahedra = cells.tetrahedra[~find_repeated_corners(cells.tetrahedra)]
    counts = {
        "faces without area were dropped": dropped,
        "faces lost a repeated corner": joined,
        "lines without length were dropped": int((~has_length).sum()),
        "tetrahedra with a repeated corner were dropped": len(cells.tetrahedra) - len(tetrahedra),
    }
    cleaned = replace(
        cells,
        polygons=polygons,
        polygon_locations=locations,
        segments=cells.segments[has_length],
        segment_locations=cells.segment_locations[has_length]
        if len(cells.segment_locations)
        else cells.segment_locations,
        segment_attributes={name: values[has_length] for name, values in cells.segment_attributes.items()},
        tetrahedra=tetrahedra,
    )
    return cleaned, counts


def _join_repeated_corners(corners: list[int]) -> list[int]:
    """Join equal neighbours around a face, and remove spikes.

    A spike is a corner between two visits of one vertex.
    """
    around = deque[int]()
    for corner in corners:
        if len(around) >= 2 and around[-2] == corner:
            around.pop()
        elif not around or around[-1] != corner:
            around.append(corner)
    while len(around) >= 3:
        if around[0] in (around[-1], around[-2]):
            around.pop()
        elif around[1] == around[-1]:
            around.popleft()
        else:
            break
    return list(around)


def _require_distinct_corners(cells: MeshCells, path: Path, *, is_welded: bool) -> None:
    """Raise InputError with the places of cells that name a vertex twice."""
    after = "after welding, " if is_welded else ""
    located = {k: (rows, cells.polygon_locations.get(k, np.arange(len(rows)))) for k, rows in cells.polygons.items()}
    wrong = [
        (place, f"{after}{describe_repeated_corner(k)}")
        for k, (rows, places) in located.items()
        for place in places[find_repeated_corners(rows)].tolist()
    ]
    loops = np.flatnonzero(find_repeated_corners(cells.segments))
    places = cells.segment_locations[loops] if len(cells.segment_locations) else loops
    wrong += [(place, f"{after}{describe_repeated_corner(2)}") for place in places.tolist()]
    mistakes = [
        InputMistake(what, path, place)
        if cells.location_unit == "line"
        else InputMistake(f"cell {place} (counted from 0): {what}", path)
        for place, what in sorted(wrong)[:_MAX_MISTAKES]
    ]
    if len(at := np.flatnonzero(find_repeated_corners(cells.tetrahedra))):
        problem = f"tetrahedron {at[0]} (counted from 0): {after}it names a vertex twice"
        mistakes.append(InputMistake(problem, path))
    if mistakes:
        raise InputError(mistakes)


def find_unused_vertices(cells: MeshCells) -> IndexArray:
    """Return the vertices that no cell uses."""
    used = np.zeros(len(cells.points), np.bool_)
    for some in (*cells.polygons.values(), cells.segments, cells.tetrahedra):
        used[some.ravel()] = True
    return np.flatnonzero(~used)


def drop_unused_vertices(cells: MeshCells) -> MeshCells:
    """Drop the vertices that no cell uses."""
    remains = np.ones(len(cells.points), np.bool_)
    remains[find_unused_vertices(cells)] = False
    return _renumber_vertices(cells, remains, np.where(remains, np.cumsum(remains) - 1, -1))
