"""Report on a mesh file: its contents, and suspicious features with their places and remedies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from springbench.harness.scenes.mesh.boundary_loops import trace_boundary_loops
from springbench.harness.scenes.mesh.file_mesh import FileMesh, read_cells
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_checks import (
    NO_VERTICES,
    MeshFinding,
    MeshSupport,
    build_edge_table,
    check_edges,
    check_orientation,
    check_parts,
    check_self_intersections,
    check_size,
    check_surface,
    compute_aspect_ratios,
    find_connected_parts,
)
from springbench.harness.scenes.mesh.mesh_cleaning import (
    clean_cells,
    drop_degenerate_cells,
    drop_unused_vertices,
    find_flat_faces,
    find_repeated_corners,
    find_unused_vertices,
)
from springbench.harness.scenes.mesh.mesh_topology import IndexArray, PointArray, find_box_parts
from springbench.harness.scenes.mesh.spring_network import (
    MeshCells,
    find_boundary_triangles,
    list_cell_edges,
    triangulate_cells,
)

_MAX_NAMED = 5
"""Number of places that a line of text names."""
_MAX_QUICK_TRIANGLES = 20_000
"""Number of triangles up to which the start of a run searches self-intersections."""
_MAX_LISTED = 8
"""Number of parts, loops and groups that a line of text lists."""


class MeshReport(NamedTuple):
    """Contents and faults of a mesh file.

    Attributes:
        path: the file with the geometry.
        points: (n, 3) [m], after scaling, rotation and welding.
        edges: (m, 2).
        triangles: (f, 3), of faces that have an area.
        cells: contents of the file.
        facts: figures by name, as they appear in JSON.
        findings: faults and remarks.
    """

    path: Path
    points: PointArray
    edges: IndexArray
    triangles: IndexArray
    cells: MeshCells
    facts: dict[str, Any]
    findings: list[MeshFinding]

    @property
    def is_suspicious(self) -> bool:
        """Whether any finding is more than a remark."""
        return any(finding.is_suspicious for finding in self.findings)

    def to_json(self) -> dict[str, Any]:
        """Return the report as data for JSON.

        Vertices are counted from 0, and faces as in the file.
        """
        found = [
            {
                "name": one.name,
                "count": one.num_places,
                "problem": one.problem,
                "remedy": one.remedy,
                "is_suspicious": one.is_suspicious,
                "vertices": one.vertices.tolist(),
                "edges": one.edges.tolist(),
                "triangles": one.triangles.tolist(),
                "faces": one.faces.tolist(),
            }
            for one in self.findings
        ]
        return {"file": str(self.path), **self.facts, "findings": found}

    def format_facts(self) -> list[tuple[str, str]]:
        """Return the contents of the file as pairs of a name and a text.

        The first pair contains the counts.
        """
        return [("contents", _format_counts(self.facts)), *_format_facts(self.facts)]

    def format_lines(self) -> Iterator[str]:
        """Yield the report as lines of text."""
        yield f"{self.path}:"
        for name, words in self.format_facts():
            yield f"  {name:<14}{words}"
        for one in self.findings:
            yield f"{'!' if one.is_suspicious else '-'} {format_finding(one, self.cells)}"
        if not self.findings:
            yield "nothing is suspicious"


def build_mesh_report(source: FileMesh, support: MeshSupport | None = None) -> MeshReport:
    """Read a mesh file and check it.

    Args:
        source: the file, with the changes of its cells that a scene requests.
        support: supports of the mesh in a scene; None without a scene.

    Raises:
        InputError: for a file that cannot be read.
    """
    path = source.find_geometry_path()
    options = source.build_cleaning_options()
    cells = clean_cells(read_cells(path), options._replace(unused="keep"), path, accepts_repeated_corners=True)
    found = _report_unused(find_unused_vertices(cells), are_dropped=options.unused == "drop")
    if options.unused == "drop":
        cells = drop_unused_vertices(cells)
    found += _check_cells(cells)
    proper, _ = drop_degenerate_cells(cells)
    surface = triangulate_cells(proper)
    triangles = surface.triangles
    if len(proper.tetrahedra):
        triangles = find_boundary_triangles(proper.points, proper.tetrahedra)
    for name, pairs, what, fix in (
        ("crossed-faces", surface.crossed, "have sides that cross each other", "list their corners in order"),
        ("duplicate-faces", surface.repeats, "repeat others, or a part of them, and count once", ""),
    ):
        if pairs:
            places = np.array([place for place, _ in pairs], np.int64)
            found.append(_report_faces(proper, name, places, what, fix))
    edges = list_cell_edges(proper)
    found = [
        *(check_size(cells.points) if len(cells.points) else []),
        *check_parts(len(cells.points), edges, support),
        *check_edges(cells.points, edges),
        *found,
        *check_surface(cells.points, triangles),
        *check_self_intersections(cells.points, triangles),
    ]
    facts = _collect_facts(cells, edges, triangles)
    return MeshReport(path, cells.points, edges, triangles, cells, facts, found)


def find_mesh_remarks(mesh: Mesh, support: MeshSupport | None) -> list[MeshFinding]:
    """Check a mesh that is about to be simulated.

    Self-intersections are searched if that takes about a second.

    Args:
        mesh: mesh, whose springs and triangles at rest are checked.
        support: pinned or attached vertices and joined pairs; None if they are unknown.
    """
    points, springs = mesh.rest_positions, mesh.springs
    used = np.zeros(len(points), np.bool_)
    used[springs.ravel()] = True
    return [
        *check_size(points),
        *check_parts(len(points), springs, support),
        *check_edges(points, springs),
        *_report_unused(np.flatnonzero(~used)),
        *check_surface(points, mesh.triangles),
        *(check_self_intersections(points, mesh.triangles) if len(mesh.triangles) <= _MAX_QUICK_TRIANGLES else []),
    ]


def format_finding(finding: MeshFinding, numbering: Mesh | MeshCells) -> str:
    """Format a finding with its first places.

    Vertices have their numbers in the file.

    Args:
        finding: fault or remark, with its vertices, edges, triangles or faces.
        numbering: mesh or cells of the finding; where it has no file numbers, vertices are named by their indices.
    """
    numbers = numbering.file_numbers

    def name_vertices(rows: IndexArray) -> Iterator[str]:
        for row in np.atleast_2d(rows)[:_MAX_NAMED]:
            yield "-".join(map(str, (row if numbers is None else numbers[row]).tolist()))

    unit = "line" if getattr(numbering, "location_unit", "face") == "line" else "face"
    places: list[tuple[str, int, Iterable[str]]] = [
        ("triangle", len(finding.triangles), name_vertices(finding.triangles)),
        ("edge", len(finding.edges), name_vertices(finding.edges)),
        ("vertex", len(finding.vertices), name_vertices(finding.vertices[:, None])),
    ]
    if len(finding.faces):
        places = [(unit, len(finding.faces), map(str, finding.faces[:_MAX_NAMED].tolist()))]
    named = [f"{kind} {', '.join(names)}{', ...' if n > _MAX_NAMED else ''}" for kind, n, names in places if n]
    where = f" ({'; '.join(named)})" if named else ""
    return f"{finding.problem}{where}{f'; {finding.remedy}' if finding.remedy else ''}"


def _check_cells(cells: MeshCells) -> list[MeshFinding]:
    """Find degenerate cells among the cells as they are in the file."""
    found: list[MeshFinding] = []
    remedy = "`faces: drop-degenerate` repairs this"
    repeated, flat = [NO_VERTICES], [NO_VERTICES]
    for k, polygons in cells.polygons.items():
        places = cells.polygon_locations.get(k, np.arange(len(polygons)))
        twice = find_repeated_corners(polygons)
        repeated.append(places[twice])
        if k >= 3:
            flat.append(places[find_flat_faces(cells.points, polygons) & ~twice])
    for name, some, what in (
        ("repeated-corners", np.concatenate(repeated), "name a vertex twice"),
        ("flat-faces", np.concatenate(flat), "have no area"),
    ):
        if len(some):
            found.append(_report_faces(cells, name, some, what, remedy))
    if loops := int(find_repeated_corners(cells.segments).sum()):
        found.append(MeshFinding("loops", loops, f"lines that join a vertex to itself: {loops:,}", remedy))
    return found


def _report_faces(cells: MeshCells, name: str, places: IndexArray, what: str, remedy: str) -> MeshFinding:
    """Build the finding of faces by their places in the file, with their corners."""
    corners = [NO_VERTICES]
    for k, polygons in cells.polygons.items():
        corners.append(polygons[np.isin(cells.polygon_locations.get(k, np.arange(len(polygons))), places)].ravel())
    problem = f"faces that {what}: {len(places):,}"
    vertices = np.unique(np.concatenate(corners))
    return MeshFinding(name, len(places), problem, remedy, vertices=vertices, faces=np.sort(places))


def _report_unused(unused: IndexArray, *, are_dropped: bool = False) -> list[MeshFinding]:
    if not len(unused):
        return []
    problem = f"vertices without a face, line or tetrahedron: {len(unused):,}"
    if are_dropped:
        return [MeshFinding("unused-vertices", len(unused), f"{problem}; they are dropped", is_suspicious=False)]
    return [MeshFinding("unused-vertices", len(unused), problem, "`unused: drop` drops them", vertices=unused)]


def _collect_facts(cells: MeshCells, edges: IndexArray, triangles: IndexArray) -> dict[str, Any]:
    points, table = cells.points, build_edge_table(triangles)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    ratio = compute_aspect_ratios(points, triangles)
    used = np.unique(edges)
    part = find_connected_parts(len(points), edges)[used]
    loops = trace_boundary_loops(points, triangles)
    facing = check_orientation(table)
    groups = find_box_parts(points) | dict(cells.vertex_groups) if len(points) else {}
    return {
        "num_vertices": len(points),
        "num_faces": {str(k): len(rows) for k, rows in sorted(cells.polygons.items()) if k > 2 and len(rows)},
        "num_lines": len(cells.segments) + len(cells.polygons.get(2, ())),
        "num_tetrahedra": len(cells.tetrahedra),
        "num_edges": len(edges),
        "low": points.min(axis=0).tolist() if len(points) else [],
        "high": points.max(axis=0).tolist() if len(points) else [],
        "area": float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2),
        "edge_length": _summarise(length),
        "aspect_ratio": _summarise(ratio[np.isfinite(ratio)]),
        "part_sizes": sorted(np.unique(part, return_counts=True)[1].tolist(), reverse=True),
        "boundary_loops": [
            {"length": loop.length, "num_vertices": len(loop.vertices), "is_hole": loop.is_hole} for loop in loops
        ],
        "is_closed": bool(len(triangles)) and bool((table.num_triangles == 2).all()),
        "is_manifold": bool((table.num_triangles <= 2).all()),
        "is_oriented": facing.is_consistent,
        "groups": {name: len(group) for name, group in sorted(groups.items())},
        "attributes": {name: _find_range(column) for name, column in sorted(cells.attributes.items())},
    }


def _find_range(values: PointArray) -> list[float]:
    """Return the smallest and the largest finite value; empty without any."""
    finite = values[np.isfinite(values)]
    return [float(finite.min()), float(finite.max())] if len(finite) else []


def _summarise(values: PointArray) -> dict[str, float]:
    """Return minimum, median and maximum; empty without values."""
    if not len(values):
        return {}
    return {"min": float(values.min()), "median": float(np.median(values)), "max": float(values.max())}


def _format_counts(facts: dict[str, Any]) -> str:
    names = {"3": "triangles", "4": "quads"}
    faces = [f"{count:,} {names.get(k, f'faces of {k} corners')}" for k, count in facts["num_faces"].items()]
    others = [f"{facts[key]:,} {what}" for key, what in (("num_lines", "lines"), ("num_tetrahedra", "tetrahedra"))
              if facts[key]]  # fmt: skip
    return ", ".join([f"{facts['num_vertices']:,} vertices", *faces, *others, f"{facts['num_edges']:,} edges"])


def _format_facts(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    low, high = np.array(facts["low"]), np.array(facts["high"])
    if len(low):
        corner = ", ".join(f"{x:.4g}" for x in low)
        yield "extent", f"{' x '.join(f'{x:.4g}' for x in high - low)} m (x, y, z) from ({corner})"
    if facts["area"]:
        yield "area", f"{facts['area']:.4g} m²"
    for key, name, unit in (("edge_length", "edges", " m"), ("aspect_ratio", "aspect ratio", "")):
        if some := facts[key]:
            yield name, f"{some['min']:.3g} to {some['max']:.3g}{unit}, median {some['median']:.3g}{unit}"
    sizes, loops = facts["part_sizes"], facts["boundary_loops"]
    yield "parts", f"{len(sizes):,}: {_shorten([f'{size:,}' for size in sizes])} vertices"
    if facts["area"]:
        words = ["closed" if facts["is_closed"] else "open", "" if facts["is_manifold"] else "not manifold"]
        words.append("consistently oriented" if facts["is_oriented"] else "not consistently oriented")
        yield "surface", ", ".join(filter(None, words))
    if loops:
        lengths = [f"{loop['length']:.3g} m{' (hole)' if loop['is_hole'] else ''}" for loop in loops]
        yield "boundary", f"{len(loops):,} loops: {_shorten(lengths)}"
    yield "groups", _shorten([f"{name} {count:,}" for name, count in facts["groups"].items()], 4 * _MAX_LISTED)
    if facts["attributes"]:
        ranges = [
            f"{name} {found[0]:.3g} to {found[1]:.3g}" if found else f"{name} without finite values"
            for name, found in facts["attributes"].items()
        ]
        yield "attributes", _shorten(ranges)


def _shorten(words: list[str], limit: int = _MAX_LISTED) -> str:
    return ", ".join(words[:limit]) + (", ..." if len(words) > limit else "")
