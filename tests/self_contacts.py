"""Sheets that touch, for the tests of self-contact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from harness.scenes.mesh.stack import Stack
from solvers.contact.self_contact import SelfContact
from solvers.contact.surface import Surface
from solvers.problem import Positions

THICKNESS, RANGE = 0.02, 0.03


def sides(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.unique(np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1), axis=0)


def touching(seed: int = 0, *, size: int = 5, noise: float = 0.004) -> tuple[SelfContact, Positions, NDArray[np.int64]]:
    """The contact of two sheets, positions where they touch, nearly parallel edges among them, and the triangles."""
    mesh, rng = Stack(apart=0.2).build(size), np.random.default_rng(seed)
    n = len(mesh.rest) // 2
    surface = Surface.of(
        mesh.rest, sides(mesh.triangles), mesh.triangles, rng.uniform(0.5, 2.0, 2 * n), THICKNESS, RANGE
    )
    p = mesh.rest.copy()
    p[n:, 1] = THICKNESS + 0.5 * RANGE
    p += noise * rng.normal(size=p.shape)
    return SelfContact(surface), p, mesh.triangles


def way(seed: int, p: Positions, size: float) -> Positions:
    return size * np.random.default_rng(seed).normal(size=p.shape)
