"""Boundary loops of a surface, and their classification as holes.

A boundary loop consists of edges with one triangle.
"""

from __future__ import annotations

from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_topology import IndexArray, find_connected_parts

_COMPARED_DIGITS = 9
"""Number of compared digits of loop lengths, so that round-off does not affect the order."""


class BoundaryLoop(NamedTuple):
    """A connected piece of the boundary.

    Attributes:
        vertices: (k,), sorted.
        length: [m].
        is_hole: whether the same connected surface has a longer loop.
    """

    vertices: IndexArray
    length: float
    is_hole: bool


def find_boundary_loops(mesh: Mesh) -> list[BoundaryLoop]:
    """Find the boundary loops of a mesh at rest, longest first.

    Loops of equal length are ordered by their lowest vertex.
    """
    return trace_boundary_loops(mesh.rest_positions, mesh.triangles)


def trace_boundary_loops(points: NDArray[np.float64], triangles: IndexArray) -> list[BoundaryLoop]:
    """Trace the boundary loops of triangles, longest first.

    Args:
        points: positions (n, 3) [m], from which lengths are computed.
        triangles: vertex indices (f, 3).
    """
    if not len(triangles):
        return []
    n = len(points)
    sides = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    edges, count = np.unique(sides, axis=0, return_counts=True)
    open_ = edges[count == 1]

    surface, of = find_connected_parts(n, edges), find_connected_parts(n, open_)
    long = np.linalg.norm(points[open_[:, 0]] - points[open_[:, 1]], axis=1)
    length = np.bincount(of[open_[:, 0]], long, minlength=n)
    found = [np.flatnonzero(of == k) for k in np.unique(of[open_[:, 0]]).tolist()]
    rounded = {int(x[0]): float(f"{length[of[x[0]]]:.{_COMPARED_DIGITS}g}") for x in found}
    found.sort(key=lambda x: (-rounded[int(x[0])], int(x[0])))
    by_surface = groupby(sorted(found, key=lambda x: int(surface[x[0]])), key=lambda x: int(surface[x[0]]))
    rims = {int(next(of_one)[0]) for _, of_one in by_surface}  # sorting is stable: the longest is first
    return [BoundaryLoop(x, float(length[of[x[0]]]), int(x[0]) not in rims) for x in found]
