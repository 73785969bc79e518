# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# SciPy's and NumPy's stubs leave the types of some results unknown.
"""Membrane stiffness of spring networks: spring stiffness by areas, and the modulus of a network.

Stiffness by areas (Van Gelder 1998, "Approximate simulation of elastic membranes by triangulated spring meshes"):

    k_e = c E A_e / L_e^2,    A_e the areas of the triangles at the edge e, L_e its length, E the stiffness [N/m]

A side of a face of n > 3 corners gets 2/n of the face's area, and the two diagonals of a quadrangle twice the area. In
solids A_e is the volume of the tetrahedra at the edge, and E a modulus [Pa]. Under a stretch e in all directions, a
triangle then stores 3/2 E e^2 for each unit of area, as an isotropic sheet with Poisson's ratio 1/3 does, if its
vertices follow the stretch. Vertices of irregular meshes do not: their forces do not balance, and the network relaxes.
The factor c compensates for that. For each connected part it is

    c = (sum k_e L_e^2) / (min over u of sum k_e (L_e + (B u)_e)^2),

with (B u)_e the elongation of edges by displacements u of the inner vertices in the surface; the vertices of the
boundary follow the stretch. So a uniform stretch of any triangulation needs the force of the stated material.

Limits: springs have one constant per edge, and central forces give the tensor C_ijkl all symmetries (Cauchy's
relation), so that Poisson's ratio is 1/3 in an isotropic network of triangles, and the shear modulus 3/8 E. In a
regular mesh that is not equilateral, stiffness depends on the direction, whatever the constants (Lloyd, Szekely and
Harders 2007); `compute_membrane_modulus` gives by how much. Sides of quadrangles without diagonals resist no shear.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_checks import build_edge_table, find_connected_parts
from springbench.harness.scenes.mesh.mesh_topology import compute_area_normals

FloatArray = NDArray[np.float64]

_REGULARISATION = 1e-9
"""Fraction of the diagonal that is added to it, because some motions have no stiffness; no elongation excites these."""
_PLANE_RATIO = 1e-3
"""Thickness relative to the extent below which a surface is planar."""
_NUM_DIRECTIONS = 180
_SOFT_RATIO = 1e-3
"""Ratio of the smallest to the largest modulus below which the smallest counts as zero."""


class MembraneModulus(NamedTuple):
    """In-plane stiffness of a network by direction.

    Attributes:
        low: smallest modulus, force per width and strain with free sides [N/m].
        high: largest modulus [N/m].
        mean: mean over all directions [N/m].
        poisson: smallest and largest Poisson's ratio.
    """

    low: float
    high: float
    mean: float
    poisson: tuple[float, float]

    @property
    def modulus_anisotropy(self) -> float:
        """Half the difference of the largest and the smallest modulus, relative to their mean."""
        return (self.high - self.low) / (self.high + self.low)

    def describe_modulus(self) -> str:
        """Describe modulus and anisotropy in words."""
        if self.low < _SOFT_RATIO * self.high:
            return f"membrane stiffness up to {self.high:.3g} N/m along the edges; nothing resists shear between them"
        low, high = self.poisson
        return (
            f"membrane stiffness {self.low:.3g} to {self.high:.3g} N/m by direction, mean {self.mean:.3g} N/m "
            f"(isotropic within {self.modulus_anisotropy:.0%}); Poisson's ratio {low:z.2f} to {high:z.2f}"
        )


@lru_cache(maxsize=2)  # a scene calls it once for each family of springs
def compute_area_stiffness(mesh: Mesh) -> FloatArray:
    """Compute the stiffness of each spring by its areas, for a material constant of 1, (m,).

    Raises:
        InputError: for a mesh without faces from a file, and for a spring without length or without an adjacent face.
    """
    if mesh.spring_areas is None:
        problem = "area needs the faces of a mesh from a file; use continuum, which suits generated meshes"
        raise InputError(InputMistake(problem, key="scaling_rule"))
    lengths = mesh.spring_distances
    for wrong, what in ((lengths == 0.0, "no length"), (mesh.spring_areas == 0.0, "no adjacent face")):
        if wrong.any():
            i, j = mesh.springs[int(wrong.argmax())].tolist()
            numbers = mesh.format_file_numbers(i, j)
            problem = f"area divides by lengths and takes areas of faces; the spring {i}-{j}{numbers} has {what}"
            raise InputError(InputMistake(problem, key="scaling_rule"))
    k = mesh.spring_areas / lengths**2
    relaxed = _SurfaceNetwork(mesh, mesh.springs, k).relax_elongations(lengths[:, None])[:, 0]
    part = find_connected_parts(len(mesh.rest_positions), mesh.springs)[mesh.springs[:, 0]]
    affine, least = (np.bincount(part, k * lengths * elongation) for elongation in (lengths, relaxed))
    found = k * np.divide(affine, least, out=np.ones_like(affine), where=least > 0.0)[part]
    found.flags.writeable = False
    return found


def compute_membrane_modulus(mesh: Mesh, springs: NDArray[np.int64], stiffness: FloatArray) -> MembraneModulus:
    """Compute the modulus of a surface by direction, with its inner vertices in equilibrium.

    A curved surface has no uniform strain except a stretch in all directions. Its tensor is that of vertices that
    follow the strain, times the fraction that relaxation leaves of the energy of a uniform stretch. Directions are
    angles to the vertical, or to x where most of the surface is horizontal.

    Args:
        mesh: a mesh with triangles.
        springs: (m, 2).
        stiffness: (m,) [N/m].
    """
    network = _SurfaceNetwork(mesh, springs, stiffness)
    x, y = network.directions.T
    elongations = network.lengths[:, None] * np.column_stack([x * x, y * y, x * y, np.ones_like(x)])
    relaxed = network.relax_elongations(elongations)
    if not network.is_planar:
        affine, least = (stiffness * network.lengths @ some[:, 3] for some in (elongations, relaxed))
        relaxed = elongations * (least / affine)
    elongations, relaxed = elongations[:, :3], relaxed[:, :3]
    tensor = elongations.T @ (stiffness[:, None] * relaxed) / mesh.surface_area
    tensor = (tensor + tensor.T) / 2
    compliance = np.linalg.inv(tensor + _REGULARISATION * np.trace(tensor) * np.eye(3))
    angle = np.linspace(0.0, np.pi, _NUM_DIRECTIONS, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    along, across = np.stack([c * c, s * s, c * s]), np.stack([s * s, c * c, -c * s])
    modulus = 1.0 / np.einsum("it,ij,jt->t", along, compliance, along)
    poisson = -np.einsum("it,ij,jt->t", across, compliance, along) * modulus
    return MembraneModulus(
        float(modulus.min()), float(modulus.max()), float(modulus.mean()), (float(poisson.min()), float(poisson.max()))
    )


class _SurfaceNetwork:
    """Springs of a mesh, linearised about the rest shape.

    Displacements are in the surface, or in space for solids.
    """

    def __init__(self, mesh: Mesh, springs: NDArray[np.int64], stiffness: FloatArray) -> None:
        from scipy.sparse import csr_array  # imported only for materials by areas

        i, j = springs.T
        delta = mesh.rest_positions[j] - mesh.rest_positions[i]
        self.lengths = np.linalg.norm(delta, axis=1)
        unit = delta / np.where(self.lengths > 0.0, self.lengths, 1.0)[:, None]
        self.is_planar = mesh.dimension == 2 and _is_planar(mesh)
        frames = (
            _compute_tangent_frames(mesh)
            if mesh.dimension == 2
            else np.broadcast_to(np.eye(3), (len(mesh.rest_positions), 3, 3))
        )
        one, two = (np.einsum("max,mx->ma", frames[ends], unit) for ends in (i, j))
        mean = (one + two)[:, :2]
        size = np.linalg.norm(mean, axis=1)
        self.directions = mean / np.where(size > 0.0, size, 1.0)[:, None]
        m, d = one.shape
        rows = np.repeat(np.arange(m), d)
        columns = [(d * ends[:, None] + np.arange(d)).ravel() for ends in (i, j)]
        shape = m, d * len(mesh.rest_positions)
        values = np.concatenate([-one.ravel(), two.ravel()])
        self._elongation: Any = csr_array((values, (np.tile(rows, 2), np.concatenate(columns))), shape=shape)
        self._stiffness, self._free = stiffness, np.flatnonzero(np.repeat(_find_inner_vertices(mesh), d))

    def relax_elongations(self, elongations: FloatArray) -> FloatArray:
        """Return elongations (m, q) after the inner vertices have moved into equilibrium, (m, q)."""
        from scipy.sparse import diags_array
        from scipy.sparse.linalg import splu

        if not len(self._free):
            return elongations
        moved: Any = self._elongation[:, self._free]
        weighted = moved.T @ diags_array(self._stiffness)
        matrix = (weighted @ moved).tocsc()
        diagonal = np.asarray(matrix.diagonal())
        diagonal = np.where(diagonal > 0.0, _REGULARISATION * diagonal, 1.0)
        # The matrix is positive definite. Pivots off its diagonal would undo the ordering, at a hundred times the cost.
        solver: Any = splu(
            matrix + diags_array(diagonal, format="csc"),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        return elongations - moved @ solver.solve(np.ascontiguousarray(weighted @ elongations))


def _find_inner_vertices(mesh: Mesh) -> NDArray[np.bool_]:
    """Return a mask (n,) of the vertices in the interior of a surface or solid."""
    surface = np.zeros(len(mesh.rest_positions), np.bool_)
    surface[mesh.triangles.ravel()] = True
    if mesh.dimension == 3:
        return ~surface
    table = build_edge_table(mesh.triangles)
    surface[table.edges[table.num_triangles == 1].ravel()] = False
    return surface


def _is_planar(mesh: Mesh) -> bool:
    """Return whether the mesh is planar within a thousandth of its extent."""
    centred = mesh.rest_positions - mesh.rest_positions.mean(axis=0)
    sizes = np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred), 0.0))
    return bool(sizes[0] <= _PLANE_RATIO * sizes[2])


def _compute_tangent_frames(mesh: Mesh) -> FloatArray:
    """Return two orthonormal tangents of each vertex, (n, 2, 3).

    The first one is along the vertical, or along x where most of the surface is horizontal.
    """
    area, normals = compute_area_normals(mesh.rest_positions, mesh.triangles)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    is_level = np.abs(area[:, 1]).sum() > 0.7 * np.linalg.norm(area, axis=1).sum()
    axes = np.eye(3)[[0, 2, 1]] if is_level else np.eye(3)[[1, 0, 2]]
    first = axes[0] - normals * (normals @ axes[0])[:, None]
    steep = np.linalg.norm(first, axis=1) < 1e-3
    first[steep] = axes[1] - normals[steep] * (normals[steep] @ axes[1])[:, None]
    first /= np.maximum(np.linalg.norm(first, axis=1), 1e-300)[:, None]
    return np.stack([first, np.cross(normals, first)], axis=1)
