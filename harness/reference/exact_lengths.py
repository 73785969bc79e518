"""Evaluation of steps with inextensible edges: least-squares tensions and the Lagrangian.

    minimise grad g . d + |d|_Q^2 / 2   such that   low <= l + n . A d <= high

Lengths l and directions n are those at p. Q is that of the step's projective energies and of the penalties of exact
lengths (`springbench.solvers.model.energies.augmented_lagrangian`). The solution d is zero if and only if p is a
stationary point. The tensions t are the multipliers of its constraints. They minimise the remaining gradient in the
norm of Q^-1 once the length errors are corrected. The active set is found by a semismooth Newton method
(Hintermueller, Ito and Kunisch 2002): a limit is active where l + t/k is beyond it. Linearly dependent lengths share
their tension.

With these tensions, the step of the Lagrangian has no length constraints. Its stationarity, its round-off and the
curvature that certifies a minimum are therefore evaluated as for any other step. The penalties of a certificate are
PENALTY_FACTOR times larger: if the curvature were negative along the constraints, no penalty would make it positive.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csr_array, diags_array, kron
from scipy.sparse.linalg import splu
from springbench.harness.reference.reference_evaluator import (
    ReferenceEvaluator,
    StationarityReading,
    assemble_stiffness,
)
from springbench.solvers.model.energies.augmented_lagrangian import (
    build_augmented_system,
    compute_penalty_stiffness,
    concatenate_constraints,
)
from springbench.solvers.model.energies.edge_energy import unit_directions
from springbench.solvers.model.step_problem import LengthConstraints, Positions, StepProblem, System
from springbench.solvers.model.system_matrix_assembly import signed_incidence_matrix_sparse

COMPLIANCE, NUM_REFINEMENTS = 1e-10, 4
"""Compliance of the regularised constraints relative to the penalties, and the number of iterative refinements."""

PENALTY_FACTOR = 1e4
MAX_ACTIVE_SET_CHANGES = 50
"""Maximum number of updates of the active set."""


class ExactLengths:
    """The exact lengths of a system, and its Lagrangians."""

    def __init__(self, system: System) -> None:
        """Assemble the augmented system; raises NotPositiveDefinite."""
        self._system, self.lengths = system, concatenate_constraints(system.length_constraints)
        self._penalties = compute_penalty_stiffness(system, self.lengths)
        self.augmented_system = self._augment_system(np.zeros(len(self._penalties)), 1.0)
        free, Q = system.free_vertices, assemble_stiffness(self.augmented_system)
        self._Q = csr_array(kron(Q[free][:, free], np.eye(3)))
        self._columns = (3 * free[:, None] + np.arange(3)).ravel()

    def _augment_system(self, tension: NDArray[np.float64], firm: float) -> System:
        return build_augmented_system(self._system, self.lengths, firm * self._penalties, tension)

    def build_lagrangian(
        self, problem: StepProblem, tension: NDArray[np.float64], penalty_factor: float = 1.0
    ) -> StepProblem:
        """Return the step whose objective is the Lagrangian of given tensions.

        Args:
            problem: step problem.
            tension: tensions (m,) [N].
            penalty_factor: factor on the penalties.
        """
        return replace(problem, system=self._augment_system(tension, penalty_factor))

    def compute_tensions(self, problem: StepProblem, p: Positions) -> NDArray[np.float64]:
        """Compute the tensions of the exact lengths at given positions.

        Args:
            problem: step problem, whose gradient the tensions oppose.
            p: positions (n, 3) [m].

        Returns:
            Tensions (m,) [N], positive where an edge pulls and zero where it is within its limits.
        """
        x, k, rows = self.lengths, self._penalties, len(self._columns)
        length, n = unit_directions(p[x.edges[:, 0]] - p[x.edges[:, 1]], x.rest_direction)
        J = _build_length_jacobian(x, n, len(p))[:, self._columns]
        downhill = -problem.gradient(p).ravel()[self._columns]
        tension = k * (length - np.clip(length, x.min_length, x.max_length))
        active = self._active_limits(length, tension)
        for _ in range(MAX_ACTIVE_SET_CHANGES):
            e = np.flatnonzero(active)
            to = np.where(active > 0, x.max_length, x.min_length)[e]
            found = _solve_saddle_point(self._Q, J[e], COMPLIANCE / k[e], np.concatenate([downhill, to - length[e]]))
            tension = np.zeros(len(k))
            tension[e] = found[rows:]
            before, active = active, self._active_limits(length + J @ found[:rows], tension)
            if np.array_equal(before, active):
                break
        return tension

    def _active_limits(self, length: NDArray[np.float64], tension: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the active limit of each length: 1 the longest, -1 the shortest, 0 none."""
        x, pulled = self.lengths, length + tension / self._penalties
        return np.where(
            (pulled > x.max_length) | (x.min_length == x.max_length), 1, np.where(pulled < x.min_length, -1, 0)
        )


class StationarityEvaluator:
    """Stationarity of the steps of a run, with one evaluator for each system.

    Systems differ where the first step, or every second one, has another rate.
    """

    def __init__(self) -> None:
        self._oracles: dict[float, ReferenceEvaluator] = {}
        self._exact: dict[float, ExactLengths] = {}

    def __call__(self, problem: StepProblem, p: Positions) -> StationarityReading:
        """Evaluate the stationarity at p, of the Lagrangian where lengths are exact.

        Args:
            problem: step problem; the evaluator of its system is built at the first call and used again.
            p: positions (n, 3) [m].
        """
        exact = self.get_exact_lengths(problem.system)
        if exact is None:
            return self._get_evaluator(problem.system).measure_stationarity(problem, p)
        stated = exact.build_lagrangian(problem, exact.compute_tensions(problem, p))
        return self._get_evaluator(exact.augmented_system).measure_stationarity(
            stated, p, self.compute_initial_residual(problem)
        )

    def compute_initial_residual(self, problem: StepProblem) -> float:
        """Compute the initial residual [J^(1/2)], with zero tensions where lengths are exact."""
        exact = self.get_exact_lengths(problem.system)
        if exact is None:
            return self._get_evaluator(problem.system).compute_initial_residual(problem)
        return self._get_evaluator(exact.augmented_system).compute_initial_residual(
            exact.build_lagrangian(problem, np.zeros(len(exact.lengths.min_length)))
        )

    def get_exact_lengths(self, system: System) -> ExactLengths | None:
        """Return the exact lengths of a system, None where it has none."""
        if system.length_constraints and system.velocity_rate not in self._exact:
            self._exact[system.velocity_rate] = ExactLengths(system)
        return self._exact.get(system.velocity_rate)

    def _get_evaluator(self, system: System) -> ReferenceEvaluator:
        if system.velocity_rate not in self._oracles:
            self._oracles[system.velocity_rate] = ReferenceEvaluator(system)
        return self._oracles[system.velocity_rate]


def _build_length_jacobian(x: LengthConstraints, n: Positions, vertices: int) -> csr_array:
    """Build the matrix (m, 3 vertices) of n_e . (p_i - p_j) for all edges."""
    A, whole = signed_incidence_matrix_sparse(x.edges, vertices), csr_array((len(n), 3 * vertices))
    for c in range(3):
        whole = csr_array(whole + kron(diags_array(n[:, c]) @ A, np.eye(3)[c : c + 1]))
    return whole


def _solve_saddle_point(
    Q: csr_array, J: csr_array, gives: NDArray[np.float64], right: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Solve [Q J'; J 0] x = b by iterative refinement.

    The factor is that of a slightly compliant matrix. The compliance avoids a singular matrix where lengths are
    linearly dependent; refinement removes its effect on the others.
    """
    if not len(gives):
        return np.asarray(splu(Q.tocsc()).solve(right))
    K = block_array([[Q, J.T], [J, None]]).tocsc()
    firm = np.concatenate([np.zeros(Q.shape[0]), -gives])
    factor, x = splu((K + diags_array(firm)).tocsc()), np.zeros_like(right)
    for _ in range(NUM_REFINEMENTS):
        x += factor.solve(right - K @ x)
    return x
