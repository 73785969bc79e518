"""`springbench matrices`: the E, A, C, M, Q, y, d, b of the assignment, against plain NumPy; files and a picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.io import mmread, mmwrite
from scipy.sparse import coo_array, csr_array
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import InputError
from springbench.harness.experiments.grading.local_global_matrices import (
    build_local_global_matrices,
    iterate_local_global,
    save_matrices,
)
from springbench.harness.experiments.grading.matrix_comparison import compare_matrix_file
from springbench.harness.experiments.grading.spring_terms import build_graded_scene, build_step_problem
from typer.testing import CliRunner

SHARED_SCENES = Path(__file__).resolve().parents[3] / "shared" / "scenes"
ROUND_OFF = 1e-12
"""A few operations in another order, relative to the largest entry."""

PATCH = "v 0 0 0\nv 1.1 0 0.2\nv 1 1 0\nv 0 0.9 0.1\nv 2 1.2 0\nf 1 2 3 4\nf 3 2 5\n"
CHAIN_YAML = """
mesh: {kind: chain}
mass: 0.6
time_step: 1/20
frames: 3
default_size: 4
velocity: [0.5, 0, -1]
effects: [{kind: springs, stretch: 40}, {kind: gravity}, {kind: pins, parts: [first], weight: exact}]
"""


def written_assignment(folder: Path, **changes) -> Path:
    (folder / "patch.obj").write_text(PATCH)
    path = folder / "patch.json"
    path.write_text(json.dumps({"obj": "patch.obj", "k": 70, "b": [4, 1], "m": 0.5} | changes))
    return path


def plain_matrices(V, E, k, m, dt, pinned, w, force) -> dict[str, np.ndarray]:
    """The tutorial's definitions, entry by entry, of the first step from rest."""
    A, C, M = np.zeros((len(E), len(V))), np.zeros((len(pinned), len(V))), np.zeros((len(V), len(V)))
    for e, (i, j) in enumerate(E):
        A[e, i], A[e, j] = 1, -1
    for row, vertex in enumerate(pinned):
        C[row, vertex] = 1
    for i, mass in enumerate(m):
        M[i, i] = mass
    r = np.array([np.linalg.norm(V[i] - V[j]) for i, j in E])
    Q = k * A.T @ A + M / dt**2 + w * C.T @ C
    y = M @ (2 * V - V) / dt**2 + force + w * C.T @ C @ V
    v = A @ V
    d = r[:, None] * v / np.linalg.norm(v, axis=1)[:, None]
    return {"A": A, "C": C, "M": M, "Q": Q, "y": y, "d": d, "b": k * A.T @ d + y}


def dense(value) -> np.ndarray:
    return value.toarray() if isinstance(value, csr_array) else np.asarray(value)


def check_against_plain(path: Path) -> None:
    spec = load_scene(path)
    scene = build_graded_scene(spec, 0)
    made = build_local_global_matrices(scene, 1, spec.initial_guess)
    data = json.loads(path.read_text())
    V, m = scene.mesh.rest_positions, scene.system.mass
    expected = plain_matrices(
        V, made.E, data["k"], m, 1 / 30, np.array(data["b"]) - 1, 1e10, np.tile([0, -9.8, 0], (len(V), 1))
    )
    rows = [data["b"].index(vertex + 1) for vertex in made.terms.pinned]
    expected["C"] = expected["C"][rows]  # the order of the pins is free
    for name, value in expected.items():
        np.testing.assert_allclose(dense(getattr(made, name)), value, rtol=0, atol=ROUND_OFF * np.abs(value).max())
    for name, matrix in made.sparse_matrices.items():
        assert matrix.nnz == np.count_nonzero(expected[name])  # no zeros are stored


def test_matrices_are_those_of_plain_numpy(tmp_path):
    check_against_plain(written_assignment(tmp_path))


@pytest.mark.parametrize("name", ["single-spring-horizontal", "horizontal-chain", "net"])
def test_matrices_of_the_published_scenes_are_those_of_plain_numpy(name):
    if not (SHARED_SCENES / f"{name}.json").exists():
        pytest.skip("the assignment's scenes are not part of this repository")
    check_against_plain(SHARED_SCENES / f"{name}.json")


def test_the_files_have_the_same_matrices(tmp_path):
    made = build_local_global_matrices(build_graded_scene(load_scene(written_assignment(tmp_path)), 0))
    save_matrices(made, tmp_path / "out")
    with np.load(tmp_path / "out" / "matrices.npz") as stored:
        for name, matrix in made.sparse_matrices.items():
            parts = stored[f"{name}_data"], stored[f"{name}_indices"], stored[f"{name}_indptr"]
            difference: Any = csr_array(parts, shape=tuple(stored[f"{name}_shape"])) != matrix
            assert difference.nnz == 0
        for name, values in made.dense_arrays.items():
            np.testing.assert_array_equal(stored[name], values)
    for name in ("A", "C", "M", "Q"):
        read: Any = mmread(tmp_path / "out" / f"{name}.mtx")
        assert read.nnz == made.sparse_matrices[name].nnz
        np.testing.assert_array_equal(read.toarray(), made.sparse_matrices[name].toarray())
    np.testing.assert_array_equal(mmread(tmp_path / "out" / "b.mtx"), made.b)


def test_exact_pins_are_no_part_of_q_and_the_iteration_leaves_them_in_place(tmp_path):
    (tmp_path / "chain.yaml").write_text(CHAIN_YAML)
    scene = build_graded_scene(load_scene(tmp_path / "chain.yaml"), 4)
    made = build_local_global_matrices(scene)
    A, M = made.A.toarray(), made.M.toarray()
    np.testing.assert_allclose(made.Q.toarray(), A.T @ (made.k[:, None] * A) + M * 400, rtol=ROUND_OFF)
    V, v0, dt = scene.mesh.rest_positions, np.array([0.5, 0, -1]), 1 / 20
    p = V.copy()
    force = M.diagonal()[:, None] * [0, -9.81, 0]
    free = made.terms.free_vertices
    y = M @ (V + dt * v0) / dt**2 + force
    np.testing.assert_allclose(made.y[free], y[free], rtol=1e-9)
    Q, fixed = made.Q.toarray(), made.terms.pinned
    for _ in range(7):
        v = A @ p
        d = made.r[:, None] * v / np.linalg.norm(v, axis=1)[:, None]
        right = (A.T @ (made.k[:, None] * d) + y)[free] - Q[np.ix_(free, fixed)] @ V[fixed]
        p[free] = np.linalg.solve(Q[np.ix_(free, free)], right)
    problem = build_step_problem(scene, V, V - dt * v0, 0)
    found = iterate_local_global(made.terms, made.Q, problem, 7)
    np.testing.assert_allclose(found, p, atol=1e-12)
    np.testing.assert_array_equal(found[fixed], V[fixed])


def test_the_first_guess_of_a_step_problem_is_one_that_exists(tmp_path):
    scene = build_graded_scene(load_scene(written_assignment(tmp_path)), 0)
    V = scene.mesh.rest_positions
    coarse, previous = (build_step_problem(scene, V, V, 0, name) for name in ("coarse-to-fine", "previous"))
    np.testing.assert_array_equal(coarse.initial_guess, previous.initial_guess)
    with pytest.raises(InputError, match=r"got 'previus'; expected one of .*; did you mean 'previous'"):
        build_step_problem(scene, V, V, 0, "previus")


@pytest.mark.slow
def test_the_command_prints_formulas_and_writes_a_picture(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written_assignment(tmp_path)
    answer = CliRunner().invoke(app, ["matrices", "patch.json", "--frame", "2"])
    assert answer.exit_code == 0, answer.output
    for words in ("Q = k A'A + M/dt^2 + w C'C", "b = k A'd + y", "E: 8 x 2", "A: 8 x 5, 16 entries", "w = 1e+10 N/m"):
        assert words in answer.output
    with Image.open("patch-matrices/sparsity.png") as picture:
        assert picture.width == 1600


@pytest.mark.parametrize(
    ("effects", "words"),
    [
        ("[{kind: springs, stretch: 40}, {kind: bending, stiffness: 1}]", "Bending"),
        ("[{kind: gravity}]", "no springs"),
    ],
)
def test_a_scene_that_the_formulas_do_not_cover_is_refused(effects, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cloth.yaml").write_text(
        f"mesh: {{kind: grid}}\nmass: 1\ntime_step: 0.01\nframes: 1\ndefault_size: 3\neffects: {effects}\n"
    )
    answer = CliRunner().invoke(app, ["matrices", "cloth.yaml"])
    assert answer.exit_code == 2
    assert words in answer.output
    assert "effects" in answer.output


def test_a_matrix_of_another_program_is_compared_and_stored_zeros_are_counted(tmp_path):
    made = build_local_global_matrices(build_graded_scene(load_scene(written_assignment(tmp_path)), 0))
    n = made.terms.num_vertices
    pins = np.diag(np.isin(np.arange(n), made.terms.pinned) * 1e10)
    rows, columns = np.indices((n, n)).reshape(2, -1)
    every = coo_array((made.Q.toarray().ravel(), (rows, columns)), shape=(n, n))
    for matrix, name, words in (
        (made.Q, "Q", "equal to Q of the scene"),
        (every, "Q", f"equal to Q of the scene; {n * n - made.Q.nnz} stored entries are zero"),
        (coo_array(made.Q.toarray() - pins), "Q", "Q without the pins"),
        (coo_array(-made.A.toarray()[::-1]), "A", "equal to A of the scene, up to the order of its rows"),
        (coo_array(np.abs(made.A.toarray())), "A", "not A of the scene"),
        (made.y + (made.b - made.y) / 70, "b", "b without k"),
        (made.d + np.eye(8, 3), "d", "differs most at row"),
        (-made.d[::-1], "d", "equal to d of the scene, up to the order and the sign of its rows"),
    ):
        mmwrite(str(tmp_path / f"{name}.mtx"), matrix, precision=17, symmetry="general")
        assert words in compare_matrix_file(made, tmp_path / f"{name}.mtx")
    with pytest.raises(InputError, match="should be named A"):
        compare_matrix_file(made, tmp_path / "K.mtx")
