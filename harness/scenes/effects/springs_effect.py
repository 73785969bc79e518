"""Springs: one linear spring per spring of the mesh.

The stiffness follows from a rule of `springbench.harness.scenes.spring_stiffness`. Springs of infinite stiffness have
no energy: they are length constraints.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt, model_validator
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.effects.effect_interface import (
    EffectContribution,
    build_length_constraints,
    build_rest_springs,
)
from springbench.harness.scenes.fabric_table import MEMBRANE_RANGE, PRODUCT_RANGE, PlausibleRange
from springbench.harness.scenes.mesh.mesh import STRETCH, Mesh
from springbench.harness.scenes.orthotropic_cloth import OrthotropicStiffness
from springbench.harness.scenes.spring_stiffness import compute_spring_stiffness
from springbench.harness.schema.base_model import ConfigModel

_LOG = logging.getLogger("springbench")

StretchConstant = float | Literal["exact"] | OrthotropicStiffness
"""Constant of the springs along the lines."""


class SpringsEffect(ConfigModel):
    """Springs k/2 (length - rest length)^2 along the mesh's edges.

    Springs of zero stiffness are omitted; springs of infinite stiffness are length constraints. Springs whose mesh
    states a stiffness have that one, and those that only pull exert no force while they are slack.
    """

    max_convergence_order: ClassVar[float] = inf
    is_baseline_effect: ClassVar[bool] = True

    kind: Literal["springs"] = "springs"
    scaling_rule: Literal["continuum", "area", "fixed", "liu2013"] = "continuum"
    """Scaling rule of the values below with the mesh size. `continuum`: the material is independent of the mesh size;
    `area`: and of the triangulation of a mesh from a file, by the area around each spring; `fixed`: each spring has
    the given stiffness [N/m]; `liu2013`: stiffness proportional to the resolution, given at the size
    `reference_size`."""
    stretch: NonNegativeFloat | Literal["exact"] | OrthotropicStiffness | None = None
    """Along the mesh's lines. Continuum: EA [N] for chains and trusses, [N/m] for cloth, [Pa] for solids; or one value
    each for warp, weft and bias of a woven cloth; or `exact`: length constraints, supported by `avbd` only. Left out if
    the mesh states the stiffness of each spring itself."""
    youngs_modulus: PositiveFloat | None = None
    """Young's modulus E [Pa] instead of `stretch`: that of a cloth is E times `thickness`, that of a solid E."""
    thickness: PositiveFloat | None = None
    """Thickness t [m] of a cloth of Young's modulus E; its membrane stiffness is E t."""
    shear: NonNegativeFloat | Literal["exact"] | None = None
    """Across the mesh's cells, in the same unit; equal to `stretch` by default."""
    bend: NonNegativeFloat = 0.0
    """Springs that skip one vertex. Continuum: bending stiffness [N m]; otherwise [N/m]."""
    reference_size: PositiveInt | None = None
    """liu2013: the mesh size for which the stiffnesses above are given."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the springs as energies, and the length constraints.

        Springs that only pull have an energy of their own. Energies without springs are omitted.

        Args:
            mesh: mesh, whose springs have the rest lengths and stiffnesses that it states.
            mass, time_step: vertex masses (n,) [kg] and dt [s], which do not matter here.

        Raises:
            InputError: the material does not fit the mesh, or a spring of infinite stiffness has no length.
        """
        given = _require_stretch(self.find_stretch(mesh), mesh)
        if self.youngs_modulus is not None and mesh.dimension == 2:
            E, t = self.youngs_modulus, self.thickness
            _LOG.info(
                "springs: a Young's modulus of %g Pa and a thickness of %g m make a stretch of %g N/m", E, t, given
            )
        stretch, shear = (inf if x == "exact" else x for x in (given, given if self.shear is None else self.shear))
        k = compute_spring_stiffness(
            mesh,
            scaling_rule=self.scaling_rule,
            stretch=stretch,
            shear=shear,
            bend=self.bend,
            reference_size=self.reference_size,
        )
        own = mesh.spring_properties
        if own is not None:
            k = np.where(np.isnan(own.stiffness), k, own.stiffness)
        found = build_length_constraints(mesh, np.flatnonzero(k == inf), 1.0, 1.0)
        stiff = np.flatnonzero((k > 0.0) & (k < inf))
        if own is None:
            parts = (build_rest_springs(mesh, stiff, k[stiff]),)
        else:
            # A spring without any rest length is never slack.
            pulls = own.only_pulls[stiff] & (own.rest_length[stiff] > 0.0)
            springs, cables = (build_rest_springs(mesh, some, k[some]) for some in (stiff[~pulls], stiff[pulls]))
            # Imported here because its kernels need Numba, which listing runs must not import.
            from springbench.solvers.model.energies.tension_only_energy import TensionOnlySprings

            parts = springs, TensionOnlySprings.from_springs(cables)
        return replace(found, energies=tuple(one for one in parts if len(one.edges)))

    def find_stretch(self, mesh: Mesh) -> StretchConstant | None:
        """Return `stretch`, or the product of Young's modulus and thickness.

        Raises:
            InputError: if these do not fit the mesh.
        """
        if self.youngs_modulus is None:
            return self.stretch
        E, t = self.youngs_modulus, self.thickness
        if mesh.dimension == 1:
            problem = "`youngs_modulus` needs a cloth or a solid; give `stretch`, the axial stiffness EA [N]"
            raise InputError(InputMistake(problem, key="youngs_modulus"))
        if mesh.dimension == 3:
            if t is not None:
                raise InputError(InputMistake("`thickness` has no meaning for a solid; leave it out", key="thickness"))
            return E
        if t is None:
            raise InputError(InputMistake("`thickness` [m] is missing, which `youngs_modulus` needs", key="thickness"))
        return E * t

    def list_material_values(self, mesh: Mesh, mass: NDArray[np.float64]) -> list[tuple[PlausibleRange, float]]:
        """Return the membrane stiffnesses [N/m] of a cloth, with the range of fabrics.

        Args:
            mesh: mesh, for a stiffness that follows from Young's modulus.
            mass: vertex masses (n,) [kg], which do not matter here.

        Returns:
            The stiffnesses that the effect states; empty for scaling rules other than continuum and area.

        Raises:
            InputError: Young's modulus or the thickness does not fit the mesh.
        """
        if self.scaling_rule not in ("continuum", "area"):
            return []
        stretch = self.find_stretch(mesh)
        values = [stretch.warp, stretch.weft] if isinstance(stretch, OrthotropicStiffness) else [stretch]
        plausible = MEMBRANE_RANGE if self.youngs_modulus is None else PRODUCT_RANGE
        return [(plausible, value) for value in values if isinstance(value, float)]

    @model_validator(mode="after")
    def _check_material(self) -> SpringsEffect:
        if self.youngs_modulus is None and self.thickness is not None:
            raise ValueError("has a `thickness`, which needs a `youngs_modulus`")
        if self.youngs_modulus is not None and self.stretch is not None:
            raise ValueError("has `stretch` and `youngs_modulus`; leave out one of them")
        if self.youngs_modulus is not None and self.scaling_rule not in ("continuum", "area"):
            raise ValueError("has a `youngs_modulus`, which needs the scaling rule `continuum` or `area`")
        return self


def _require_stretch(stretch: StretchConstant | None, mesh: Mesh) -> StretchConstant:
    """Return the constant of the springs along the lines.

    Raises:
        InputError: if it is missing or has no effect.
    """
    along, own = mesh.spring_families[STRETCH], mesh.spring_properties
    stated = np.zeros(len(along), np.bool_) if own is None else ~np.isnan(own.stiffness[along])
    if stretch is not None:
        if len(along) and stated.all():
            problem = "`stretch` has no effect, because the mesh states the stiffness of each spring; leave it out"
            raise InputError(InputMistake(problem, key="stretch"))
        return stretch
    if not stated.all() or own is None:
        many = f"{(~stated).sum():,} of {len(along):,} springs along the lines have no stiffness"
        raise InputError(InputMistake(f"`stretch` is missing: {many} from the mesh", key="stretch"))
    return 0.0
