"""Transfer of motions between a mesh and a coarser one of the same body, exact for linear functions.

    f(x) = sum_j w_j f(x_j)   with   sum_j w_j = 1,   sum_j w_j x_j = x,   and sum_j w_j^2 |x_j - x|^4 minimal

over the vertices x_j nearest to x at rest (moving least squares: Lancaster and Salkauskas 1981). Rigid motions and
affine strains are therefore transferred exactly, for any meshes, and a vertex of both meshes retains its value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from harness.scenes.bind import Scene
from solvers.integrators import Motion
from solvers.problem import Positions, Prepared

_NEAREST = 12
"""Number of vertices that a value is interpolated from: the corners of a cell of a block and adjacent vertices."""


@dataclass(frozen=True, eq=False)
class Coarser:
    """A scene on a coarser mesh with a prepared solver.

    Attributes:
      scene: scene on the coarser mesh.
      prepared: its prepared solver.
      restrict: weights (coarse, fine).
      prolong: weights (fine, coarse).
    """

    scene: Scene
    prepared: Prepared
    restrict: csr_array
    prolong: csr_array

    @classmethod
    def of(cls, fine: Scene, coarse: Scene, prepared: Prepared) -> Coarser:
        """Build the transfer between two scenes that differ only in mesh size.

        Args:
          fine: scene on the finer mesh.
          coarse: scene on the coarser mesh.
          prepared: solver prepared for the coarser scene.
        """
        a, b = fine.mesh.rest, coarse.mesh.rest
        return cls(coarse, prepared, interpolation(a, b), interpolation(b, a))

    def down(self, motion: Motion) -> Motion:
        """Restrict a motion to the vertices of the coarser mesh."""
        return Motion(self.restrict @ motion.positions, self.restrict @ motion.velocity)

    def up(self, displacement: Positions) -> Positions:
        """Prolong a displacement [m] of the coarser mesh's vertices to the finer mesh, (n, 3)."""
        return self.prolong @ displacement


def interpolation(known: Positions, wanted: Positions) -> csr_array:
    """Build the interpolation weights (targets, sources) between rest positions, each (n, 3) [m]."""
    from scipy.spatial import cKDTree  # for those who need it

    tree: Any = cKDTree(known)
    found = tree.query(wanted, k=min(_NEAREST, len(known)))
    distance, near = (np.reshape(x, (len(wanted), -1)) for x in found)
    scale = np.maximum(distance.max(axis=1), np.finfo(np.float64).tiny)[:, None]
    inverse = 1.0 / np.maximum(distance / scale, 1e-4) ** 4
    away = (known[near] - wanted[:, None, :]) / scale[:, :, None]
    linear = np.concatenate([np.ones((*near.shape, 1)), away], axis=2)
    normal = np.einsum("nki,nk,nkj->nij", linear, inverse, linear)
    # Points on a line or in a plane leave directions undetermined, which need no weights.
    pseudo_inverse: Any = np.linalg.pinv  # of stacks of matrices, which its types do not tell
    first = np.asarray(pseudo_inverse(normal, rcond=1e-13, hermitian=True), np.float64)[:, :, 0]
    weights = inverse * np.einsum("nki,ni->nk", linear, first)
    start = np.arange(0, near.size + 1, near.shape[1])
    return csr_array((weights.ravel(), near.ravel(), start), shape=(len(wanted), len(known)))
