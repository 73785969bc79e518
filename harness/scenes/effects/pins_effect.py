"""Pins: Dirichlet conditions at rest positions that may move, exact or by a penalty (w/2 |p - q|^2)."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat
from springbench.harness.scenes.effects.effect_interface import EffectContribution, PinGroup
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.vertex_selectors import VertexSelection


class PinsEffect(VertexSelection):
    """Pins each selected vertex."""

    max_convergence_order: ClassVar[float] = inf
    is_baseline_effect: ClassVar[bool] = True

    kind: Literal["pins"] = "pins"
    weight: PositiveFloat | Literal["exact"] = Field(default=1e10)
    """Penalty weight w [N/m], or `exact`: the degrees of freedom of the vertices are eliminated."""
    motion: KeyFrameMotion | None = None
    """Key frames of the motion of all pinned vertices."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the selected vertices, pinned to their rest positions.

        Args:
            mesh: mesh, on which vertices are selected.
            mass, time_step: vertex masses (n,) [kg] and dt [s], which do not matter here.

        Raises:
            InputError: the mesh lacks a selected part or vertex.
        """
        vertices = self.select_vertices(mesh, self.kind)
        weight = inf if self.weight == "exact" else float(self.weight)
        return EffectContribution(pins=(PinGroup(vertices, mesh.rest_positions[vertices], weight, self.motion),))
