"""Evaluation of steps with inextensible edges: least-squares tensions and the Lagrangian.

    minimise grad g . d + |d|_Q^2 / 2   such that   low <= l + n . A d <= high

Lengths l and directions n are those at p. Q is that of the step's projective energies and of the penalties of exact
lengths (`solvers.energies.augmented`). The solution d is zero if and only if p is a stationary point.
The tensions t are the multipliers of its constraints: of all tensions, those that minimise the remaining gradient in
the norm of Q^-1 once the length errors are corrected. The active set is found by a semismooth Newton method
(Hintermueller, Ito and Kunisch 2002): a limit is active where l + t/k is beyond it. Linearly dependent lengths share
their tension.

With these tensions, the step of the Lagrangian has no length constraints. Its stationarity, its round-off and the
curvature that certifies a minimum are therefore evaluated as for any other step. The penalties of a certificate are
FIRM times larger: if the curvature were negative along the constraints, no penalty would make it positive.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csr_array, diags_array, kron
from scipy.sparse.linalg import splu

from harness.reference.oracle import Oracle, Reading, stiffness
from solvers.energies.augmented import augmented, joined, penalties
from solvers.energies.edges import directions
from solvers.held import Lengths
from solvers.matrices import signed_incidence_matrix_sparse
from solvers.problem import Positions, StepProblem, System

GIVE, PASSES = 1e-10, 4
"""Compliance of the regularised constraints relative to the penalties, and the number of iterative refinements."""

FIRM = 1e4
CHANGES = 50
"""Maximum number of updates of the active set."""


class Exact:
    """The exact lengths of a system, and its Lagrangians."""

    def __init__(self, system: System) -> None:
        """Assemble the augmented system; raises NotPositiveDefinite."""
        self._system, self.lengths = system, joined(system.lengths)
        self._penalties = penalties(system, self.lengths)
        self.augmented = self._with(np.zeros(len(self._penalties)), 1.0)
        free, Q = system.free, stiffness(self.augmented)
        self._Q = csr_array(kron(Q[free][:, free], np.eye(3)))
        self._columns = (3 * free[:, None] + np.arange(3)).ravel()

    def _with(self, tension: NDArray[np.float64], firm: float) -> System:
        return augmented(self._system, self.lengths, firm * self._penalties, tension)

    def lagrangian(self, problem: StepProblem, tension: NDArray[np.float64], firm: float = 1.0) -> StepProblem:
        """Return the step whose objective is the Lagrangian of given tensions.

        Args:
          problem: step problem.
          tension: tensions (m,) [N].
          firm: factor on the penalties.
        """
        return replace(problem, system=self._with(tension, firm))

    def tensions(self, problem: StepProblem, p: Positions) -> NDArray[np.float64]:
        """Compute the tensions (m,) [N] at p (n, 3) [m].

        They are zero where an edge is within its limits.
        """
        x, k, rows = self.lengths, self._penalties, len(self._columns)
        length, n = directions(p[x.edges[:, 0]] - p[x.edges[:, 1]], x.rest_direction)
        J = _along(x, n, len(p))[:, self._columns]
        downhill = -problem.gradient(p).ravel()[self._columns]
        tension = k * (length - np.clip(length, x.low, x.high))
        held = self._held(length, tension)
        for _ in range(CHANGES):
            e = np.flatnonzero(held)
            to = np.where(held > 0, x.high, x.low)[e]
            found = _solved(self._Q, J[e], GIVE / k[e], np.concatenate([downhill, to - length[e]]))
            tension = np.zeros(len(k))
            tension[e] = found[rows:]
            before, held = held, self._held(length + J @ found[:rows], tension)
            if np.array_equal(before, held):
                break
        return tension

    def _held(self, length: NDArray[np.float64], tension: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the active limit of each length: 1 the longest, -1 the shortest, 0 none."""
        x, pulled = self.lengths, length + tension / self._penalties
        return np.where((pulled > x.high) | (x.low == x.high), 1, np.where(pulled < x.low, -1, 0))


class Stationarity:
    """Stationarity of the steps of a run, with one evaluator for each system.

    Systems differ where the first step, or every second one, has another rate.
    """

    def __init__(self) -> None:
        self._oracles: dict[float, Oracle] = {}
        self._exact: dict[float, Exact] = {}

    def __call__(self, problem: StepProblem, p: Positions) -> Reading:
        """Evaluate the stationarity at p, of the Lagrangian where lengths are exact."""
        exact = self.exact(problem.system)
        if exact is None:
            return self._oracle(problem.system).stationarity(problem, p)
        stated = exact.lagrangian(problem, exact.tensions(problem, p))
        return self._oracle(exact.augmented).stationarity(stated, p, self.yardstick(problem))

    def yardstick(self, problem: StepProblem) -> float:
        """Compute the initial residual [J^(1/2)], with zero tensions where lengths are exact."""
        exact = self.exact(problem.system)
        if exact is None:
            return self._oracle(problem.system).yardstick(problem)
        return self._oracle(exact.augmented).yardstick(exact.lagrangian(problem, np.zeros(len(exact.lengths.low))))

    def exact(self, system: System) -> Exact | None:
        """Return the exact lengths of a system, None where it has none."""
        if system.lengths and system.rate not in self._exact:
            self._exact[system.rate] = Exact(system)
        return self._exact.get(system.rate)

    def _oracle(self, system: System) -> Oracle:
        if system.rate not in self._oracles:
            self._oracles[system.rate] = Oracle(system)
        return self._oracles[system.rate]


def _along(x: Lengths, n: Positions, vertices: int) -> csr_array:
    """Build the matrix (m, 3 vertices) of n_e . (p_i - p_j) for all edges."""
    A, whole = signed_incidence_matrix_sparse(x.edges, vertices), csr_array((len(n), 3 * vertices))
    for c in range(3):
        whole = csr_array(whole + kron(diags_array(n[:, c]) @ A, np.eye(3)[c : c + 1]))
    return whole


def _solved(Q: csr_array, J: csr_array, gives: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve [Q J'; J 0] x = b by iterative refinement.

    The factor is that of a slightly compliant matrix. The compliance avoids a singular matrix where lengths are
    linearly dependent; refinement removes its effect on the others.
    """
    if not len(gives):
        return np.asarray(splu(Q.tocsc()).solve(right))
    K = block_array([[Q, J.T], [J, None]]).tocsc()
    firm = np.concatenate([np.zeros(Q.shape[0]), -gives])
    factor, x = splu((K + diags_array(firm)).tocsc()), np.zeros_like(right)
    for _ in range(PASSES):
        x += factor.solve(right - K @ x)
    return x
