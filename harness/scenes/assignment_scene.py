"""Scenes of the University of Toronto mass-spring assignment, interpreted as its own code does.

Springs: one per `f` line if all of them name two vertices, in file order; otherwise the unique pairs of vertices
that share a face, before triangulation, so that a quad has both diagonals. Mass: one value `m` for all
vertices, or the mixed Voronoi areas of the faces, triangulated as fans, at density 1 (Meyer et al. 2003 in
libigl's form). A triangle of area T gives each corner the part that is nearest to that corner,

    (|e_j|^2 cot a_j + |e_k|^2 cot a_k) / 8,

except that an obtuse corner gets T/2 and the two others T/4.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.mesh.assignment_json import find_key_line, read_assignment_json
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_cleaning import CleaningOptions, clean_cells
from springbench.harness.scenes.mesh.mesh_topology import (
    NO_PAIRS,
    NO_TRIANGLES,
    IndexArray,
    PointArray,
    split_into_fans,
)
from springbench.harness.scenes.mesh.obj_reader import read_obj
from springbench.harness.scenes.mesh.spring_network import build_spring_network

ASSIGNMENT_TIME_STEP = 1 / 30
"""Time step dt [s]."""
ASSIGNMENT_ITERATIONS = 50
"""Local-global iterations per step; there is no other stop rule."""
ASSIGNMENT_PIN_WEIGHT = 1e10
"""Penalty weight of a pin [N/m]; pins fix vertices at their rest positions."""
ASSIGNMENT_FORCE = (0.0, -9.8, 0.0)
"""External force on every vertex [N], independent of its mass."""


@dataclass(frozen=True, slots=True, eq=False)
class AssignmentScene:
    """A scene of the assignment.

    Attributes:
        obj_path: the mesh file.
        mesh: the mesh, with `mass` (n,) [kg].
        stiffness: of every spring [N/m].
        pinned_vertices: (q,), zero-based, in file order.
    """

    obj_path: Path
    mesh: Mesh
    stiffness: float
    pinned_vertices: NDArray[np.int64]


def read_assignment_scene(path: Path) -> AssignmentScene:
    """Read a scene from a JSON file and the OBJ file that it names.

    A vertex that no face uses remains in the mesh, without mass unless `m` is given.

    Raises:
        InputError: with the file, line and key of each mistake.
    """
    scene = read_assignment_json(path)
    obj = path.parent / scene.obj
    cells = clean_cells(replace(read_obj(obj), segments=NO_PAIRS), CleaningOptions(), obj)
    if not cells.polygons:
        raise InputError(InputMistake("has no faces (f lines), so there are no springs", obj))
    mesh = build_spring_network(cells, "face-pairs", obj)
    fans = np.concatenate(
        [NO_TRIANGLES, *map(split_into_fans, cells.polygons.values())]
    )  # the assignment's code splits faces into fans
    if len(fans) == len(mesh.triangles):  # otherwise faces repeat others, and `mesh` counts each once
        mesh = replace(mesh, triangles=fans)
    pins = _to_zero_based_pins(scene.b, len(mesh.rest_positions), path)
    if scene.m is None:
        mass = compute_voronoi_areas(mesh.rest_positions, mesh.triangles)
        if not mass.any():
            problem = "is missing, and the faces of the OBJ file have no area to take masses from"
            raise InputError(InputMistake(problem, path, key="m"))
    else:
        mass = np.full(len(mesh.rest_positions), float(scene.m))
    return AssignmentScene(obj, replace(mesh, mass=mass, mass_fractions=mass / mass.sum()), scene.k, pins)


def compute_voronoi_areas(rest_positions: PointArray, triangles: IndexArray) -> PointArray:
    """Compute the mixed Voronoi area of each vertex, (n,) [m^2].

    Args:
        rest_positions: (n, 3) [m].
        triangles: (f, 3); triangles without area contribute nothing.
    """
    corners = rest_positions[triangles]
    edges = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)  # edge k lies opposite corner k
    squared = np.einsum("fkx,fkx->fk", edges, edges)
    doubled = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)[:, None]
    dots = -np.einsum("fkx,fkx->fk", np.roll(edges, -1, axis=1), np.roll(edges, 1, axis=1))
    flat = doubled == 0
    nearest = squared * dots / np.where(flat, 1, doubled) / 8
    share = np.roll(nearest, 1, axis=1) + np.roll(nearest, -1, axis=1)
    obtuse = cast(PointArray, np.where(dots < 0, doubled / 4, doubled / 8))
    share = np.where(np.any(dots < 0, axis=1, keepdims=True), obtuse, share)
    share = np.where(flat, 0.0, share)
    return np.bincount(triangles.ravel(), share.ravel(), minlength=len(rest_positions)).astype(np.float64, copy=False)


def _to_zero_based_pins(one_based: list[int], n: int, path: Path) -> NDArray[np.int64]:
    """Convert pins to zero-based vertices; reject missing vertices and repetitions, which would double a penalty."""
    seen: set[int] = set()
    mistakes: list[tuple[int, str]] = []
    for position, vertex in enumerate(one_based):
        if not 1 <= vertex <= n:
            mistakes.append((position, f"vertex {vertex} does not exist; vertices are counted from 1 to {n}"))
        elif vertex in seen:
            mistakes.append((position, f"vertex {vertex} is pinned twice; name each vertex once"))
        seen.add(vertex)
    if mistakes:
        line = find_key_line(path, "b")
        raise InputError([InputMistake(problem, path, line, f"b.{at}") for at, problem in mistakes[:20]])
    return np.array(one_based, np.int64) - 1
