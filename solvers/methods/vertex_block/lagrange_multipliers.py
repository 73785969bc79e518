# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# SciPy's type stubs for sparse matrices are incomplete.
"""Least-squares Lagrange multipliers of length constraints, for the residual of a step.

    minimise grad g . d + |d|_Q^2 / 2   such that   low <= l + n . A d <= high

    [ Q    J' ] [d]   [ -grad g   ]
    [ J  -eps ] [t] = [ bound - l ]       for the active lengths, J = n A

(Nocedal and Wright 2006, section 18.1.) The multipliers t [N] minimise the gradient in the norm of Q^-1, once the
lengths are corrected. A method's own multipliers may cancel the gradient while constraints are still violated, so that
a residual with them is not one of the step. A primal-dual active set method selects the active limits (Hintermueller,
Ito and Kunisch 2002).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, coo_array, csc_array, csr_array, diags_array, kron
from scipy.sparse.linalg import splu
from springbench.solvers.model.energies.edge_energy import unit_directions
from springbench.solvers.model.step_problem import LengthConstraints, Positions, ProjectiveEnergy, StepProblem, System
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

_COMPLIANCE = 1e-10
"""The value eps relative to 1/k. It regularises redundant constraints; refinement removes its effect."""
_REFINEMENT_STEPS = 4
_MAX_ACTIVE_SET_CHANGES = 50
"""Maximum number of changes of the active set."""


class LagrangeMultipliers:
    """The multipliers of a system's length constraints."""

    def __init__(self, augmented: System, constraints: LengthConstraints, stiffness: NDArray[np.float64]) -> None:
        """Assemble the matrices.

        Args:
            augmented: the system without constraints, with their penalties in Q.
            constraints: the constraints.
            stiffness: stiffnesses of the penalties (m,) [N/m].

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        Q = assemble_system_matrix(augmented, [e for e in augmented.energies if isinstance(e, ProjectiveEnergy)])
        free = augmented.free_vertices
        self._constraints, self._stiffness = constraints, stiffness
        self._Q = csr_array(kron(Q[free][:, free], np.eye(3)))
        self._dof_column = np.full((augmented.num_vertices, 3), -1)
        self._dof_column[free] = np.arange(3 * len(free)).reshape(-1, 3)
        self._free_vertices = free

    def multipliers_at(self, problem: StepProblem, p: Positions) -> NDArray[np.float64]:
        """Return the multipliers of a step at p, zero for lengths within their limits.

        Args:
            problem: the step; its gradient does not include the length constraints.
            p: positions (n, 3) [m].

        Returns:
            Multipliers t (m,) [N], positive if an edge pulls.
        """
        x, k = self._constraints, self._stiffness
        length, n = unit_directions(p[x.edges[:, 0]] - p[x.edges[:, 1]], x.rest_direction)
        J, downhill = self._jacobian(n), -problem.gradient(p)[self._free_vertices].ravel()
        tension = k * (length - np.clip(length, x.min_length, x.max_length))
        active = self._active_set(length, tension)
        for _ in range(_MAX_ACTIVE_SET_CHANGES):
            (active_indices,) = np.nonzero(active)
            bound = np.where(active > 0, x.max_length, x.min_length)[active_indices]
            step, found = self._solve_kkt(
                J[active_indices], k[active_indices], downhill, bound - length[active_indices]
            )
            tension = np.zeros(len(k))
            tension[active_indices] = found
            before, active = active, self._active_set(length + J @ step, tension)
            if np.array_equal(before, active):
                break
        return tension

    def _active_set(self, length: NDArray[np.float64], tension: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the active limit of each length: 1 the maximum, -1 the minimum, 0 none."""
        x, trial = self._constraints, length + tension / self._stiffness
        return np.where(
            (trial > x.max_length) | (x.min_length == x.max_length), 1, np.where(trial < x.min_length, -1, 0)
        )

    def _jacobian(self, n: Positions) -> csr_array:
        """Return the derivatives of the lengths (m, 3 f) by the coordinates of free vertices."""
        columns = self._dof_column[self._constraints.edges].reshape(len(n), 6)
        rows = np.repeat(np.arange(len(n)), 6).reshape(-1, 6)
        values, there = np.hstack([n, -n]), columns >= 0
        shape = len(n), self._Q.shape[0]
        return csr_array(coo_array((values[there], (rows[there], columns[there])), shape=shape))

    def _solve_kkt(
        self, J: csr_array, k: NDArray[np.float64], downhill: NDArray[np.float64], length_changes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Solve the linear system for d [m] and t [N]."""
        if not len(k):
            return np.asarray(splu(csc_array(self._Q)).solve(downhill)), np.empty(0)
        K = csc_array(block_array([[self._Q, J.T], [J, None]]))
        right = np.concatenate([downhill, length_changes])
        compliance = np.concatenate([np.zeros(len(downhill)), -_COMPLIANCE / k])
        factor, x = splu(csc_array(K + diags_array(compliance))), np.zeros_like(right)
        for _ in range(_REFINEMENT_STEPS):
            x += factor.solve(right - K @ x)
        return x[: len(downhill)], x[len(downhill) :]
