"""The assignment in plain NumPy, dense, with one of many mistakes: one small program, none of the product's code."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np

CLOTH = "\n".join(
    [f"v {x / 3 + 0.02 * y:.4f} {-0.1 * y * x / 3 + 0.5:.4f} {y / 3 + 0.2:.4f}" for y in range(4) for x in range(4)]
    + [f"f {4 * y + x + 1} {4 * y + x + 2} {4 * y + x + 6} {4 * y + x + 5}" for y in range(3) for x in range(3)]
)
ROPE = "v 0 0 0\nv 0.3 0.1 0\nv 0.5 0 0.2\nv 0.9 0 0\nv 1.2 -0.1 0\nf 1 2\nf 2 3\nf 4 3\nf 4 5"
SCENES = {
    "cloth": (CLOTH, {"k": 90, "b": [2, 4], "m": 0.4}),
    "rope": (ROPE, {"k": 300, "b": [1], "m": 0.7}),
    "sheet": (CLOTH, {"k": 40, "b": [1, 4]}),
}
"""OBJ files and scenes; the third has masses by areas."""


def write_scene(folder: Path, name: str) -> Path:
    """Write a scene as the assignment has it, and return its JSON file."""
    obj, scene = SCENES[name]
    (folder / f"{name}.obj").write_text(obj)
    path = folder / f"{name}.json"
    path.write_text(json.dumps({"obj": f"{name}.obj", **scene}))
    return path


def read_scene(path: Path) -> dict:
    """Read V, E, k, b (from 0) and m of a scene whose masses are stated; masses by areas are given by the caller."""
    scene = json.loads(path.read_text())
    words = [line.split() for line in (path.parent / scene["obj"]).read_text().splitlines() if line.strip()]
    V = np.array([[float(x) for x in w[1:4]] for w in words if w[0] == "v"])
    faces = [[int(x.split("/")[0]) - 1 for x in w[1:]] for w in words if w[0] == "f"]
    if all(len(face) == 2 for face in faces):
        E = np.array(faces)
    else:
        E = np.array(sorted({(min(e), max(e)) for face in faces for e in combinations(face, 2)}))
    m = np.full(len(V), float(scene["m"])) if "m" in scene else None
    return {"V": V, "E": E, "k": float(scene["k"]), "b": np.array(scene["b"]) - 1, "m": m}


def simulate(scene: dict, frames: int, mistake: str = "", iterations: int = 50) -> np.ndarray:
    """Return the positions after each step, (frames, n, 3), of the program with a mistake."""
    V, E, k, b, m = (scene[key] for key in ("V", "E", "k", "b", "m"))
    n, dt, w = len(V), 1 / 30, 1e10
    if mistake == "time step":
        dt = 1 / 60
    if mistake == "dt not squared":
        dt = dt**0.5
    if mistake == "pins from 0":
        b = b[b + 1 < n] + 1
    A, C = np.zeros((len(E), n)), np.zeros((len(b), n))
    A[np.arange(len(E)), E[:, 0]], A[np.arange(len(E)), E[:, 1]] = 1, -1
    C[np.arange(len(C)), b] = 1
    M, r, pin = np.diag(m), np.linalg.norm(A @ V, axis=1), C.T @ C
    f = np.tile([0.0, -9.8, 0.0], (n, 1))
    if mistake == "gravity as acceleration":
        f = M @ f
    if mistake == "gravity along z":
        f = f[:, [0, 2, 1]]
    if mistake == "gravity upwards":
        f = -f
    if mistake == "no gravity":
        f = 0 * f
    in_Q = {"pins not in Q": 0, "pins subtracted in Q": -1}.get(mistake, 1) * w * pin
    Q = (1 if mistake == "k not in Q" else k) * A.T @ A + in_Q
    Q = Q + (np.eye(n) if mistake in ("masses not in Q", "unit masses") else M) / dt**2
    Q_inverse = np.linalg.inv(Q)
    in_y = {"pins not in b": 0, "pins subtracted in b": -1}.get(mistake, 1) * w * pin @ V
    k_b = 1 if mistake == "k not in b" else k
    M_y = np.eye(n) if mistake in ("masses not in y", "unit masses") else M
    prev, cur, out = V.copy(), V.copy(), []
    for _ in range(frames):
        if mistake == "previous overwritten":
            prev = cur
        if mistake == "explicit":
            v = A @ cur
            pull = k * A.T @ (v - r[:, None] * v / np.linalg.norm(v, axis=1)[:, None])
            new = 2 * cur - prev + dt**2 * (f - pull) / m[:, None]
            new[b] = V[b]
            prev, cur = cur, new
            out.append(new)
            continue
        y = M_y @ (2 * cur - prev) / dt**2 + f + in_y
        now = np.linalg.norm(A @ cur, axis=1)
        p = cur
        for _ in range({"one iteration": 1, "four iterations": 4}.get(mistake, iterations)):
            v = A @ p
            length = np.linalg.norm(v, axis=1)[:, None]
            d = r[:, None] * v / length
            if mistake == "d not normalised":
                d = r[:, None] * v
            if mistake == "d is v":
                d = v
            if mistake == "d without r":
                d = v / length
            if mistake == "current lengths":
                d = now[:, None] * v / length
            if mistake == "d reversed":
                d = -d
            if mistake == "y from the iterate":
                y = M_y @ (2 * p - prev) / dt**2 + f + in_y
            p = Q_inverse @ (k_b * A.T @ d + y)
        prev, cur = cur, p
        out.append(p)
    positions = np.array(out)
    if mistake == "one frame late":
        positions = np.concatenate([V[None], positions[:-1]])
    if mistake == "axes swapped":
        positions = positions[:, :, [0, 2, 1]]
    return positions


MISTAKES = {
    "gravity as acceleration": "force times mass",
    "gravity along z": "force on another axis",
    "gravity upwards": "force upwards",
    "no gravity": "no external force",
    "masses not in y": "masses left out of y",
    "masses not in Q": "masses left out of Q",
    "unit masses": "all masses 1",
    "k not in b": "k left out of b",
    "k not in Q": "k left out of Q",
    "previous overwritten": "no inertia",
    "y from the iterate": "y from the iterate",
    "pins not in Q": "pins left out of Q",
    "pins not in b": "pins left out of b",
    "pins subtracted in Q": "pins with the wrong sign",
    "pins subtracted in b": "pins with the wrong sign",
    "pins from 0": "other pins",
    "d not normalised": "d not normalised",
    "d is v": "d not normalised",
    "d without r": "d without rest lengths",
    "d reversed": "d with the wrong sign",
    "current lengths": "rest lengths of the current mesh",
    "one iteration": "too few iterations",
    "four iterations": "too few iterations",
    "explicit": "explicit step",
    "time step": "wrong time step",
    "dt not squared": "wrong time step",
    "one frame late": "one frame late",
    "axes swapped": "axes swapped",
}
"""Mistakes of `simulate`, and the names that `springbench grade` has for them."""


def simulate_otherwise(scene: dict, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Return the positions of a correct program that differs in ways that do not matter.

    Springs in another order and orientation; the inverse, LU, Cholesky or eigenvectors; float64 or float32, computed or
    stored; six decimals; 50 iterations or more.
    """
    V, E, k, b, m = (scene[key] for key in ("V", "E", "k", "b", "m"))
    n, dt, w = len(V), 1 / 30, 1e10
    E = E[rng.permutation(len(E))]
    E = np.where(rng.random(len(E))[:, None] < 0.5, E, E[:, ::-1])
    A, C = np.zeros((len(E), n)), np.zeros((len(b), n))
    A[np.arange(len(E)), E[:, 0]], A[np.arange(len(E)), E[:, 1]] = 1, -1
    C[np.arange(len(C)), rng.permutation(b)] = 1
    r, f = np.linalg.norm(A @ V, axis=1)[:, None], np.tile([0.0, -9.8, 0.0], (n, 1))
    Q = k * A.T @ A + np.diag(m) / dt**2 + w * C.T @ C
    kind = np.dtype(rng.choice(["f8", "f8", "f4"]))
    factor = np.linalg.cholesky(Q)
    values, vectors = np.linalg.eigh(Q)
    inverse = np.linalg.inv(Q).astype(kind)
    solve = rng.choice(4) if kind == np.dtype("f8") else 0
    solvers = (
        lambda side: inverse @ side,
        lambda side: np.linalg.solve(Q, side),
        lambda side: np.linalg.solve(factor.T, np.linalg.solve(factor, side)),
        lambda side: vectors @ ((vectors.T @ side) / values[:, None]),
    )
    iterations = int(rng.choice([50, 50, 50, 60, 100, 150]))
    A, r, f, M = A.astype(kind), r.astype(kind), f.astype(kind), np.diag(m).astype(kind)
    fixed = (w * C.T @ C @ V).astype(kind)
    prev, cur, out = V.astype(kind), V.astype(kind), []
    for _ in range(frames):
        y = M @ (2 * cur - prev) / kind.type(dt**2) + f + fixed
        p = cur
        for _ in range(iterations):
            v = A @ p
            d = r * v / np.sqrt((v * v).sum(axis=1))[:, None]
            p = solvers[solve](kind.type(k) * A.T @ d + y)
        prev, cur = cur, p
        out.append(p)
    positions = np.array(out)
    stored = rng.choice(["as it is", "float32", "six decimals"])
    if stored == "float32":
        positions = positions.astype(np.float32)
    if stored == "six decimals":
        positions = np.round(positions.astype(float), 6)
    return positions.astype(float)
