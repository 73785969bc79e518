"""The terms of the objective that do not change from step to step.

They are springs, constant forms and the pattern of the Hessian. The degrees of freedom are the free vertices. The
matrix of the Hessian is analysed once (`springbench.solvers.objective.hessian_pattern`), and terms that are constant in
a run are summed once.
"""

from __future__ import annotations

from copy import copy
from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.kernels import objective_kernels, spring_hessian
from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
from springbench.solvers.linalg.cholesky.block_cholesky import FactorisationCount
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.barrier_energy import is_barrier_energy
from springbench.solvers.model.energies.element_energies import ElementLaw, Elements
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Energy, ProjectiveEnergy, System, is_lagged
from springbench.solvers.objective.hessian_pattern import BlockMatrix


class ElementEnergy(NamedTuple):
    """An energy with an element-wise form in one step.

    Attributes:
        energy_index: its index in the system.
        is_projective: whether it is projective, and so part of Q.
        element_law: law of its elements.
        elements: its elements in this step.
    """

    energy_index: int
    is_projective: bool
    element_law: ElementLaw
    elements: Elements


class ObjectiveKernels(NamedTuple):
    """Kernels of springs and single vertices (`objective_kernels`, `spring_hessian`), for C-contiguous arrays."""

    gradient: TypedKernel
    objective_change: TypedKernel
    try_step: TypedKernel
    predict_positions: TypedKernel
    linearise_tensions: TypedKernel
    assemble_hessian: TypedKernel
    assemble_hessian_in_threads: TypedKernel
    linearise_springs: TypedKernel
    multiply_hessian: TypedKernel


class FixedObjective:
    """The parts of a system's objective that do not change from step to step.

    Attributes:
        system: the system.
        springs: all springs of the system, as one energy.
        objective_terms: springs, inertia and penalty pins, for the kernels.
        quadratic_form: sum of the quadratic forms, None if there are none.
        element_energy_indices: indices of energies with an element-wise form.
        other_energy_indices: indices of energies without one.
        forms_with_force: indices of quadratic forms with a force, or with one that changes from step to step.
        projective_indices: indices of projective energies other than springs.
        pinned_vertices: vertices of all pins.
        exact_pins: vertices of the exact pins.
        exact_pin_indices: their indices among all pins.
        kernels: kernels of springs and single vertices.
    """

    def __init__(self, system: System) -> None:
        self.system, self.pinned_vertices = system, np.array(system.pins.vertices)
        self.springs = Springs.from_parts([e for e in system.energies if isinstance(e, Springs)])
        self.objective_terms = objective_kernels.ObjectiveTerms.from_system(system, self.springs)
        self.exact_pin_indices, self.exact_pins = system.exact_pins
        self.kernels = ObjectiveKernels(
            TypedKernel(objective_kernels.gradient),
            TypedKernel(objective_kernels.objective_change),
            TypedKernel(objective_kernels.try_step),
            TypedKernel(objective_kernels.predict_positions),
            TypedKernel(spring_hessian.linearise_tensions),
            TypedKernel(spring_hessian.assemble_hessian),
            TypedKernel(spring_hessian.assemble_hessian_in_threads),
            TypedKernel(spring_hessian.linearise_springs),
            TypedKernel(spring_hessian.multiply_hessian),
        )
        self.quadratic_form: QuadraticForm | None = None
        self.forms_with_force: list[int] = []
        self.element_energy_indices: list[int] = []
        self.other_energy_indices: list[int] = []
        self.projective_indices: set[int] = set()
        others = {k: e for k, e in enumerate(system.energies) if not isinstance(e, Springs)}
        if others:
            self._classify_energies(others)
        self._factorisation_count = FactorisationCount()
        self._extended_matrix: BlockMatrix | None = None
        self._extended_blocks: tuple[NDArray[np.int64], NDArray[np.int64]] = (
            np.empty(0, np.int64),
            np.empty(0, np.int64),
        )

    def _classify_energies(self, energies: dict[int, Energy]) -> None:
        """Classify the energies that are not springs."""
        from springbench.solvers.model.energies.quadratic_energy import Quadratic

        quadratic = {k: e for k, e in energies.items() if isinstance(e, Quadratic)}
        if quadratic:
            n = self.system.num_vertices
            shares = system_matrix_assembly.stiffness_shares(self.system, quadratic.values())
            self.quadratic_form = QuadraticForm.from_matrix(
                reduce(lambda total, share: total + share, shares, csr_array((n, n)))
            )
        self.forms_with_force = [k for k, e in quadratic.items() if is_lagged(e) or e.d.any()]
        rest = {k: e for k, e in energies.items() if k not in quadratic}
        self.element_energy_indices = [k for k, e in rest.items() if hasattr(e, "element_law")]
        self.other_energy_indices = [k for k in rest if k not in self.element_energy_indices]
        self.projective_indices = {k for k, e in energies.items() if isinstance(e, ProjectiveEnergy)}

    @property
    def is_springs_and_forms(self) -> bool:
        """Whether all energies are springs and quadratic forms."""
        return not (self.element_energy_indices or self.other_energy_indices)

    @property
    def has_barriers(self) -> bool:
        """Whether any energy is a barrier."""
        return any(is_barrier_energy(self.system.energies[k]) for k in self.other_energy_indices)

    def ignore_barriers(self) -> FixedObjective:
        """Return the objective without barrier energies, for problems of the same system."""
        found, energies = copy(self), self.system.energies
        found.other_energy_indices = [k for k in self.other_energy_indices if not is_barrier_energy(energies[k])]
        return found

    @property
    def interpreted_energies(self) -> str:
        """Text about energies without an element-wise form, to append to a description.

        They run through Python. The text is empty if there are none.
        """
        names = sorted({type(self.system.energies[k]).__name__ for k in self.other_energy_indices})
        return f"; each iteration runs Python for {', '.join(names)}" if names else ""

    @cached_property
    def hessian_matrix(self) -> BlockMatrix:
        """The Hessian's matrix, for the pattern of springs, projective energies and elements."""
        n, s = self.system.num_vertices, self.system
        shares = (e.stiffness_matrix(n) for e in s.energies if isinstance(e, ProjectiveEnergy))
        pattern = reduce(
            lambda total, share: total + abs(share), shares, system_matrix_assembly.diagonal_matrix(np.ones(n))
        )
        free = csr_array(csr_array(pattern[s.free_vertices])[:, s.free_vertices])
        known: list[Any] = [s.energies[k].elements for k in self.element_energy_indices]  # pyright: ignore[reportAttributeAccessIssue]
        ends = [self.springs.edges, *(list_element_pairs(elements.vertices) for elements in known)]
        if self.quadratic_form is not None:
            ends.append(self.quadratic_form.pairs)
        i, j = np.concatenate(ends).T  # entries without stiffness, or that cancel, remain in the pattern
        return self._build_matrix(free, self.free_index[i], self.free_index[j])

    @cached_property
    def free_index(self) -> NDArray[np.int64]:
        """Index of each vertex among the free ones, -1 for the others, (n + 1,).

        The last entry is that of the vertex -1, which means none.
        """
        number = np.full(self.system.num_vertices + 1, -1)
        number[self.system.free_vertices] = np.arange(len(self.system.free_vertices))
        return number

    def free_vertex_pairs(self, vertices: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return all pairs of different free vertices within each row (a, k).

        The pairs are by free index, unique and ascending.
        """
        (a, k), size = vertices.shape, len(self.system.free_vertices)
        capacity = a * k * (k - 1) // 2
        pairs, scratch = np.empty((capacity, 2), np.int64), np.empty(capacity, np.int64)
        groups = np.empty(size + 1, np.int64), scratch, np.empty(size, np.int64)
        count = spring_hessian.list_vertex_pairs(self.free_index, vertices, *groups, pairs)
        return pairs[:count, 0], pairs[:count, 1]

    def _build_matrix(self, graph: csr_array, i: NDArray[np.int64], j: NDArray[np.int64]) -> BlockMatrix:
        terms, count = self.objective_terms, self._factorisation_count
        return BlockMatrix.from_graph(self.system, terms, self.quadratic_form, self.free_index, graph, i, j, count)

    def matrix_with_blocks(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> BlockMatrix:
        """Return a matrix that also has blocks (i, j) of free vertices.

        The last extended one is cached for the same blocks.

        Args:
            i, j: rows and columns of the blocks (k,), by index among the free vertices.

        Returns:
            The Hessian's matrix if it has the blocks, else one extended by them and by (j, i).
        """
        if self._extended_matrix is not None and all(map(np.array_equal, self._extended_blocks, (i, j))):
            return self._extended_matrix
        for known in (self.hessian_matrix, self._extended_matrix):
            if (
                known is not None
                and known.has_blocks(i, j)
                and (known is self.hessian_matrix or known.is_exact_extension(i, j, self.hessian_matrix))
            ):
                return known
        self._extended_matrix, self._extended_blocks = self._build_matrix(self.hessian_matrix.graph, i, j), (i, j)
        return self._extended_matrix


def list_element_pairs(vertices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return all vertex pairs of each element (m, k), as rows (m k^2, 2)."""
    k = vertices.shape[1]
    return np.column_stack([np.repeat(vertices, k, axis=1).ravel(), np.tile(vertices, k).ravel()])
