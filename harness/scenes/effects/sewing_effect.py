"""Sewing springs: two rows of vertices are pulled together over time, and stay together."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, model_validator
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.effect_interface import EffectContribution
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.vertex_selectors import VertexSelection
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model.energies.sewing_energy import Sewing as Energy

IndexArray = NDArray[np.int64]


class SewingEffect(ConfigModel):
    """Threads that pull two rows of vertices together.

    Each vertex of either row has a thread to the nearest vertex at rest of the other row. A thread pulls if it is
    longer than its current limit, which decreases linearly from `start_time` to `end_time`; it never pushes.
    """

    max_convergence_order: ClassVar[float] = 1.0

    kind: Literal["sewing"] = "sewing"
    first_row: VertexSelection
    """First row: a vertex selection as for pins."""
    second_row: VertexSelection
    """Second row."""
    stiffness: NonNegativeFloat
    """Total stiffness of the threads [N/m], divided equally, so that it is independent of the mesh size."""
    start_time: NonNegativeFloat = 0.0
    """Time [s] at which the threads start to shorten; until then they have their rest lengths."""
    end_time: NonNegativeFloat = 1.0
    """Time [s] at which the threads reach their final length; equal to `start_time` for an instantaneous change."""
    final_length: NonNegativeFloat = 0.0
    """Final length [m]; with self-contact at least its min_distance plus dhat, or contact forces oppose it."""

    @model_validator(mode="after")
    def _check_times(self) -> "SewingEffect":
        if self.end_time < self.start_time:
            raise ValueError(f"end at {self.end_time:g} s, before they begin at {self.start_time:g} s")
        return self

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the threads as one energy, empty for zero stiffness.

        Args:
            mesh: mesh, on which the rows are selected and whose rest positions match their vertices.
            mass, time_step: vertex masses (n,) [kg] and dt [s], which do not matter here.

        Raises:
            InputError: the rows have a common vertex, or the mesh lacks a selected part or vertex.
        """
        rows = (
            self.first_row.select_vertices(mesh, f"{self.kind}: first_row"),
            self.second_row.select_vertices(mesh, f"{self.kind}: second_row"),
        )
        if len(both := np.intersect1d(*rows)):
            raise InputError(
                f"{self.kind}: vertex {both[0]}{mesh.format_file_numbers(both[0])} is "
                "in both rows; each should be in one of them"
            )
        if not self.stiffness:
            return EffectContribution()
        pairs = _match_rows(mesh, *rows)
        at_rest = np.linalg.norm(mesh.rest_positions[pairs[:, 0]] - mesh.rest_positions[pairs[:, 1]], axis=1)
        drawn = np.minimum(at_rest, self.final_length)

        def compute_max_length(time: float) -> NDArray[np.float64]:
            long = self.end_time - self.start_time
            done = float(np.clip((time - self.start_time) / long, 0.0, 1.0)) if long else float(time >= self.start_time)
            return at_rest + done * (drawn - at_rest)

        k = np.full(len(pairs), self.stiffness / len(pairs))
        return EffectContribution(energies=(Energy.from_rest_shape(mesh.rest_positions, pairs, k, compute_max_length),))


def _match_rows(mesh: Mesh, first: IndexArray, second: IndexArray) -> IndexArray:
    """Match each vertex with the nearest one of the other row, (m, 2).

    Each pair occurs once.
    """
    from scipy.spatial import cKDTree

    one = np.asarray(cKDTree(mesh.rest_positions[second]).query(mesh.rest_positions[first])[1], np.int64)
    other = np.asarray(cKDTree(mesh.rest_positions[first]).query(mesh.rest_positions[second])[1], np.int64)
    pairs = [np.column_stack([first, second[one]]), np.column_stack([first[other], second])]
    return np.unique(np.concatenate(pairs), axis=0)
