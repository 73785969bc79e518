"""Sheets that touch, for the tests of self-contact."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.solvers.contact import ccd
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.collisions import pad_positions
from springbench.solvers.contact.contact_potential import SelfContact
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.quasi_newton.anderson import Anderson
from springbench.solvers.methods.quasi_newton.chebyshev import Chebyshev
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.step_problem import Positions, Solver
from springbench.solvers.registry import SOLVERS, load_target

CONTACT_THICKNESS, CONTACT_DHAT = 0.02, 0.03

SURFACE_CONTACT_SOLVERS: dict[str, Solver] = {
    **{
        name: load_target(SOLVERS[name])()
        for name in ("newton", "newton-cg", "pncg", "lbfgs", "hybrid", "vbd", "vbd-ogc", "sparse")
    },
    **{name: load_target(SOLVERS[name])() for name in ("numba", "anderson", "chebyshev")},
    "lbfgs float32": Lbfgs(precision="float32"),
    "numba float32": CompiledLocalGlobal(precision="float32"),
    "anderson float32": Anderson(precision="float32"),
    "chebyshev float32": Chebyshev(precision="float32"),
}
"""The solvers that claim contact of surfaces, with the precisions of factors that they know."""


def unique_edges(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.unique(np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1), axis=0)


def build_touching_sheets(
    seed: int = 0, *, size: int = 5, noise: float = 0.004
) -> tuple[SelfContact, Positions, NDArray[np.int64]]:
    """The contact of two sheets, positions where they touch, nearly parallel edges among them, and the triangles."""
    mesh, rng = StackMesh(layer_spacing=0.2).build_mesh(size), np.random.default_rng(seed)
    n = len(mesh.rest_positions) // 2
    surface = CollisionMesh.from_rest_shape(
        mesh.rest_positions,
        unique_edges(mesh.triangles),
        mesh.triangles,
        rng.uniform(0.5, 2.0, 2 * n),
        CONTACT_THICKNESS,
        CONTACT_DHAT,
    )
    p = mesh.rest_positions.copy()
    p[n:, 1] = CONTACT_THICKNESS + 0.5 * CONTACT_DHAT
    p += noise * rng.normal(size=p.shape)
    return SelfContact(surface), p, mesh.triangles


def random_displacement(seed: int, p: Positions, size: float) -> Positions:
    return size * np.random.default_rng(seed).normal(size=p.shape)


def exhaustive_step_size(contact: SelfContact, p: Positions, d: Positions) -> float:
    """The largest step that all pairs allow, those that nothing brings near each other too."""
    every = contact.collision_mesh.find_proximity_candidates(p, 1e3)
    return ccd.collision_free_step_size(
        every, pad_positions(p), pad_positions(d - d.mean(axis=0)), 1.0, *ccd.allocate_ccd_scratch()
    )
