"""Bending: the quadratic energy of nearly inextensible surfaces (Bergou et al. 2006), flat at rest."""

from __future__ import annotations

import logging
from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveFloat, model_validator
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.effects.effect_interface import NEGLIGIBLE_FRACTION, EffectContribution, ObservedMotion
from springbench.harness.scenes.fabric_table import BENDING_LENGTH_RANGE, BENDING_RANGE, PlausibleRange
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_topology import lump_areas
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies import bending_energy

SHARP_ANGLE = np.deg2rad(60.0)
"""Dihedral angle above which a mesh shows its edges."""


STANDARD_GRAVITY = 9.81
"""Acceleration [m/s^2] by which a bending length becomes a flexural rigidity."""
_LOG = logging.getLogger("springbench")


class ThreadValues(ConfigModel):
    """Values along both threads of a woven cloth; their geometric mean acts in all directions."""

    warp: PositiveFloat
    """Value along the warp."""
    weft: PositiveFloat
    """Value along the weft."""


class BendingEffect(ConfigModel):
    """Bending stiffness of the triangles.

    The rest state is flat, whatever the shape of the mesh: a tube opens.
    """

    max_convergence_order: ClassVar[float] = inf

    kind: Literal["bending"] = "bending"
    stiffness: NonNegativeFloat | ThreadValues | None = None
    """Flexural rigidity B [N m]: the moment per metre of width for a curvature of 1/m, at every mesh size. Of warp and
    weft the geometric mean is used (overall flexural rigidity, ASTM D1388)."""
    bending_length: PositiveFloat | ThreadValues | None = None
    """Bending length c [m], half the overhang of the cantilever test, instead of `stiffness`: B = w c^3 with the weight
    per area w [N/m^2] (ASTM D1388)."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the energy, empty for zero stiffness.

        Args:
            mesh: mesh with triangles, at most two at each edge.
            mass: vertex masses (n,) [kg], used to convert a bending length to a rigidity.
            time_step: dt [s], which does not matter here.

        Raises:
            InputError: the mesh is no surface, a triangle has no area, or a bending length is given without a mass.
        """
        if self.stiffness == 0.0:
            return EffectContribution()
        triangles = mesh.triangles
        if not len(triangles):
            raise InputError(
                "bending: needs triangles, and this mesh has none; remove `bending`, or use a mesh with triangles"
            )
        a, b, c = (mesh.rest_positions[corner] for corner in triangles.T)
        sides = np.linalg.norm([b - a, c - b, a - c], axis=2).max(axis=0)
        flat = np.flatnonzero(np.linalg.norm(np.cross(b - a, c - a), axis=1) <= 1e-9 * sides**2)
        if len(flat):
            corners = triangles[flat[0]].tolist()
            raise InputError(
                f"bending: the triangle {corners} has no area{mesh.format_file_numbers(*corners)}; repair the mesh"
            )
        edges = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
        shared, count = np.unique(edges, axis=0, return_counts=True)
        if (count > 2).any():
            ends = shared[count > 2][0].tolist()
            raise InputError(
                "bending: more than two triangles meet at the edge "
                f"{ends}{mesh.format_file_numbers(*ends)}; repair the mesh"
            )
        B = self.find_rigidity(mesh, mass)
        if self.bending_length is not None:
            _LOG.info("bending: the bending length makes a flexural rigidity of %.4g N m", B)
        return EffectContribution(energies=(bending_energy.Bending.from_rest_shape(mesh.rest_positions, triangles, B),))

    @model_validator(mode="after")
    def _check_rigidity(self) -> BendingEffect:
        if self.stiffness is not None and self.bending_length is not None:
            raise ValueError("has `stiffness` and `bending_length`; leave out one of them")
        if self.stiffness is None and self.bending_length is None:
            raise ValueError("needs a `stiffness` [N m] or a `bending_length` [m]")
        return self

    def find_rigidity(self, mesh: Mesh, mass: NDArray[np.float64]) -> float:
        """Return the flexural rigidity [N m] of the mesh.

        Args:
            mesh: mesh, whose area at rest counts for a bending length.
            mass: vertex masses (n,) [kg], which count for a bending length.

        Raises:
            InputError: a bending length is given, but no mass.
        """
        if self.stiffness is not None:
            return _average_threads(self.stiffness)
        areas = lump_areas(mesh.rest_positions, mesh.triangles) if mesh.vertex_areas is None else mesh.vertex_areas
        weight = STANDARD_GRAVITY * float(mass.sum() / areas.sum())
        if weight == 0.0:
            raise InputError(InputMistake("`bending_length` needs a cloth with a mass", key="bending_length"))
        return weight * _average_threads(self.bending_length) ** 3

    def list_material_values(self, mesh: Mesh, mass: NDArray[np.float64]) -> list[tuple[PlausibleRange, float]]:
        """Return the flexural rigidity [N m], with the range of fabrics.

        Args:
            mesh: mesh, whose area at rest counts for a bending length.
            mass: vertex masses (n,) [kg], which count for a bending length.

        Raises:
            InputError: a bending length is given, but no mass.
        """
        plausible = BENDING_RANGE if self.bending_length is None else BENDING_LENGTH_RANGE
        return [(plausible, self.find_rigidity(mesh, mass))]

    @classmethod
    def find_evidence(cls, observed: ObservedMotion) -> str:
        """Return evidence for bending stiffness: folds as sharp as the mesh."""
        mesh = observed.mesh
        hinges = _find_hinges(mesh.triangles)
        if mesh.dimension != 2 or not len(hinges):
            return ""
        flat = _dihedral_angles(mesh.rest_positions, hinges)
        turned = np.array(
            [np.abs(_dihedral_angles(p, hinges) - flat) for p in observed.positions[-len(observed.positions) // 4 :]]
        )
        turned = np.minimum(turned, 2.0 * np.pi - turned)
        share = float((turned > SHARP_ANGLE).mean())
        if share <= NEGLIGIBLE_FRACTION:
            return ""
        return (
            f"over the last quarter of the motion {100 * share:.1f} % of the edges between triangles are bent by more "
            f"than {np.rad2deg(SHARP_ANGLE):.0f} degrees, the sharpest by "
            f"{np.rad2deg(turned.max()):.0f}: folds as sharp as "
            "the mesh"
        )


def _average_threads(value: float | ThreadValues | None) -> float:
    return float((value.warp * value.weft) ** 0.5 if isinstance(value, ThreadValues) else value or 0.0)


def _find_hinges(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find the edges shared by two triangles, with the two opposite corners: (k, 4)."""
    if not len(triangles):
        return np.empty((0, 4), np.int64)
    rolled = np.concatenate([np.roll(triangles, -k, axis=1) for k in range(3)])  # an edge, then the corner across
    ends = np.sort(rolled[:, :2], axis=1)
    code = ends[:, 0] * (int(triangles.max()) + 1) + ends[:, 1]  # one number for an edge, for both orders of its ends
    order = np.argsort(code, kind="stable")
    twice = np.flatnonzero(code[order][1:] == code[order][:-1])
    first, second = rolled[order[twice]], rolled[order[twice + 1]]
    return np.column_stack([first, second[:, 2]])


def _dihedral_angles(p: NDArray[np.float64], hinges: NDArray[np.int64]) -> NDArray[np.float64]:
    """Compute the signed angle between the second triangle and the plane of the first [rad], (k,)."""
    a, b, c, d = (p[corner] for corner in hinges.T)
    edge = b - a
    left, right = np.cross(edge, c - a), np.cross(d - a, edge)
    length = np.linalg.norm(edge, axis=1)
    along = np.einsum("ij,ij->i", np.cross(left, right), edge / np.where(length > 0.0, length, 1.0)[:, None])
    return np.arctan2(along, np.einsum("ij,ij->i", left, right))
