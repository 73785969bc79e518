"""Transfer of motions between two meshes of one body, exact for linear functions.

    f(x) = sum_j w_j f(x_j)   with   sum_j w_j = 1,   sum_j w_j x_j = x,   and sum_j w_j^2 |x_j - x|^4 minimal

over the vertices x_j nearest to x at rest (moving least squares: Lancaster and Salkauskas 1981). Rigid motions and
affine strains are therefore transferred exactly, for any meshes, and a vertex of both meshes retains its value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, PreparedSolver

_NUM_NEIGHBOURS = 12
"""Number of vertices that a value is interpolated from: the corners of a cell of a block and adjacent vertices."""


@dataclass(frozen=True, eq=False)
class CoarseLevel:
    """A scene on a coarser mesh with a prepared solver.

    Attributes:
        scene: scene on the coarser mesh.
        prepared: its prepared solver.
        restriction: weights (coarse, fine).
        prolongation: weights (fine, coarse).
    """

    scene: Scene
    prepared: PreparedSolver
    restriction: csr_array
    prolongation: csr_array

    @classmethod
    def from_scenes(cls, fine: Scene, coarse: Scene, prepared: PreparedSolver) -> CoarseLevel:
        """Build the transfer between two scenes that differ only in mesh size.

        Args:
            fine: scene on the finer mesh.
            coarse: scene on the coarser mesh.
            prepared: solver prepared for the coarser scene.
        """
        a, b = fine.mesh.rest_positions, coarse.mesh.rest_positions
        return cls(coarse, prepared, build_interpolation(a, b), build_interpolation(b, a))

    def restrict_motion(self, motion: Motion) -> Motion:
        """Restrict a motion to the vertices of the coarser mesh."""
        return Motion(self.restriction @ motion.positions, self.restriction @ motion.velocity)

    def prolong_displacement(self, displacement: Positions) -> Positions:
        """Prolong a displacement [m] of the coarser mesh's vertices to the finer mesh, (n, 3)."""
        return self.prolongation @ displacement


def build_interpolation(sources: Positions, targets: Positions) -> csr_array:
    """Build the interpolation weights between the vertices of two meshes.

    Args:
        sources: rest positions of the vertices with given values, (s, 3) [m].
        targets: rest positions of the vertices that get values, (t, 3) [m].

    Returns:
        Weights (t, s).
    """
    from scipy.spatial import cKDTree

    tree: Any = cKDTree(sources)
    found = tree.query(targets, k=min(_NUM_NEIGHBOURS, len(sources)))
    distance, near = (np.reshape(x, (len(targets), -1)) for x in found)
    scale = np.maximum(distance.max(axis=1), np.finfo(np.float64).tiny)[:, None]
    inverse = 1.0 / np.maximum(distance / scale, 1e-4) ** 4
    away = (sources[near] - targets[:, None, :]) / scale[:, :, None]
    linear = np.concatenate([np.ones((*near.shape, 1)), away], axis=2)
    normal = np.einsum("nki,nk,nkj->nij", linear, inverse, linear)
    # Points on a line or in a plane leave directions undetermined; the pseudo-inverse gives these no weight.
    pseudo_inverse: Any = np.linalg.pinv  # untyped, because its stubs do not accept stacks of matrices
    first = np.asarray(pseudo_inverse(normal, rcond=1e-13, hermitian=True), np.float64)[:, :, 0]
    weights = inverse * np.einsum("nki,ni->nk", linear, first)
    start = np.arange(0, near.size + 1, near.shape[1])
    return csr_array((weights.ravel(), near.ravel(), start), shape=(len(targets), len(sources)))
