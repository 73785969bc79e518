"""Element energies for vertex-by-vertex methods: the couplings of vertices and the majorants.

If a single vertex moves, the change of a projective energy, w_e/2 |(A p)_e - d_e|^2, is bounded by its gradient and the
diagonal of A'WA, which is its contribution to the majorant of the vertex.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from solvers import matrices
from solvers.energies.elements import Elements, Law
from solvers.kernels import vbd as plain
from solvers.problem import ProjectiveEnergy, StepProblem, System, is_lagged

if TYPE_CHECKING:
    from solvers.kernels.stencils import Around


@dataclass(frozen=True, eq=False)
class Beside:
    """The projective energies of a system with an element-wise form.

    Attributes:
        numbers: their indices in the system.
        around: their elements by rows, one set for each law, once the rows are known.
    """

    system: System
    numbers: tuple[int, ...] = ()
    around: tuple[Around, ...] = field(default=())

    @classmethod
    def of(cls, system: System) -> Beside:
        """Select those of a system."""
        known = (k for k, e in enumerate(system.energies) if hasattr(e, "law") and isinstance(e, ProjectiveEnergy))
        return cls(system, tuple(known))

    @property
    def energies(self) -> list[Any]:
        """The selected energies."""
        return [self.system.energies[k] for k in self.numbers]

    def pairs(self) -> NDArray[np.int64]:
        """Return all pairs of vertices of an element, (., 2)."""
        found = [np.empty((0, 2), np.int64)]
        for energy in self.energies:
            vertices = energy.elements.vertices
            found += [vertices[:, [i, j]] for i, j in zip(*np.triu_indices(vertices.shape[1], 1), strict=True)]
        return np.concatenate(found)

    def diagonal(self) -> NDArray[np.float64]:
        """Return the diagonal of A'WA (n,) [N/m], which does not depend on the step."""
        total = np.zeros(self.system.vertices)
        for share in matrices.shares(self.system, self.energies):
            total += share.diagonal()
        return total

    def among(self, row: NDArray[np.int64], rows: int) -> Beside:
        """Return these energies with vertices in rows `row` (n,) of `rows`."""
        if not self.numbers:
            return self
        from solvers.kernels.stencils import Around  # for those who need it

        joined = zip(self._laws, self._joined(self.energies), strict=True)
        return replace(self, around=tuple(Around.of(law, one, row, rows) for law, one in joined))

    def begun(self, problem: StepProblem) -> tuple[Around, ...] | None:
        """Return the elements by rows, updated to a step; None if there are none."""
        if not any(is_lagged(energy) for energy in self.energies):
            return self.around or None
        joined = self._joined([problem.energies[k] for k in self.numbers])
        return tuple(
            around.with_numbers(law, one) for around, law, one in zip(self.around, self._laws, joined, strict=True)
        )

    @cached_property
    def kernel(self) -> Any:
        """The kernel `solvers.kernels.vbd.iterate` extended by these energies."""
        if not self.numbers:
            return plain.iterate
        from solvers.kernels.stencils import Kind  # for those who need it
        from solvers.kernels.vbd_elements import iterating

        widths = [one.vertices.shape[1] for one in self._joined(self.energies)]
        return iterating(*(Kind(*kind) for kind in zip(self._laws, widths, strict=True)))

    @cached_property
    def _laws(self) -> list[Law]:
        """The distinct laws."""
        return list({id(energy.law): energy.law for energy in self.energies}.values())

    def _joined(self, energies: list[Any]) -> list[Elements]:
        """Concatenate the elements of the energies by law."""
        of_law = [[e.elements for e in energies if e.law is law] for law in self._laws]
        return [Elements(*(np.concatenate(arrays) for arrays in zip(*some, strict=True))) for some in of_law]
