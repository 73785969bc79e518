"""Sheets that touch, for the tests of self-contact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from harness.scenes.mesh.stack import Stack
from solvers.contact import ways
from solvers.contact.contacts import padded
from solvers.contact.self_contact import SelfContact
from solvers.contact.surface import Surface
from solvers.methods.anderson import Anderson
from solvers.methods.chebyshev import Chebyshev
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.local_global_compiled import CompiledLocalGlobal
from solvers.problem import Positions, Solver
from solvers.registry import SOLVERS, load

THICKNESS, RANGE = 0.02, 0.03

TAKE_SURFACES: dict[str, Solver] = {
    **{name: load(SOLVERS[name])() for name in ("newton", "newton-cg", "pncg", "lbfgs", "hybrid", "vbd", "sparse")},
    **{name: load(SOLVERS[name])() for name in ("numba", "anderson", "chebyshev")},
    "lbfgs float32": Lbfgs(precision="float32"),
    "numba float32": CompiledLocalGlobal(precision="float32"),
    "anderson float32": Anderson(precision="float32"),
    "chebyshev float32": Chebyshev(precision="float32"),
}
"""The solvers that claim contact of surfaces, with the precisions of factors that they know."""


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


def largest_of_all(contact: SelfContact, p: Positions, d: Positions) -> float:
    """The largest step that all pairs allow, those that nothing brings near each other too."""
    every = contact.surface.within(p, 1e3)
    return ways.largest(every, padded(p), padded(d - d.mean(axis=0)), 1.0, *ways.scratch())
