"""Scenes in the assignment's format, against the assignment itself, written out once more in plain NumPy."""

from __future__ import annotations

import json
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.scene_builder import build_scene

from tests.scene_builders import LOCAL_GLOBAL_BACKENDS, simulate_trajectory

FRAMES = 30
AGREEMENT = 1e-9
"""Of the scene's size: round-off of 1500 solves with condition numbers up to 1e8, which motion amplifies."""

CHAIN = """
v 0 0 0\nv 0.3 0.1 0\nv 0.5 0 0.2\nv 0.9 0 0\nv 1.2 -0.1 0
f 1 2\nf 2 3\nf 4 3\nf 4 5
"""
CLOTH = "\n".join(
    [f"v {x / 3 + 0.02 * y} {-0.1 * y * x} {y / 3}" for y in range(4) for x in range(4)]
    + [f"f {4 * y + x + 1} {4 * y + x + 2}/1 {4 * y + x + 6}//1 {4 * y + x + 5}" for y in range(3) for x in range(3)]
)
TRIANGLES = """
v 0 0 0\nv 1 0 0\nv 2 0.2 0\nv 0.4 1 0.1\nv 1.4 1 0\nv 5 0.1 0
f 1 2 4\nf 2 5 4\nf 2 3 5\nf 3 6 5
"""
SCENES = {
    "chain": (CHAIN, {"k": 500, "m": 1, "b": [1, 5]}),
    "cloth-voronoi": (CLOTH, {"k": 1e3, "b": [1, 4]}),
    "cloth-m": (CLOTH, {"k": 300, "m": 0.5, "b": [4]}),
    "triangles-obtuse": (TRIANGLES, {"k": 200.0, "b": [2, 1], "png": "none.png"}),
}


def read(obj: str) -> tuple[np.ndarray, list[list[int]]]:
    words = [line.split() for line in obj.splitlines() if line]
    V = np.array([[float(x) for x in w[1:]] for w in words if w[0] == "v"])
    return V, [[int(x.split("/")[0]) - 1 for x in w[1:]] for w in words if w[0] == "f"]


def springs(faces: list[list[int]]) -> np.ndarray:
    if all(len(face) == 2 for face in faces):
        return np.array(faces)
    return np.array(sorted({(min(e), max(e)) for face in faces for e in combinations(face, 2)}))


def voronoi_mass(V: np.ndarray, faces: list[list[int]]) -> np.ndarray:
    """Mixed Voronoi areas by the angles of the triangles of each polygon's fan."""
    mass = np.zeros(len(V))
    for face in faces:
        for b, c in pairwise(face[1:]):
            corners = [face[0], b, c]
            sides = np.array([np.linalg.norm(V[corners[k - 2]] - V[corners[k - 1]]) for k in range(3)])
            a = np.arccos((sides @ sides - 2 * sides**2) * sides / (2 * sides.prod()))  # the law of cosines
            area = 0.5 * sides[0] * sides[1] * np.sin(a[2])
            for k in range(3):
                others = [(k + 1) % 3, (k + 2) % 3]
                share = sum(sides[j] ** 2 / np.tan(a[j]) / 8 for j in others)
                if a.max() > np.pi / 2:
                    share = area / 2 if a[k] > np.pi / 2 else area / 4
                mass[corners[k]] += share
    return mass


def assignment(obj: str, scene: dict) -> np.ndarray:
    """The positions after each step, shape (FRAMES, n, 3), as the tutorial has it: dense, 50 iterations."""
    V, faces = read(obj)
    E, k, dt, w = springs(faces), scene["k"], 1 / 30, 1e10
    m = np.full(len(V), float(scene["m"])) if "m" in scene else voronoi_mass(V, faces)
    A, C = np.zeros((len(E), len(V))), np.zeros((len(scene["b"]), len(V)))
    A[np.arange(len(E)), E[:, 0]], A[np.arange(len(E)), E[:, 1]] = 1, -1
    C[np.arange(len(C)), np.array(scene["b"]) - 1] = 1
    r, M, f_ext = np.linalg.norm(A @ V, axis=1), np.diag(m), np.tile([0, -9.8, 0], (len(V), 1))
    Q = k * A.T @ A + M / dt**2 + w * C.T @ C
    cur, prev, steps = V, V, []
    for _ in range(FRAMES):
        y = M @ (2 * cur - prev) / dt**2 + f_ext + w * C.T @ C @ V
        p = cur
        for _ in range(50):
            v = A @ p
            d = r[:, None] * v / np.linalg.norm(v, axis=1)[:, None]
            p = np.linalg.solve(Q, k * A.T @ d + y)
        cur, prev = p, cur
        steps.append(p)
    return np.array(steps)


def write_scene(folder: Path, name: str) -> Path:
    obj, scene = SCENES[name]
    (folder / f"{name}.obj").write_text(obj)
    path = folder / f"{name}.json"
    path.write_text(json.dumps({"obj": f"{name}.obj", **scene}))
    return path


@pytest.mark.parametrize("backend", LOCAL_GLOBAL_BACKENDS, ids=lambda b: type(b).__name__)
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_moves_as_the_assignment_moves_it(name, backend, tmp_path):
    spec = load_scene(write_scene(tmp_path, name))
    made = build_scene(spec, 0)
    found = simulate_trajectory(made, backend, FRAMES, initial_guess=spec.initial_guess)
    expected = assignment(*SCENES[name])
    assert np.abs(found - expected).max() <= AGREEMENT * made.mesh.bounding_box_diagonal
    assert np.abs(expected - expected[0]).max() > 0.01 * made.mesh.bounding_box_diagonal  # it does move


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_read_as_the_assignment_reads_it(name, tmp_path):
    spec = load_scene(write_scene(tmp_path, name))
    made = build_scene(spec, 0)
    obj, scene = SCENES[name]
    V, faces = read(obj)
    np.testing.assert_array_equal(made.mesh.rest_positions, V)
    assert sorted(map(sorted, made.all_springs.edges.tolist())) == sorted(map(sorted, springs(faces).tolist()))
    mass = np.full(len(V), scene["m"]) if "m" in scene else voronoi_mass(V, faces)
    np.testing.assert_allclose(made.system.mass, mass, rtol=1e-12)  # a cotangent near a right angle
    assert sorted(made.system.pins.vertices + 1) == sorted(scene["b"])
    assert set(made.system.pins.weight) == {1e10}
    assert (made.system.time_step, spec.frames, spec.initial_guess) == (1 / 30, FRAMES, "assignment")
