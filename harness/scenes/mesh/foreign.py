# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
# meshio has no types.
"""Mesh files of other programs, as meshio reads them: what runs in the child that `harness.base.child` keeps.

meshio takes some files for whole that were cut before their end. So the sections of a .msh must be closed, a PLY must
hold what its head promises, and an STL in text must be ended.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, cast

import meshio
import numpy as np
from numpy.typing import NDArray

Block = tuple[str, NDArray[np.int64]]
"""Cells of one kind: its name in meshio, and the points of each."""


class _Cells(Protocol):
    type: str
    data: NDArray[Any]


class _Raw(Protocol):
    """What meshio makes of a file."""

    points: NDArray[Any]
    cells: list[_Cells]


def read(path: Path) -> tuple[NDArray[np.float64], list[Block]]:
    """The points and the cells of a mesh file; raises anything on a broken file, ValueError on one that was cut."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        raw = cast(_Raw, meshio.read(path))
    missing = _MISSING.get(path.suffix.lower())
    if missing and (what := missing(path.read_bytes(), raw)):
        raise ValueError(f"{what}; the file was cut before its end, so write it once more")
    blocks = [(block.type, np.array(block.data, np.int64)) for block in raw.cells if len(block.data)]
    return np.array(raw.points, np.float64), [(kind, data) for kind, data in blocks if kind != "vertex"]


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
