# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# meshio has no types.
"""Mesh files of other programs, as meshio reads them, and .vtp, which it does not: what runs in the child that
`harness.base.child` keeps.

meshio takes some files for whole that were cut before their end. So the sections of a .msh must be closed, a PLY must
hold what its head promises, and an STL in text must be ended.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import meshio
import numpy as np
from numpy.typing import NDArray

from harness.scenes.mesh import vtp

Block = tuple[str, NDArray[np.int64]]
"""Cells of one kind: its name in meshio, and the points of each."""

_PHYSICAL = "gmsh:physical"


class Found(NamedTuple):
    """What a file holds. points (n, 3); groups: points by the name of a group; attributes: numbers by point (n,), those
    of vectors by their name and a number, `normal.0`."""

    points: NDArray[np.float64]
    blocks: list[Block]
    groups: dict[str, NDArray[np.int64]]
    attributes: dict[str, NDArray[np.float64]]


class _Cells(Protocol):
    type: str
    data: NDArray[Any]


class _Raw(Protocol):
    """What meshio makes of a file."""

    points: NDArray[Any]
    cells: list[_Cells]
    point_data: dict[str, NDArray[Any]]
    cell_data: dict[str, list[NDArray[Any]]]
    field_data: dict[str, NDArray[Any]]
    point_sets: dict[str, Any]
    cell_sets: dict[str, list[Any]]


def read(path: Path) -> Found:
    """What a mesh file holds; raises anything on a broken file, ValueError on one that was cut."""
    if path.suffix.lower() == ".vtp":
        return _of_vtp(vtp.read(path.read_bytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        raw = cast(_Raw, meshio.read(path))
    missing = _MISSING.get(path.suffix.lower())
    if missing and (what := missing(path.read_bytes(), raw)):
        raise ValueError(f"{what}; the file was cut before its end, so write it once more")
    blocks = [(block.type, np.array(block.data, np.int64)) for block in raw.cells if len(block.data)]
    kept = [(kind, data) for kind, data in blocks if kind != "vertex"]
    return Found(np.array(raw.points, np.float64), kept, _groups(raw), _columns(raw.point_data, len(raw.points)))


def _of_vtp(read: vtp.Surface) -> Found:
    """By the number of their corners."""
    names, groups = {3: "triangle", 4: "quad"}, dict[int, list[NDArray[np.int64]]]()
    for polygon in read.polygons:
        groups.setdefault(len(polygon), []).append(polygon)
    blocks = [(names.get(k, "polygon"), np.array(group)) for k, group in sorted(groups.items())]
    pairs = [np.column_stack([line[:-1], line[1:]]) for line in read.lines]
    if pairs:
        blocks.append(("line", np.concatenate(pairs)))
    return Found(read.points, blocks, {}, _columns(read.numbers, len(read.points)))


def _groups(raw: _Raw) -> dict[str, NDArray[np.int64]]:
    """The points of named sets of points and of cells, and of Gmsh's physical groups."""
    found: dict[str, list[NDArray[Any]]] = {name: [np.asarray(some)] for name, some in raw.point_sets.items()}
    for name, sets in raw.cell_sets.items():
        for block, some in zip(raw.cells, sets, strict=True):
            if some is not None:
                found.setdefault(name, []).append(np.asarray(block.data)[np.asarray(some, np.int64)])
    for name, (tag, _) in raw.field_data.items():
        for block, tags in zip(raw.cells, raw.cell_data.get(_PHYSICAL, []), strict=False):
            found.setdefault(name, []).append(np.asarray(block.data)[np.asarray(tags) == tag])
    joined = {name: np.unique(np.concatenate([x.ravel() for x in some])) for name, some in found.items() if some}
    return {name: points.astype(np.int64) for name, points in joined.items() if len(points)}


def _columns(numbers: dict[str, NDArray[Any]], n: int) -> dict[str, NDArray[np.float64]]:
    """Each column of what is told of n points."""
    found: dict[str, NDArray[np.float64]] = {}
    for name, values in numbers.items():
        if len(values) != n:
            continue
        columns = np.asarray(values, np.float64).reshape(n, -1).T
        found |= {name: columns[0]} if len(columns) == 1 else {f"{name}.{k}": x for k, x in enumerate(columns)}
    return {name: np.ascontiguousarray(column) for name, column in found.items()}


_SECTION = re.compile(rb"^\$(End)?((?:MeshFormat|PhysicalNames|Entities|Nodes|Elements|Periodic)\b|\w+Data\b)", re.M)
_PROMISE = re.compile(rb"^element (vertex|face) (\d+)", re.M)


def _open_sections(content: bytes, raw: _Raw) -> str:
    """Of Gmsh's .msh, whose other kind, ANSYS's, has none."""
    begun: dict[bytes, int] = {}
    for end, name in _SECTION.findall(content):
        begun[name] = begun.get(name, 0) + (-1 if end else 1)
    left = next((name.decode() for name, count in begun.items() if count > 0), "")
    return f"the section ${left} has no $End{left}" if left else ""


def _broken_promise(content: bytes, raw: _Raw) -> str:
    """Of a PLY."""
    found = {b"vertex": len(raw.points), b"face": sum(len(block.data) for block in raw.cells)}
    for what, count in _PROMISE.findall(content.partition(b"end_header")[0]):
        if found[what] < int(count):
            return f"its head promises {what.decode()} {count.decode()[:20]}, and {found[what]} are there"
    return ""


def _not_ended(content: bytes, raw: _Raw) -> str:
    """Of an STL; a binary one holds its count."""
    text = content.lstrip().startswith(b"solid") and b"facet" in content
    return "it has no endsolid" if text and b"endsolid" not in content else ""


_MISSING: dict[str, Callable[[bytes, _Raw], str]] = {
    ".msh": _open_sections,
    ".ply": _broken_promise,
    ".stl": _not_ended,
}
