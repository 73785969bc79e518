"""Both implementations of stiffness by areas agree on irregular surfaces, and in the terms of a step."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.spring_stiffness import compute_spring_stiffness

from tests.oracles.area_stiffness import compute_area_scale, list_faces
from tests.oracles.planted_errors import GRAVITY_SPEC, build_scene_spec, run_reference_check

ROUND_OFF = 1e-7
"""The other implementation adds a billionth of its diagonal to a matrix, which a factor of the condition enlarges."""

Faces = list[list[int]]


def random_sheet(seed: int, count: int) -> tuple[np.ndarray, Faces]:
    """A triangulated square of random points, with long triangles at the border."""
    points = np.random.default_rng(seed).uniform(0, 1, (count, 2))
    return np.pad(points, ((0, 0), (0, 1))), Delaunay(points).simplices.tolist()


def regular_grid(side: int) -> np.ndarray:
    """Points of a grid in a square."""
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(side * side)])


def grid_faces(side: int) -> Faces:
    """Quadrangles of a grid."""
    return [[a, a + 1, a + side + 1, a + side] for a in range(side * (side - 1)) if a % side != side - 1]


def moved_grid(side: int, *, height: float = 0.0) -> np.ndarray:
    """Points of a grid, moved at random in the plane, on a bulge of this height."""
    points = regular_grid(side) * [1.0, 2.0, 1.0]
    points[:, :2] += np.random.default_rng(5).uniform(-0.05, 0.05, (side * side, 2))
    points[:, 2] = height * np.sin(3 * points[:, 0]) * np.cos(points[:, 1])
    return points


def mixed_faces() -> Faces:
    """Faces of a grid of 5 x 5: quadrangles, triangles by both diagonals, and an L of three cells."""
    faces: Faces = []
    for k, (a, b, c, d) in enumerate(grid_faces(5)):
        if k in (1, 5, 6):  # an L of three cells
            continue
        faces += [[[a, b, c, d]], [[a, b, c], [a, c, d]], [[a, b, d], [b, c, d]]][k % 3]
    return [*faces, [1, 2, 7, 8, 13, 12, 11, 6]]


def sphere(count: int) -> tuple[np.ndarray, Faces]:
    """A closed surface, of random points on an ellipsoid."""
    points = np.random.default_rng(2).normal(size=(count, 3))
    points = points / np.linalg.norm(points, axis=1)[:, None]
    hull = ConvexHull(points)
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    out = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) > 0
    return points * [1.0, 0.7, 1.4], np.where(out[:, None], hull.simplices, hull.simplices[:, ::-1]).tolist()


def two_parts() -> tuple[np.ndarray, Faces]:
    """Two sheets of other densities, without a common vertex."""
    (a, first), (b, second) = random_sheet(3, 12), random_sheet(4, 25)
    return np.concatenate([a, 3 * b + 5]), first + [[v + len(a) for v in face] for face in second]


MESHES = {
    "one triangle": (np.array([[0, 0, 0], [2, 0, 0], [0.3, 1, 0.0]]), [[0, 1, 2]]),
    "random sheet": random_sheet(0, 30),
    "random long sheet": ((sheet := random_sheet(1, 40))[0] * [5.0, 1.0, 1.0], sheet[1]),
    "long quadrangles": (regular_grid(5) * [1.0, 3.0, 1.0], grid_faces(5)),
    "moved quadrangles": (moved_grid(5), grid_faces(5)),
    "mixed faces": (moved_grid(5), mixed_faces()),
    "curved mixed faces": (moved_grid(5, height=0.3), [f for f in mixed_faces() if len(f) < 5]),
    "closed surface": sphere(40),
    "two parts": two_parts(),
}


def build_mesh(folder: Path, name: str, **options: str) -> FileMesh:
    """The mesh of an OBJ file."""
    points, faces = MESHES[name]
    lines = ["v {!r} {!r} {!r}".format(*map(float, p)) for p in points]
    lines += ["f " + " ".join(str(v + 1) for v in face) for face in faces]
    (folder / "mesh.obj").write_text("\n".join(lines))
    return FileMesh.model_validate({"path": folder / "mesh.obj"} | options)


@pytest.mark.parametrize("spring_rule", ["edges", "face-pairs"])
@pytest.mark.parametrize("name", MESHES)
def test_each_spring_has_the_stiffness_of_both_implementations(tmp_path: Path, name: str, spring_rule: str):
    mesh = build_mesh(tmp_path, name, spring_rule=spring_rule).build_mesh()
    found = compute_spring_stiffness(mesh, scaling_rule="area", stretch=1.0, shear=1.0, bend=0.0)
    np.testing.assert_allclose(compute_area_scale(mesh), found, rtol=ROUND_OFF)


def test_faces_are_found_again_from_their_triangles(tmp_path: Path):
    mesh = build_mesh(tmp_path, "mixed faces", spring_rule="face-pairs").build_mesh()
    assert sorted(len(sides) for sides, _, _ in list_faces(mesh)) == sorted(map(len, MESHES["mixed faces"][1]))


@pytest.mark.parametrize("name", ["one triangle", "long quadrangles"])  # nothing moves, so no regularisation differs
def test_a_step_has_the_terms_of_both_implementations(tmp_path: Path, name: str):
    build_mesh(tmp_path, name)
    springs = {"kind": "springs", "stretch": 300, "shear": 60, "scaling_rule": "area"}
    spec = build_scene_spec(springs, GRAVITY_SPEC, mesh={"kind": "file", "path": tmp_path / "mesh.obj"})
    assert run_reference_check(spec) == "agrees"
