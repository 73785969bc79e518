"""One material on any mesh: stiffness by areas passes patch tests, and the resulting modulus is stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import Delaunay
from springbench.harness.cli.main import app
from springbench.harness.errors import InputError
from springbench.harness.scenes.membrane_modulus import compute_area_stiffness, compute_membrane_modulus
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.mesh import SHEAR, STRETCH, Mesh
from springbench.harness.scenes.spring_stiffness import compute_spring_stiffness
from typer.testing import CliRunner

SIDE = 7
EXACT = 1e-7
"""The matrix of the relaxation has a billionth of its diagonal added, which a factor of the condition enlarges."""


def write_mesh(folder: Path, points: np.ndarray, faces: np.ndarray, **options) -> Mesh:
    """The mesh of an OBJ file with these points (n, 2) or (n, 3) and faces."""
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    lines = ["v {!r} {!r} {!r}".format(*map(float, p)) for p in points]
    lines += ["f " + " ".join(map(str, face + 1)) for face in faces]
    path = folder / "mesh.obj"
    path.write_text("\n".join(lines))
    return FileMesh(path=path, **options).build_mesh()


def square_points() -> np.ndarray:
    """The vertices of a square grid with sides of length 1."""
    x, y = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE))
    return np.column_stack([x.ravel(), y.ravel()])


def square_quads() -> np.ndarray:
    """The cells of that grid."""
    a = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    return np.column_stack([a, a + 1, a + SIDE + 1, a + SIDE])


def square_triangles(*, alternates: bool) -> np.ndarray:
    """The cells of that grid, divided by one diagonal each, in one direction or in alternating ones."""
    quads = square_quads()
    odd = (
        (np.arange(len(quads)) // (SIDE - 1) + np.arange(len(quads))) % 2 == 1
        if alternates
        else np.zeros(len(quads), bool)
    )
    quads = np.where(odd[:, None], np.roll(quads, -1, axis=1), quads)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def random_points(seed: int, count: int) -> np.ndarray:
    """Points in the square, and its border at the distances of the grid."""
    points = square_points()
    border = points[(np.abs(points - 0.5) == 0.5).any(axis=1)]
    return np.concatenate([border, np.random.default_rng(seed).uniform(0.05, 0.95, (count, 2))])


def irregular(name: str) -> tuple[np.ndarray, np.ndarray]:
    """One of ten triangulations of a square, and its points."""
    points = square_points()
    rng = np.random.default_rng(7)
    inner = np.all(np.abs(points - 0.5) < 0.499, axis=1)
    moved = points + inner[:, None] * rng.uniform(-0.04, 0.04, points.shape)
    if name == "one diagonal":
        return points, square_triangles(alternates=False)
    if name == "union jack":
        return points, square_triangles(alternates=True)
    if name == "moved one diagonal":
        return moved, square_triangles(alternates=False)
    if name == "moved union jack":
        return moved, square_triangles(alternates=True)
    if name == "graded":
        return points**1.5, square_triangles(alternates=True)
    if name == "long cells":
        return points * [3.0, 1.0], square_triangles(alternates=False)
    seed, count = map(int, name.split()[1:])
    found = random_points(seed, count)
    return found, Delaunay(found).simplices


TEN_MESHES = (
    "one diagonal",
    "union jack",
    "moved one diagonal",
    "moved union jack",
    "graded",
    "long cells",
    "random 0 20",
    "random 1 30",
    "random 2 40",
    "random 3 80",
)


def relaxed_energy(mesh: Mesh, k: np.ndarray, strain: np.ndarray) -> float:
    """The energy of springs after a strain (2, 2) of the boundary, by a dense solve of the linear network, in 2D."""
    p, (i, j), n = mesh.rest_positions[:, :2], mesh.springs.T, len(mesh.rest_positions)
    unit = (p[j] - p[i]) / mesh.spring_distances[:, None]
    moves = np.zeros((len(k), n, 2))
    moves[np.arange(len(k)), i], moves[np.arange(len(k)), j] = -unit, unit
    moves = moves.reshape(len(k), -1)
    sides, count = np.unique(
        np.sort(np.concatenate([mesh.triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (0, 2))]), axis=1),
        axis=0,
        return_counts=True,
    )
    fixed = np.zeros(n, bool)
    fixed[sides[count == 1]] = True
    free = np.repeat(~fixed, 2)
    u = (p @ strain).ravel()
    stiff = moves.T @ (k[:, None] * moves)
    u[free] = np.linalg.lstsq(stiff[np.ix_(free, free)], -stiff[np.ix_(free, ~free)] @ u[~free], rcond=1e-12)[0]
    return float(0.5 * u @ stiff @ u)


@pytest.mark.parametrize("name", TEN_MESHES)
def test_a_uniform_stretch_of_any_triangulation_has_the_energy_of_the_sheet(tmp_path, name):
    mesh = write_mesh(tmp_path, *irregular(name))
    k = compute_spring_stiffness(mesh, scaling_rule="area", stretch=500.0, shear=500.0, bend=0.0)
    e = 1e-3  # an isotropic sheet of Poisson's ratio 1/3: E / (1 - nu) e^2 for each unit of area
    expected = 500.0 / (1 - 1 / 3) * e**2 * mesh.surface_area
    assert relaxed_energy(mesh, k, e * np.eye(2)) == pytest.approx(expected, rel=EXACT)
    constant = compute_spring_stiffness(mesh, scaling_rule="continuum", stretch=500.0, shear=500.0, bend=0.0)
    assert abs(relaxed_energy(mesh, constant, e * np.eye(2)) / expected - 1) > 0.03  # which is what `area` is for


@pytest.mark.parametrize("name", [name for name in TEN_MESHES if "random" in name or "moved union" in name])
def test_the_modulus_of_irregular_meshes_is_near_the_stated_one_in_every_direction(tmp_path, name):
    mesh = write_mesh(tmp_path, *irregular(name))
    found = compute_membrane_modulus(mesh, mesh.springs, compute_area_stiffness(mesh))
    assert found.mean == pytest.approx(1.0, abs=0.1)  # relaxation softens shear more than uniform stretch
    assert found.modulus_anisotropy < 0.25
    assert 0.2 < found.poisson[0] < found.poisson[1] < 0.5


def test_the_modulus_is_that_of_three_relaxed_strains(tmp_path):
    mesh = write_mesh(tmp_path, *irregular("random 1 30"))
    k = compute_area_stiffness(mesh)
    strains = [np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0, 0.5], [0.5, 0]])]
    energy = [[relaxed_energy(mesh, k, a + b) for b in strains] for a in strains]
    own = [relaxed_energy(mesh, k, a) for a in strains]
    tensor = np.array([[energy[a][b] - own[a] - own[b] for b in range(3)] for a in range(3)]) / mesh.surface_area
    along_x = 1.0 / np.linalg.inv(tensor)[0, 0]
    found = compute_membrane_modulus(mesh, mesh.springs, k)
    assert found.low - 1e-6 <= along_x <= found.high + 1e-6


def test_the_modulus_of_a_curved_surface_is_near_that_of_the_same_mesh_when_flat(tmp_path):
    points, faces = irregular("random 3 80")
    flat = write_mesh(tmp_path, points, faces)
    rolled = np.column_stack([np.cos(points[:, 0]), points[:, 1], np.sin(points[:, 0])])  # no length changes
    curved = write_mesh(tmp_path, rolled, faces)
    one, two = (compute_membrane_modulus(mesh, mesh.springs, compute_area_stiffness(mesh)) for mesh in (flat, curved))
    assert two.mean == pytest.approx(1.0, abs=0.03)
    assert two.mean == pytest.approx(one.mean, abs=0.1)  # shear relaxes more than the uniform stretch
    assert two.modulus_anisotropy < 0.2


def test_equilateral_triangles_have_the_stiffness_of_the_lattice(tmp_path):
    rows, columns = np.mgrid[:5, :6]
    points = np.column_stack([(columns + rows / 2).ravel(), (np.sqrt(3) / 2 * rows).ravel()])
    a = (rows[:-1, :-1] * 6 + columns[:-1, :-1]).ravel()
    mesh = write_mesh(
        tmp_path, points, np.concatenate([np.column_stack([a, a + 1, a + 6]), np.column_stack([a + 1, a + 7, a + 6])])
    )
    k = compute_spring_stiffness(mesh, scaling_rule="area", stretch=2.0, shear=2.0, bend=0.0)
    assert mesh.spring_areas is not None
    inner = mesh.spring_areas > 0.6  # edges with two triangles
    assert k[inner] == pytest.approx(np.sqrt(3), rel=EXACT)  # sqrt(3)/2 E
    assert k[~inner] == pytest.approx(np.sqrt(3) / 2, rel=EXACT)


def test_quads_have_the_stated_stiffness_along_their_sides_and_diagonals(tmp_path):
    mesh = write_mesh(tmp_path, square_points(), square_quads(), spring_rule="face-pairs")
    k = compute_spring_stiffness(mesh, scaling_rule="area", stretch=2.0, shear=0.0, bend=0.0)
    assert (k[mesh.spring_families[SHEAR]] == 0).all()
    assert k[mesh.spring_families[STRETCH]].max() == pytest.approx(2.0, rel=EXACT)  # half on the boundary
    k = compute_spring_stiffness(mesh, scaling_rule="area", stretch=0.0, shear=3.0, bend=0.0)
    assert k[mesh.spring_families[SHEAR]] == pytest.approx(np.full(2 * (SIDE - 1) ** 2, 3.0), rel=EXACT)


def test_a_solid_resists_uniform_dilation_as_stated(tmp_path):
    import meshio

    rng = np.random.default_rng(3)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    points = np.concatenate([corners, rng.uniform(0.2, 0.8, (12, 3))])
    path = tmp_path / "mesh.vtu"
    meshio.Mesh(points, [("tetra", Delaunay(points).simplices)]).write(path)
    mesh = FileMesh(path=path).build_mesh()
    k = compute_area_stiffness(mesh)
    i, j = mesh.springs.T
    unit = (mesh.rest_positions[j] - mesh.rest_positions[i]) / mesh.spring_distances[:, None]
    moves = np.zeros((len(k), len(points), 3))
    moves[np.arange(len(k)), i], moves[np.arange(len(k)), j] = -unit, unit
    moves = moves[:, 8:].reshape(len(k), -1)
    stiff = moves.T @ (k[:, None] * moves)
    u = np.linalg.solve(stiff, moves.T @ (k * mesh.spring_distances))
    relaxed = mesh.spring_distances - moves @ u
    assert k @ relaxed**2 == pytest.approx(6.0, rel=EXACT)  # six edges, each with the volume around it


def test_meshes_without_faces_are_refused(tmp_path):
    with pytest.raises(InputError, match="use continuum"):
        compute_spring_stiffness(GridMesh().build_mesh(4), scaling_rule="area", stretch=1.0, shear=1.0, bend=0.0)
    path = tmp_path / "mesh.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 2 0\nf 1 2 3\nl 3 4\n")
    with pytest.raises(InputError, match=r"the spring 2-3 \(3, 4 in the file\) has no adjacent face"):
        compute_spring_stiffness(
            FileMesh(path=path).build_mesh(), scaling_rule="area", stretch=1.0, shear=1.0, bend=0.0
        )
    path.write_text("v 0 0 0\nv 2 0 0\nv 2 1 0\nl 1 2 3\n")
    mesh = FileMesh(path=path).build_mesh()
    assert compute_spring_stiffness(mesh, scaling_rule="area", stretch=4.0, shear=4.0, bend=0.0).tolist() == [2.0, 4.0]


SCENE = """
mesh: {kind: file, path: mesh.obj}
mass: 1
time_step: 1/30
frames: 2
effects: [{kind: springs, scaling_rule: area, stretch: 500}, {kind: gravity}, {kind: pins, parts: [top]}]
"""


def test_a_run_states_the_modulus_and_its_anisotropy(tmp_path, caplog):
    caplog.set_level("INFO")
    write_mesh(tmp_path, *irregular("union jack"))
    (tmp_path / "scene.yaml").write_text(SCENE)
    CliRunner().invoke(app, ["list", str(tmp_path / "scene.yaml")])
    (line,) = [message for message in caplog.messages if "membrane stiffness" in message]
    assert "effects[0] (springs, area) states 500 N/m: membrane stiffness 375 to 600 N/m by direction" in line
    assert "isotropic within 23%" in line
    caplog.clear()
    (tmp_path / "scene.yaml").write_text(SCENE.replace("stretch: 500", "youngs_modulus: 5.0e+8, thickness: 1.0e-3"))
    CliRunner().invoke(app, ["list", str(tmp_path / "scene.yaml")])
    assert any("states 500000 N/m: membrane stiffness" in message for message in caplog.messages)
    assert any("was `thickness` given in mm?" in message for message in caplog.messages)
    caplog.clear()
    (tmp_path / "scene.yaml").write_text(SCENE)
    write_mesh(tmp_path, square_points(), square_quads())
    CliRunner().invoke(app, ["list", str(tmp_path / "scene.yaml")])
    assert any("nothing resists shear" in message for message in caplog.messages)
