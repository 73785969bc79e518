"""What a mesh file holds, cells on points, and the spring network that it becomes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np

from harness.base.errors import InputError, Mistake
from harness.scenes.mesh.base import SHEAR, STRETCH, Mesh
from harness.scenes.mesh.generator import MAX_VERTICES
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
    fan,
    sides,
    signed_volumes,
    unique_pairs,
)

SpringRule = Literal["edges", "face_pairs"]

MAX_BYTES = 2**30
"""Larger files are refused before they are read."""
MAX_COORDINATE = 1e12
"""No position [m] may be farther out: squares of lengths must stay finite with digits to spare."""
_MAX_PAIRS = 200_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """points: (n, 3) [m]; polygons: corners k >= 2 -> (f, k); segments: (s, 2); tetrahedra: (t, 4); groups: the points
    of what the file names; attributes: numbers by point that it names, each (n,)."""

    points: Points
    polygons: Mapping[int, Indices] = field(default_factory=dict[int, Indices])
    segments: Indices = field(default_factory=lambda: NO_PAIRS)
    tetrahedra: Indices = field(default_factory=lambda: np.empty((0, 4), np.int64))
    groups: Mapping[str, Indices] = field(default_factory=dict[str, Indices])
    attributes: Mapping[str, Points] = field(default_factory=dict[str, Points])

    @property
    def lines_only(self) -> bool:
        """Whether every cell names two vertices."""
        return not len(self.tetrahedra) and set(self.polygons) <= {2}


def check_file(path: Path, *, most: int = MAX_BYTES) -> None:
    """Raise InputError unless `path` is a file of so many bytes at most."""
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(Mistake(f"cannot be opened ({reason}); give the path of a mesh file", path)) from None
    if not path.is_file():
        raise InputError(Mistake("is no file; give the path of a mesh file", path))
    if size > most:
        raise InputError(Mistake(f"has {size:,} bytes; at most {most:,} are read", path))


def network(cells: Cells, rule: SpringRule, path: Path) -> Mesh:
    """The spring network of a file's cells; `path` is for messages.

    Where every cell names two vertices, each is a spring (STRETCH), in file order: polygons, then segments.
    Otherwise the springs are unique pairs in lexicographic order: the sides of polygons, the segments and the
    edges of tetrahedra (STRETCH), then with `face_pairs` the other pairs of corners of a face (SHEAR).
    Triangles: the polygons as fans, or the surface of the tetrahedra, facing outwards. Mass goes by volume
    where there are tetrahedra, else by area, else by length; a vertex that no such cell uses gets none.

    Raises InputError where there are no vertices or springs, too many, or nothing that has a size.
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
    triangles = np.concatenate([NO_TRIANGLES, *map(fan, groups)])
    if len(cells.tetrahedra):
        triangles = _surface(rest, cells.tetrahedra)
        dimension, weights = 3, by_volume(rest, cells.tetrahedra)
    elif len(triangles):
        dimension, weights = 2, by_area(rest, triangles)
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
    )


def _edges(tetrahedra: Indices) -> Indices:
    """The six edges of each tetrahedron, (6 t, 2), repetitions included."""
    return np.concatenate([tetrahedra[:, [i, j]] for i, j in combinations(range(4), 2)])


def _without(pairs: Indices, others: Indices) -> Indices:
    """The pairs that are not among the others; both sorted within a pair."""
    base = int(max(pairs.max(initial=0), others.max(initial=0))) + 1
    return pairs[~np.isin(pairs @ [base, 1], others @ [base, 1])]


def _surface(rest: Points, tetrahedra: Indices) -> Indices:
    """The faces that belong to one tetrahedron alone, facing outwards, (f, 3)."""
    inverted = signed_volumes(rest, tetrahedra) < 0
    tetrahedra = np.where(inverted[:, None], tetrahedra[:, [1, 0, 2, 3]], tetrahedra)
    faces = np.concatenate([tetrahedra[:, f] for f in ([0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]
