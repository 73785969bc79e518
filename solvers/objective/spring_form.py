"""Decomposition of a system's energies into springs and terms computed like springs.

A constant quadratic form (bending, attachments, linear drag) is equivalent to springs of zero rest length between the
vertices that it couples, and a weight of each single vertex (see
`springbench.solvers.kernels.quadratic_form_kernels`). So the kernels of springs compute its forces and its value. Its
force at the origin, A'W d, is constant in a step and is added to the external force. Strain limits and dashpots are
evaluated with the spring between the same vertices (`springbench.solvers.kernels.edge_elements`); in Q they too are
springs of zero rest length.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.edge_energy import vertex_pair_keys
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Energy, Positions, StepProblem, StepStart, System, is_lagged

if TYPE_CHECKING:
    from springbench.solvers.kernels.edge_elements import AttachedEdges
    from springbench.solvers.kernels.spring_local_step import SpringPackets
    from springbench.solvers.model.energies.dashpot_energy import Dashpots
    from springbench.solvers.model.energies.strain_limit_energy import StrainLimits


@dataclass(frozen=True, eq=False)
class SpringForm:
    """The decomposition of a system's energies.

    Attributes:
        springs: springs of the system.
        springs_and_forms: the springs, and the pairs of the forms as springs of zero rest length.
        joined_pairs: the same, where a spring and a pair between the same vertices are one spring; the value differs by
            a constant.
        system_pairs: all pairs in Q: the joined ones and the edges, without rest lengths if there are edges.
        vertex_weight: weight h of all forms at each vertex (n,) [N/m].
        form_builders: builders of each form for a step.
        strain_limits, dashpots: edge energies; the stiffness of both is in N/m.
        unsupported_energies: names of unsupported energies.
        has_cancellation: whether pairs and springs of some vertices cancel, so that the pattern of Q omits their
            coupling.
    """

    springs: Springs
    springs_and_forms: Springs
    joined_pairs: Springs
    system_pairs: Springs
    vertex_weight: NDArray[np.float64]
    form_builders: tuple[Callable[[StepStart], Any], ...] = field(default=())
    strain_limits: tuple[StrainLimits, ...] = field(default=())
    dashpots: tuple[Dashpots, ...] = field(default=())
    unsupported_energies: tuple[str, ...] = field(default=())
    has_cancellation: bool = False

    def compute_force(self, problem: StepProblem) -> Positions:
        """Return the external force plus the constant one of the forms, (n, 3) [N].

        Without forms it is the array of the problem, not a copy.
        """
        if not self.form_builders:
            return problem.external_force
        out = problem.external_force.copy()
        for form in self.form_builders:
            form(problem.step_start).add_projection(problem.inertial_target, out)
        return out

    def negative_energy(self, p: Positions) -> float:
        """Return the absolute energy [J] of pairs with negative stiffness.

        Args:
            p: positions (n, 3) [m], as of `as_kernel_array`.
        """
        return 0.5 * self._sum_squared_stretch.call(*self.negative_pairs, p) if self.form_builders else 0.0

    @property
    def has_edges(self) -> bool:
        """Whether there are strain limits or dashpots."""
        return bool(self.strain_limits or self.dashpots)

    @cached_property
    def negative_pairs(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The pairs with negative stiffness (m, 2), and its absolute value (m,) [N/m]."""
        pairs = self.springs_and_forms
        below = pairs.stiffness < 0.0
        return pairs.edges[below], -pairs.stiffness[below]

    def attach_edges(self, springs: Springs) -> AttachedEdges | None:
        """Attach the strain limits and dashpots to springs between the same vertices.

        The result is None if there are none.
        """
        if not self.has_edges:
            return None
        from springbench.solvers.kernels.edge_elements import AttachedEdges

        return AttachedEdges.from_energies(springs, self.strain_limits, self.dashpots)

    def select_packed_edges(self) -> SpringForm:
        """Return the form without edges of another law, such as those of an augmented Lagrangian."""
        limits = tuple(e for e in self.strain_limits if is_packed_edge(e))
        return self if len(limits) == len(self.strain_limits) else replace(self, strain_limits=limits)

    def update_edges(self, packets: SpringPackets, problem: StepProblem) -> SpringPackets:
        """Return packets whose strain limits and dashpots are those of a step.

        Args:
            packets: packets of the springs, with the edges of this form attached; their dashpots are overwritten.
            problem: the step.
        """
        edges = packets.edges
        if edges is None:
            return packets
        from springbench.solvers.model.energies.dashpot_energy import Dashpots

        if any(map(is_lagged, self.strain_limits)):
            kinds = tuple({type(e) for e in self.strain_limits})
            limits = [e for e in problem.energies if isinstance(e, kinds)]
            low, high = (np.concatenate([getattr(e, at) for e in limits]) for at in ("min_length", "max_length"))
            packets = packets._replace(edges=edges.with_limits(low, high))
        if self.dashpots:
            steps = [e for e in problem.energies if isinstance(e, Dashpots)]
            edges.write_directions(_join_arrays([e.direction for e in steps]), _join_arrays([e.offset for e in steps]))
        return packets

    def edge_energy_scale(self, p: Positions) -> float:
        """Return the sum of k |v|^2 [J] over strain limits and dashpots at p.

        It is the scale of cancellation in their energy; p is (n, 3) [m], as of `as_kernel_array`.
        """
        return self._sum_squared_stretch.call(*self._joined_edges, p)

    @cached_property
    def _joined_edges(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """The edges of all strain limits and dashpots (m, 2), and their stiffness (m,) [N/m]."""
        energies = *self.strain_limits, *self.dashpots
        return np.concatenate([e.edges for e in energies]), np.concatenate([e.stiffness for e in energies])

    @cached_property
    def _sum_squared_stretch(self) -> TypedKernel:
        from springbench.solvers.kernels.edge_elements import sum_squared_stretch

        return TypedKernel(sum_squared_stretch)


def is_packed_edge(energy: Any) -> bool:
    """Return whether packets of springs evaluate an energy.

    They evaluate the laws of strain limits and dashpots.
    """
    from springbench.solvers.model.energies.dashpot_energy import Dashpots
    from springbench.solvers.model.energies.strain_limit_energy import StrainLimits

    return isinstance(energy, (StrainLimits, Dashpots)) and energy.element_law in (
        StrainLimits.element_law,
        Dashpots.element_law,
    )


def decompose_energies(system: System) -> SpringForm:
    """Decompose the energies of a system."""
    n = system.num_vertices
    springs = Springs.from_parts([energy for energy in system.energies if isinstance(energy, Springs)])
    others = [energy for energy in system.energies if not isinstance(energy, Springs)]
    if not others:
        return SpringForm(springs, springs, springs, springs, np.zeros(n))
    from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
    from springbench.solvers.model.energies.dashpot_energy import Dashpots
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
    joined = _join_pairs(springs, form.pairs, form.pair_weight) if len(form.pairs) else whole
    edges = [_zero_length_springs(energy.edges, energy.stiffness) for energy in (*limits, *dashpots)]
    pairs = _merge_parallel_pairs(Springs.from_parts([joined, *edges])) if edges else joined
    K = Springs.from_parts([springs, *edges]).stiffness_matrix(n)
    return SpringForm(
        springs,
        whole,
        joined,
        pairs,
        form.vertex_weight,
        tuple(form.begin_step if is_lagged(form) else _constant_form(form) for form in forms),
        limits,
        dashpots,
        unknown,
        system_matrix_assembly.drop_zeros(K + L).nnz < system_matrix_assembly.drop_zeros(abs(K) + abs(L)).nnz,
    )


def _join_pairs(springs: Springs, pairs: NDArray[np.int64], weight: NDArray[np.float64]) -> Springs:
    """Return springs and pairs of zero rest length, joined between the same vertices.

    k/2 (l - r)^2 + w/2 l^2 = (k + w)/2 (l - k r/(k + w))^2 up to a constant. A pair that would leave no positive
    stiffness remains separate. Vertex blocks need both separately, because a compressed spring loses its transverse
    stiffness there and a pair does not.

    Args:
        springs: the springs.
        pairs: vertex pairs (m, 2), none of them twice.
        weight: their stiffnesses w [N/m], of either sign.
    """
    size = 1 + int(max(springs.edges.max(initial=0), pairs.max(initial=0)))
    spring_keys, first = np.unique(vertex_pair_keys(springs.edges, size), return_index=True)
    pair_keys = vertex_pair_keys(pairs, size)
    is_joined = np.isin(pair_keys, spring_keys)
    at = first[np.searchsorted(spring_keys, pair_keys[is_joined])]
    is_joined[is_joined] = (springs.stiffness[at] > 0.0) & (springs.stiffness[at] + weight[is_joined] > 0.0)
    at = first[np.searchsorted(spring_keys, pair_keys[is_joined])]
    k, rest = springs.stiffness.copy(), springs.rest_length.copy()
    k[at] += weight[is_joined]
    rest[at] *= springs.stiffness[at] / k[at]
    others = _zero_length_springs(pairs[~is_joined], weight[~is_joined])
    return Springs.from_parts([replace(springs, stiffness=k, rest_length=rest), others])


def _merge_parallel_pairs(springs: Springs) -> Springs:
    """Return one spring of zero rest length between each two vertices.

    It has the stiffness of all springs between them.
    """
    ends, pair = np.unique(np.sort(springs.edges, axis=1), axis=0, return_inverse=True)
    stiffness = np.zeros(len(ends))
    np.add.at(stiffness, pair.ravel(), springs.stiffness)
    return _zero_length_springs(ends, stiffness)


def _join_arrays(parts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the arrays as one, not a copy if there is only one."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _zero_length_springs(edges: NDArray[np.int64], stiffness: NDArray[np.float64]) -> Springs:
    """Return springs of zero rest length."""
    flat = np.zeros(len(stiffness))
    return Springs(edges, stiffness, flat, flat[:, None] + [1.0, 0.0, 0.0])


def _constant_form(form: Energy) -> Callable[[StepStart], Energy]:
    return lambda start: form
