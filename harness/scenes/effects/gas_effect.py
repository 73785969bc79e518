"""Gas: a fixed amount of gas in a closed mesh, E = -p0 V0 ln(V/V0)."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies import gas_energy


class GasEffect(ConfigModel):
    """Isothermal gas in a closed mesh, with vacuum outside: p V is constant."""

    max_convergence_order: ClassVar[float] = inf

    kind: Literal["gas"] = "gas"
    pressure: NonNegativeFloat
    """Pressure p0 in the rest shape relative to the outside [Pa]."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the energy, empty for zero pressure.

        Args:
            mesh: mesh, whose triangles enclose the gas; its volume at rest is that of the pressure.
            mass, time_step: vertex masses (n,) [kg] and dt [s], which do not matter here.

        Raises:
            InputError: the mesh is not closed, or encloses no volume.
        """
        if not self.pressure:
            return EffectContribution()
        triangles = mesh.triangles
        if not len(triangles):
            raise InputError("gas: needs a closed surface of triangles, and this mesh has no triangles")
        sides = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
        _require_closed_surface(sides, mesh)
        volume = gas_energy.Gas(triangles, self.pressure, 1.0).volume_at(mesh.rest_positions)
        if not abs(volume) > 1e-9 * mesh.bounding_box_diagonal**3:
            raise InputError(f"gas: the mesh encloses no volume (it is {volume:.3g} m^3)")
        outwards = triangles if volume > 0.0 else triangles[:, ::-1]
        return EffectContribution(energies=(gas_energy.Gas(outwards, self.pressure, abs(volume)),))


def _require_closed_surface(sides: NDArray[np.int64], mesh: Mesh) -> None:
    """Raise InputError unless each triangle side (3 f, 2) has exactly one opposite side of reversed direction."""
    n = len(mesh.rest_positions)
    forth, back = sides[:, 0] * n + sides[:, 1], sides[:, 1] * n + sides[:, 0]
    code, count = np.unique(forth, return_counts=True)
    if (count > 1).any():
        i, j = divmod(int(code[count > 1][0]), n)
        raise InputError(
            f"gas: two triangles traverse the edge in the same direction, from vertex {i} to {j}"
            f"{mesh.format_file_numbers(i, j)}; let all triangles face outwards"
        )
    alone = ~np.isin(forth, back)
    if alone.any():
        i, j = sides[alone][0].tolist()
        raise InputError(
            f"gas: needs a closed mesh; {alone.sum()} edges belong to one triangle only, the first from vertex {i} to "
            f"{j}{mesh.format_file_numbers(i, j)}; close the holes, join vertices that lie in one place"
        )
