"""Attachments: zero-length springs from vertices to points that may move, E = sum_i k_i/2 |p_i - q_i(t)|^2."""

from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.vertex_selectors import VertexSelection
from springbench.harness.schema.base_model import Vector3
from springbench.solvers.model.energies.attachment_energy import Attachments as Energy
from springbench.solvers.model.step_problem import Positions


class AttachmentsEffect(VertexSelection):
    """Attaches each selected vertex to its own anchor by a spring; softer than pins."""

    max_convergence_order: ClassVar[float] = inf

    kind: Literal["attachments"] = "attachments"
    stiffness: NonNegativeFloat
    """Total stiffness of the springs [N/m], divided equally, so that it is independent of the mesh size."""
    anchors: tuple[Vector3, ...] | None = None
    """Anchors [m]: one for all vertices, or one for each in their order; by default their rest positions."""
    motion: KeyFrameMotion | None = None
    """Key frames of the motion of all anchors."""

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the springs as one energy, empty for zero stiffness.

        Args:
            mesh: mesh, on which vertices are selected; their rest positions are the anchors where none are given.
            mass, time_step: vertex masses (n,) [kg] and dt [s], which do not matter here.

        Raises:
            InputError: the selected vertices or the number of anchors do not fit the mesh.
        """
        vertices = self.select_vertices(mesh, self.kind)
        if self.anchors and len(self.anchors) not in (1, len(vertices)):
            raise InputError(
                f"attachments: anchors: got {len(self.anchors)} points for {len(vertices)} vertices; give one or all"
            )
        if not self.stiffness:
            return EffectContribution()
        fixed = np.broadcast_to(self.anchors, (len(vertices), 3)) if self.anchors else mesh.rest_positions[vertices]
        motion = self.motion

        def points(time: float) -> Positions:
            return motion.transform_points(fixed, time) if motion else fixed

        k = np.full(len(vertices), self.stiffness / len(vertices))
        return EffectContribution(energies=(Energy.from_vertices(vertices, k, points, len(mesh.rest_positions)),))
