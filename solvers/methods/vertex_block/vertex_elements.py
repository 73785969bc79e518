"""Element energies for vertex-by-vertex methods: the couplings of vertices and the majorants.

Springs, strain limits and dashpots are in packets of eight vertices (`springbench.solvers.kernels.edge_elements`).
This module has all other projective energies with an element-wise form.

If a single vertex moves, the change of a projective energy, w_e/2 |(A p)_e - d_e|^2, is bounded by its gradient and the
diagonal of A'WA, which is its contribution to the majorant of the vertex.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.methods.vertex_block import vbd_sweeps as plain
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.element_energies import ElementLaw, Elements
from springbench.solvers.model.step_problem import ProjectiveEnergy, StepProblem, System, is_lagged
from springbench.solvers.objective.spring_form import is_packed_edge

if TYPE_CHECKING:
    from springbench.solvers.methods.vertex_block.incident_elements import ElementKind, IncidentElements


@dataclass(frozen=True, eq=False)
class VertexElements:
    """The projective energies of a system with an element-wise form.

    Attributes:
        energy_indices: their indices in the system.
        incident_elements: their elements by rows, one set for each law, once the rows are known.
    """

    system: System
    energy_indices: tuple[int, ...] = ()
    incident_elements: tuple[IncidentElements, ...] = field(default=())

    @classmethod
    def from_system(cls, system: System) -> VertexElements:
        """Select these energies of a system."""
        known = (
            k
            for k, e in enumerate(system.energies)
            if hasattr(e, "element_law") and isinstance(e, ProjectiveEnergy) and not is_packed_edge(e)
        )
        return cls(system, tuple(known))

    @property
    def energies(self) -> list[Any]:
        """The selected energies."""
        return [self.system.energies[k] for k in self.energy_indices]

    def list_vertex_pairs(self) -> NDArray[np.int64]:
        """Return all vertex pairs of all elements, (k, 2)."""
        found = [np.empty((0, 2), np.int64)]
        for energy in self.energies:
            vertices = energy.elements.vertices
            found += [vertices[:, [i, j]] for i, j in zip(*np.triu_indices(vertices.shape[1], 1), strict=True)]
        return np.concatenate(found)

    def stiffness_diagonal(self) -> NDArray[np.float64]:
        """Return the diagonal of A'WA (n,) [N/m], which does not depend on the step."""
        total = np.zeros(self.system.num_vertices)
        for share in system_matrix_assembly.stiffness_shares(self.system, self.energies):
            total += share.diagonal()
        return total

    def with_rows(self, row: NDArray[np.int64], rows: int) -> VertexElements:
        """Return these energies with their elements sorted by rows.

        Args:
            row: row of each vertex (n,).
            rows: number of rows, padding included.
        """
        if not self.energy_indices:
            return self
        from springbench.solvers.methods.vertex_block.incident_elements import IncidentElements

        joined = zip(self._unique_laws, self._elements_by_law(self.energies), strict=True)
        return replace(
            self, incident_elements=tuple(IncidentElements.from_elements(law, one, row, rows) for law, one in joined)
        )

    def update_elements(self, problem: StepProblem) -> tuple[IncidentElements, ...] | None:
        """Return the elements by rows, updated to a step; None if there are none."""
        if not any(is_lagged(energy) for energy in self.energies):
            return self.incident_elements or None
        joined = self._elements_by_law([problem.energies[k] for k in self.energy_indices])
        return tuple(
            around.with_parameters(law, one)
            for around, law, one in zip(self.incident_elements, self._unique_laws, joined, strict=True)
        )

    @cached_property
    def iteration_kernel(self) -> Any:
        """The kernel `vbd_sweeps.run_iterations`, extended by these energies."""
        if not self.energy_indices:
            return plain.run_iterations
        from springbench.solvers.methods.vertex_block.vbd_element_sweeps import build_element_iteration

        return build_element_iteration(*self.element_kinds)

    @property
    def element_kinds(self) -> list[ElementKind]:
        """The laws and widths of the elements, in the order of `incident_elements`."""
        from springbench.solvers.methods.vertex_block.incident_elements import ElementKind

        widths = [one.vertices.shape[1] for one in self._elements_by_law(self.energies)]
        return [ElementKind(*kind) for kind in zip(self._unique_laws, widths, strict=True)]

    @cached_property
    def _unique_laws(self) -> list[ElementLaw]:
        """The distinct laws."""
        return list({id(energy.element_law): energy.element_law for energy in self.energies}.values())

    def _elements_by_law(self, energies: list[Any]) -> list[Elements]:
        """Concatenate the elements of the energies by law."""
        of_law = [[e.elements for e in energies if e.element_law is law] for law in self._unique_laws]
        return [Elements(*(np.concatenate(arrays) for arrays in zip(*some, strict=True))) for some in of_law]
