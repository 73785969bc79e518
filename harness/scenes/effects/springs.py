"""Springs: one linear spring for each of the mesh's, its stiffness by a rule of `harness.scenes.material`.

Those of infinite stiffness are no energy: their lengths are kept exactly.
"""

from dataclasses import replace
from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, PositiveInt

from harness.base.model import Model
from harness.scenes.effects.base import Contribution, kept
from harness.scenes.material import spring_stiffness
from harness.scenes.mesh.base import Mesh
from harness.scenes.weave import Weave
from solvers.energies import springs


class Springs(Model):
    """Springs k/2 (length - rest length)^2 along the mesh's edges; those of no stiffness are left out, and those of
    infinite stiffness keep their lengths."""

    exact_to: ClassVar[float] = inf
    plain: ClassVar[bool] = True

    kind: Literal["springs"] = "springs"
    rule: Literal["continuum", "fixed", "liu2013"] = "continuum"
    """What the numbers below mean when the mesh size changes. `continuum`: the material stays the same;
    `fixed`: each spring has the stiffness given [N/m]; `liu2013`: stiffness in proportion to resolution,
    given at the size `reference`."""
    stretch: NonNegativeFloat | Literal["exact"] | Weave
    """Along the mesh's lines. Continuum: EA [N] for chains and trusses, [N/m] for cloth, [Pa] for solids; or one for
    each of warp, weft and bias, of a woven cloth; or `exact`: lengths do not change, which `avbd` alone can do."""
    shear: NonNegativeFloat | Literal["exact"] | None = None
    """Across the mesh's cells, in the same unit; as `stretch` if left out."""
    bend: NonNegativeFloat = 0.0
    """From a vertex to the next but one. Continuum: bending stiffness [N m]; else [N/m]."""
    reference: PositiveInt | None = None
    """liu2013: the mesh size at which the stiffnesses above hold."""

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        """The springs as one energy, none at all where no spring has stiffness, and the lengths that are exact."""
        given = self.stretch if self.shear is None else self.shear
        stretch, shear = (inf if x == "exact" else x for x in (self.stretch, given))
        k = spring_stiffness(
            mesh, rule=self.rule, stretch=stretch, shear=shear, bend=self.bend, reference=self.reference
        )
        stiff, exact = np.flatnonzero((k > 0.0) & (k < inf)), mesh.springs[k == inf]
        found = kept(mesh, exact, 1.0, 1.0)
        if not len(stiff):
            return found
        return replace(found, energies=(springs.Springs.at_rest(mesh.rest, mesh.springs[stiff], k[stiff]),))
