"""Bending: the quadratic energy of surfaces that hardly stretch (Bergou et al. 2006), flat at rest."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat

from harness.base.errors import InputError
from harness.base.model import Model
from harness.scenes.effects.base import Contribution
from harness.scenes.mesh.base import Mesh
from solvers.energies import bending


class Bending(Model):
    """Resists bending of the mesh's triangles. Their rest state is flat whatever the mesh's shape is: a tube opens."""

    kind: Literal["bending"] = "bending"
    stiffness: NonNegativeFloat
    """The flexural rigidity B [N m]: the moment for a curvature of 1/m, for each metre of width, at every mesh size."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The energy, none for a stiffness of zero; raises InputError for a mesh that is no surface."""
        if not self.stiffness:
            return Contribution()
        triangles = mesh.triangles
        if not len(triangles):
            raise InputError("bending: needs triangles, and this mesh has none; take them out, or another mesh")
        a, b, c = (mesh.rest[corner] for corner in triangles.T)
        sides = np.linalg.norm([b - a, c - b, a - c], axis=2).max(axis=0)
        flat = np.flatnonzero(np.linalg.norm(np.cross(b - a, c - a), axis=1) <= 1e-9 * sides**2)
        if len(flat):
            raise InputError(f"bending: the triangle {triangles[flat[0]].tolist()} has no area; repair the mesh")
        edges = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
        shared, count = np.unique(edges, axis=0, return_counts=True)
        if (count > 2).any():
            raise InputError(
                f"bending: more than two triangles meet at the edge {shared[count > 2][0].tolist()}; repair the mesh"
            )
        return Contribution(energies=(bending.Bending.of(mesh.rest, triangles, self.stiffness),))
