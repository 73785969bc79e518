"""Reference implementation of vertex selections."""

from __future__ import annotations

from collections import Counter
from itertools import combinations
from typing import Any

import numpy as np
from springbench.harness.scenes.mesh.mesh import Mesh

from tests.oracles.scene_declaration import SceneDeclaration


def select_vertices(declared: SceneDeclaration, selection: Any) -> list[int]:
    """Return every k-th of the vertices that any selector matches; without selectors, of all vertices."""
    mesh, one = declared.mesh, selection
    named = set[int](selection.indices)
    rows: list[list[float]] = mesh.rest_positions.tolist()
    places = list(enumerate(rows))
    for part in one.parts:
        named |= set(mesh.parts[part].tolist())
    if one.box:
        low, high = one.box.low, one.box.high
        named |= {i for i, x in places if all(a <= c <= b for a, c, b in zip(low, x, high, strict=True))}
    if one.sphere:
        named |= {i for i, x in places if _squared_distance(x, one.sphere.center) <= one.sphere.radius**2}
    named |= {min((_squared_distance(x, point), i) for i, x in places)[1] for point in one.nearest_to}
    if one.boundary_loops or one.holes:
        loops = _find_boundary_loops(mesh)
        holes = [loop for loop, hole in loops if hole]
        rims: list[int] = [*one.boundary_loops]
        gaps: list[int] = [*one.holes]
        named = named.union(*(loops[k][0] for k in rims), *(holes[k] for k in gaps))
    if one.attribute:
        low, high = one.attribute.low, one.attribute.high
        for i, value in enumerate(mesh.attributes[one.attribute.name].tolist()):
            named |= {i} if (low is None or value >= low) and (high is None or value <= high) else set()
    nothing = not (
        one.parts or one.indices or one.box or one.sphere or one.nearest_to or one.boundary_loops or one.holes
    )
    if nothing and not one.attribute:
        named = set(range(len(mesh.rest_positions)))
    return sorted(named)[:: one.stride]


def _squared_distance(x: Any, y: Any) -> float:
    return sum((a - b) ** 2 for a, b in zip(x, y, strict=True))


def _find_boundary_loops(mesh: Mesh) -> list[tuple[set[int], bool]]:
    """Find the boundary loops, longest first, and whether each is a hole."""
    used = Counter(tuple(sorted(side)) for corners in mesh.triangles.tolist() for side in combinations(corners, 2))
    surfaces, rims = _find_components(used), _find_components([side for side, count in used.items() if count == 1])

    def length(rim: set[int]) -> float:
        sides = [side for side, count in used.items() if count == 1 and set(side) <= rim]
        return float(f"{sum(np.linalg.norm(mesh.rest_positions[i] - mesh.rest_positions[j]) for i, j in sides):.9g}")

    ordered = sorted(rims, key=lambda rim: (-length(rim), min(rim)))
    outer = [next(rim for rim in ordered if rim <= surface) for surface in surfaces if any(r <= surface for r in rims)]
    return [(rim, rim not in outer) for rim in ordered]


def _find_components(pairs: Any) -> list[set[int]]:
    """Find the connected components of a graph."""
    pieces = list[set[int]]()
    for pair in pairs:
        met = [piece for piece in pieces if piece & set(pair)]
        pieces = [piece for piece in pieces if not piece & set(pair)]
        pieces.append(set(pair).union(*met))
    return pieces
