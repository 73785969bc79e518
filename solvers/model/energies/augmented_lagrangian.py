"""Length constraints by an augmented Lagrangian (Hestenes 1969; Powell 1969; Rockafellar 1973 for inequalities).

    minimise g(p)   such that   low_e <= l_e <= high_e,   l_e = |v_e|,   v = A p

    L(p) = g(p) + sum_e k_e/2 (l_e + t_e/k_e - clip(l_e + t_e/k_e, low_e, high_e))^2

with the tensions t [N], positive if an edge pulls. An edge of L is a strain limit of stiffness k whose limits are
shifted by t/k, and L is the objective of a step without length constraints. If all constraints are satisfied and
grad L = 0, the Karush-Kuhn-Tucker conditions hold with multipliers t: an edge within its limits has no tension, one at
its maximum length pulls, and one at its minimum length pushes. If L also has positive curvature, for any k, then p is a
minimum of g among the feasible positions (Finsler's lemma). So the checks of an unconstrained step apply to this one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.model.energies import strain_limit_energy
from springbench.solvers.model.energies.edge_energy import ZERO_LENGTH
from springbench.solvers.model.energies.element_energies import ElementLaw, axial_hessian
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits
from springbench.solvers.model.step_problem import LengthConstraints, Positions, ProjectiveEnergy, StepStart, System
from springbench.solvers.model.system_matrix_assembly import stiffness_shares

_LIMIT_FUNCTIONS = StrainLimits.element_law.element_functions


@jit_inner
def _hessian(numbers, e, z0, z1, z2):
    """Return the Hessian of a strain limit without a compressed edge's negative transverse part."""
    length = np.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
    force = numbers[e, 0] * strain_limit_energy.length_excess(numbers, e, length)
    if force == 0.0 and numbers[e, 1] < numbers[e, 2]:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n0, n1, n2 = strain_limit_energy.edge_direction(numbers, e, length, z0, z1, z2)
    return axial_hessian(numbers[e, 0], max(0.0, force / length) if length > ZERO_LENGTH else 0.0, n0, n1, n2)


@dataclass(frozen=True, eq=False)
class AugmentedLagrangian(StrainLimits):
    """Edges of an augmented Lagrangian, whose limits are shifted by the tensions."""

    element_law: ClassVar[ElementLaw] = ElementLaw.from_functions(
        _LIMIT_FUNCTIONS.value, _LIMIT_FUNCTIONS.gradient, _hessian, _LIMIT_FUNCTIONS.energy_change
    )

    @classmethod
    def from_constraints(
        cls, constraints: LengthConstraints, stiffness: NDArray[np.float64], tensions: NDArray[np.float64]
    ) -> AugmentedLagrangian:
        """Return the edges of L for length constraints.

        Args:
            constraints: edges and the limits of their lengths.
            stiffness: stiffnesses k (m,) [N/m], positive.
            tensions: tensions t (m,) [N], which shift the limits.
        """
        moved = tensions / stiffness
        return cls(
            constraints.edges,
            stiffness,
            constraints.min_length - moved,
            constraints.max_length - moved,
            constraints.rest_direction,
        )

    def begin_step(self, start: StepStart) -> AugmentedLagrangian:
        """Return the energy itself, because the tensions are fixed."""
        return self


def concatenate_constraints(parts: Sequence[LengthConstraints]) -> LengthConstraints:
    """Concatenate length constraints in their order; an empty set for no parts."""
    none = LengthConstraints(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.empty((0, 3)))
    fields = zip(*((x.edges, x.min_length, x.max_length, x.rest_direction) for x in (none, *parts)), strict=True)
    return LengthConstraints(*(np.concatenate(arrays) for arrays in fields))


def length_errors(constraints: LengthConstraints, p: Positions) -> NDArray[np.float64]:
    """Return the constraint violations at p, negative below the minimum length.

    Args:
        constraints: edges and the limits of their lengths.
        p: positions (n, 3) [m].

    Returns:
        Violations (m,) [m], zero within the limits.
    """
    found = np.linalg.norm(p[constraints.edges[:, 0]] - p[constraints.edges[:, 1]], axis=1)
    return found - np.clip(found, constraints.min_length, constraints.max_length)


def compute_penalty_stiffness(system: System, constraints: LengthConstraints) -> NDArray[np.float64]:
    """Return stiffnesses by which edges resist as much as their ends do.

    They are k = 1/(1/q_i + 1/q_j), where q is the diagonal of Q. An edge between exact pins, which cannot move, gets
    the value 1.

    Args:
        system: inertia, pins and projective energies, which determine q.
        constraints: the edges.

    Returns:
        Stiffnesses k (m,) [N/m].
    """
    if not len(constraints.edges):
        return np.empty(0)
    q = system.inertia_diagonal.copy()
    for share in stiffness_shares(
        system, [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
    ):
        q += share.diagonal()
    q[system.pins.vertices] += system.pins.weight
    with np.errstate(divide="ignore"):
        gives = (1.0 / q)[constraints.edges].sum(axis=1)
    return np.divide(1.0, gives, out=np.ones(len(gives)), where=(gives > 0.0) & np.isfinite(gives))


def build_augmented_system(
    system: System, constraints: LengthConstraints, stiffness: NDArray[np.float64], tensions: NDArray[np.float64]
) -> System:
    """Return the system without length constraints whose objective is L.

    Without constraints the result has the objective of the system itself.

    Args:
        system: the system with constraints.
        constraints: its constraints.
        stiffness: stiffnesses k (m,) [N/m].
        tensions: tensions t (m,) [N].
    """
    if not len(constraints.edges):
        return replace(system, length_constraints=()) if system.length_constraints else system
    return replace(
        system,
        energies=(*system.energies, AugmentedLagrangian.from_constraints(constraints, stiffness, tensions)),
        length_constraints=(),
    )
