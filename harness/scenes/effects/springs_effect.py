"""Springs: one linear spring per mesh spring, with a stiffness by a rule of
`springbench.harness.scenes.spring_stiffness`.

Springs of infinite stiffness have no energy: they are length constraints.
"""

from dataclasses import replace
from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveInt
from springbench.harness.scenes.effects.effect_interface import EffectContribution, build_length_constraints
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.orthotropic_cloth import OrthotropicStiffness
from springbench.harness.scenes.spring_stiffness import compute_spring_stiffness
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies import spring_energy


class SpringsEffect(ConfigModel):
    """Springs k/2 (length - rest length)^2 along the mesh's edges.

    Springs of zero stiffness are omitted; springs of infinite stiffness are length constraints.
    """

    max_convergence_order: ClassVar[float] = inf
    is_baseline_effect: ClassVar[bool] = True

    kind: Literal["springs"] = "springs"
    scaling_rule: Literal["continuum", "fixed", "liu2013"] = "continuum"
    """Scaling rule of the values below with the mesh size. `continuum`: the material is independent of the mesh;
    `fixed`: each spring has the given stiffness [N/m]; `liu2013`: stiffness proportional to the resolution,
    given at the size `reference_size`."""
    stretch: NonNegativeFloat | Literal["exact"] | OrthotropicStiffness
    """Along the mesh's lines. Continuum: EA [N] for chains and trusses, [N/m] for cloth, [Pa] for solids; or one value
    each for warp, weft and bias of a woven cloth; or `exact`: length constraints, supported by `avbd` only."""
    shear: NonNegativeFloat | Literal["exact"] | None = None
    """Across the mesh's cells, in the same unit; equal to `stretch` by default."""
    bend: NonNegativeFloat = 0.0
    """Springs that skip one vertex. Continuum: bending stiffness [N m]; otherwise [N/m]."""
    reference_size: PositiveInt | None = None
    """liu2013: the mesh size for which the stiffnesses above are given."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the springs as one energy, empty without stiffness, and the length constraints."""
        given = self.stretch if self.shear is None else self.shear
        stretch, shear = (inf if x == "exact" else x for x in (self.stretch, given))
        k = compute_spring_stiffness(
            mesh,
            scaling_rule=self.scaling_rule,
            stretch=stretch,
            shear=shear,
            bend=self.bend,
            reference_size=self.reference_size,
        )
        stiff, exact = np.flatnonzero((k > 0.0) & (k < inf)), mesh.springs[k == inf]
        found = build_length_constraints(mesh, exact, 1.0, 1.0)
        if not len(stiff):
            return found
        return replace(
            found, energies=(spring_energy.Springs.from_rest_shape(mesh.rest_positions, mesh.springs[stiff], k[stiff]),)
        )
