"""Orthotropic cloth: different stiffness along warp, weft and bias (45 degrees to both).

    k(theta) = (warp if cos 2 theta >= 0, else weft) cos^2 2 theta + bias sin^2 2 theta

theta is the angle from the warp direction to a spring, in the tangent plane of the mesh at rest. Springs along the warp
have its stiffness, those across it that of the weft, and those at 45 degrees that of the bias. The transition is
smooth, and no stiffness is below the smallest of the three. On a grid along both threads, these springs and the
diagonals of constant s = bias resist strain: C11 = warp + s, C22 = weft + s, C12 = C66 = s
(`springbench.harness.scenes.spring_stiffness`, with both diagonals). The interpolation rule is original to this
project.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, model_validator
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_topology import compute_area_normals
from springbench.harness.schema.base_model import ConfigModel, Vector3

_MIN_TANGENT_FRACTION = 1e-6
"""Smallest tangential part of the warp direction, relative to its length, that counts as nonzero."""


class OrthotropicStiffness(ConfigModel):
    """Stiffness of a woven cloth along and between its threads, in the unit of `stretch`."""

    warp: NonNegativeFloat
    """Stiffness along the warp."""
    weft: NonNegativeFloat
    """Stiffness along the weft, across the warp."""
    bias: NonNegativeFloat
    """Stiffness at 45 degrees to both."""
    direction: Vector3
    """Direction of the warp in the rest shape, of any length but zero; on curved meshes its tangential part."""

    @model_validator(mode="after")
    def _check_direction(self) -> OrthotropicStiffness:
        if not any(self.direction):
            raise ValueError("the direction of the warp should not be zero")
        return self

    def compute_stiffness(self, mesh: Mesh, springs: NDArray[np.int64]) -> NDArray[np.float64]:
        """Compute the stiffness constant of each spring.

        Args:
            mesh: surface at rest; its triangles give the tangent planes.
            springs: vertices of each spring (m, 2).

        Returns:
            Constants (m,), in the unit of `stretch`.

        Raises:
            InputError: the mesh is no surface of triangles, or the warp direction is normal to it at a spring.
        """
        if mesh.dimension != 2 or not len(mesh.triangles):
            raise InputError(InputMistake("warp and weft need a mesh of triangles; give one number", key="stretch"))
        _, normals = compute_area_normals(mesh.rest_positions, mesh.triangles)
        i, j = springs.T
        normal = normals[i] + normals[j]
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        warp = np.array(self.direction) / np.linalg.norm(self.direction)
        along, edge = (
            _project_to_tangent(x, normal)
            for x in (np.tile(warp, (len(i), 1)), mesh.rest_positions[j] - mesh.rest_positions[i])
        )
        size = np.linalg.norm(along, axis=1)
        if len(bad := np.flatnonzero(size < _MIN_TANGENT_FRACTION)):
            where = f"the warp stands upright on the mesh at the spring {i[bad[0]]}-{j[bad[0]]}"
            raise InputError(InputMistake(f"{where}; give a direction along the cloth", key="stretch"))
        product = size * np.linalg.norm(edge, axis=1)
        cosine = np.einsum("ij,ij->i", along, edge) / np.where(product > 0.0, product, 1.0)
        twice = 2.0 * np.minimum(cosine**2, 1.0) - 1.0
        return np.where(twice >= 0.0, self.warp, self.weft) * twice**2 + self.bias * (1.0 - twice**2)


def _project_to_tangent(x: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    return x - np.einsum("ij,ij->i", x, normal)[:, None] * normal
