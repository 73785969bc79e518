"""Decomposition of a system's energies into springs and terms that the compiled methods compute like springs.

A constant quadratic form (bending, attachments, linear drag) is equivalent to springs of zero rest length between the
vertices that it couples, and a weight of each single vertex (see
`springbench.solvers.kernels.quadratic_form_kernels`). So the
kernels of springs compute its forces and its value. Its force at the origin, A'W d, is constant in a step and is added
to the external force. Strain limits and dashpots are edges with their own kernel (see
`springbench.solvers.kernels.edge_elements`); in Q they too are springs of zero rest length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Energy, Positions, StepProblem, StepStart, System, is_lagged

if TYPE_CHECKING:
    from springbench.solvers.kernels.edge_elements import EdgeElements
    from springbench.solvers.model.energies.dashpot_energy import Dashpots
    from springbench.solvers.model.energies.strain_limit_energy import StrainLimits


@dataclass(frozen=True, eq=False)
class SpringForm:
    """The decomposition of a system's energies.

    Attributes:
        springs: springs of the system.
        springs_and_forms: these and the pairs of the forms.
        system_pairs: all pairs in Q: these and the edges.
        vertex_weight: weight h of all forms at each vertex (n,) [N/m].
        form_builders: builders of each form for a step.
        strain_limits, dashpots: edge energies, with k [N/m] of both.
        unsupported_energies: names of unsupported energies.
        has_cancellation: whether pairs and springs of some vertices cancel, so that the pattern of Q omits their
            coupling.
    """

    springs: Springs
    springs_and_forms: Springs
    system_pairs: Springs
    vertex_weight: NDArray[np.float64]
    form_builders: tuple[Callable[[StepStart], Any], ...] = field(default=())
    strain_limits: tuple[StrainLimits, ...] = field(default=())
    dashpots: tuple[Dashpots, ...] = field(default=())
    unsupported_energies: tuple[str, ...] = field(default=())
    has_cancellation: bool = False

    def compute_force(self, problem: StepProblem) -> Positions:
        """Return the external force plus the constant one of the forms, (n, 3) [N]; not a copy without forms."""
        if not self.form_builders:
            return problem.external_force
        out = problem.external_force.copy()
        for form in self.form_builders:
            form(problem.step_start).add_projection(problem.inertial_target, out)
        return out

    def negative_energy(self, p: Positions) -> float:
        """Return the absolute energy [J] of the pairs with negative stiffness at p (n, 3) [m]."""
        return 0.5 * abs(float(np.einsum("ij,ij->", p, self._negative_stiffness @ p))) if self.form_builders else 0.0

    @cached_property
    def _negative_stiffness(self) -> csr_array:
        below = self.springs_and_forms.stiffness < 0.0
        return _zero_length_springs(
            self.springs_and_forms.edges[below], -self.springs_and_forms.stiffness[below]
        ).stiffness_matrix(len(self.vertex_weight))

    def build_edges(self, row: NDArray[np.int64], rows: int) -> EdgeElements | None:
        """Build the strain limits and dashpots as they are before a step; None if there are none.

        Args:
            row: row of each vertex (n,).
            rows: number of rows.
        """
        if not (self.strain_limits or self.dashpots):
            return None
        from springbench.solvers.kernels.edge_elements import EdgeElements

        both = (*self.strain_limits, *self.dashpots)
        ends, k = np.concatenate([e.edges for e in both]), np.concatenate([e.stiffness for e in both])
        none = np.empty(0)
        low, high = (
            np.concatenate([none, *(getattr(e, at) for e in self.strain_limits)]) for at in ("min_length", "max_length")
        )
        edges = EdgeElements.from_edges(ends, k, low, high, row, rows)
        edges.edge_axis[: len(low)] = np.concatenate(
            [none.reshape(0, 3), *(e.rest_direction for e in self.strain_limits)]
        )
        return edges

    def update_edges(self, edges: EdgeElements | None, problem: StepProblem) -> EdgeElements | None:
        """Return the edges updated to a step."""
        if edges is not None and any(map(is_lagged, self.strain_limits)):
            from springbench.solvers.model.energies.strain_limit_energy import StrainLimits

            limits = [e for e in problem.energies if isinstance(e, StrainLimits)]
            low, high = (np.concatenate([getattr(e, at) for e in limits]) for at in ("min_length", "max_length"))
            edges = edges._replace(min_length=low, max_length=high)
        if edges is None or not self.dashpots:
            return edges
        from springbench.solvers.model.energies.dashpot_energy import Dashpots

        steps, first = [e for e in problem.energies if isinstance(e, Dashpots)], len(edges.min_length)
        axis, offset = edges.edge_axis.copy(), edges.offset.copy()
        axis[first:] = np.concatenate([e.direction for e in steps])
        offset[first:] = np.concatenate([e.offset for e in steps])
        return edges._replace(edge_axis=axis, offset=offset)

    def edge_energy_scale(self, p: Positions) -> float:
        """Return the sum of k |v|^2 [J] over strain limits and dashpots at p (n, 3), the scale of cancellation."""
        return sum(float(e.stiffness @ e.edge_lengths(p) ** 2) for e in (*self.strain_limits, *self.dashpots))


def decompose_energies(system: System) -> SpringForm:
    """Decompose the energies of a system."""
    n = system.num_vertices
    springs = Springs.from_parts([energy for energy in system.energies if isinstance(energy, Springs)])
    others = [energy for energy in system.energies if not isinstance(energy, Springs)]
    if not others:
        return SpringForm(springs, springs, springs, np.zeros(n))
    from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
    from springbench.solvers.model.energies.dashpot_energy import Dashpots  # for those who need one of them
    from springbench.solvers.model.energies.quadratic_energy import Quadratic
    from springbench.solvers.model.energies.strain_limit_energy import StrainLimits

    forms = [energy for energy in others if isinstance(energy, Quadratic)]
    limits = tuple(energy for energy in others if isinstance(energy, StrainLimits))
    dashpots = tuple(
        replace(energy, stiffness=system.velocity_rate * energy.stiffness)
        for energy in others
        if isinstance(energy, Dashpots)
    )
    known = Quadratic, StrainLimits, Dashpots
    unknown = tuple(sorted({type(energy).__name__ for energy in others if not isinstance(energy, known)}))
    L: csr_array = reduce(
        lambda total, share: total + share, system_matrix_assembly.stiffness_shares(system, forms), csr_array((n, n))
    )
    form = QuadraticForm.from_matrix(L)
    whole = Springs.from_parts([springs, _zero_length_springs(form.pairs, form.pair_weight)])
    edges = [_zero_length_springs(energy.edges, energy.stiffness) for energy in (*limits, *dashpots)]
    pairs = Springs.from_parts([whole, *edges])
    K = Springs.from_parts([springs, *edges]).stiffness_matrix(n)
    return SpringForm(
        springs,
        whole,
        pairs,
        form.vertex_weight,
        tuple(form.begin_step if is_lagged(form) else _constant_form(form) for form in forms),
        limits,
        dashpots,
        unknown,
        system_matrix_assembly.drop_zeros(K + L).nnz < system_matrix_assembly.drop_zeros(abs(K) + abs(L)).nnz,
    )


def _zero_length_springs(edges: NDArray[np.int64], stiffness: NDArray[np.float64]) -> Springs:
    """Return springs of zero rest length."""
    flat = np.zeros(len(stiffness))
    return Springs(edges, stiffness, flat, flat[:, None] + [1.0, 0.0, 0.0])


def _constant_form(form: Energy) -> Callable[[StepStart], Energy]:
    return lambda start: form
