"""Reference evaluator of stationarity: the norm of the gradient and the share due to round-off.

    residual(p)     = |Q^-1 grad g(p)|_Q over the unpinned vertices, so that a heavy pin does not mask the rest
    stationarity(p) = residual(p) / initial,   initial = max(residual(current positions), floor(current positions))

Q is the matrix of the system's projective energies. It is assembled here and factorised by SuperLU, independently of
the solver. Round-off is bounded for each vertex (`springbench.solvers.model.rounding_bound`): a gradient of at most
FACTOR delta_i at vertex i may be round-off only; a larger one is significant, however distant or stiff another part of
the scene is. Hence

    floor(p)  = sqrt(sum_i (FACTOR delta_i)^2 / Q_ii)          bound on the round-off of the residual
    beyond(p) = |Q^-1 (grad g less the part explained by round-off, for each vertex)|_Q / initial

A step is assessed by `stationarity_above_roundoff`: it is 0 where every vertex is in equilibrium to float64 accuracy.

Where Q has more than MAX_DIRECT_NNZ entries, conjugate gradients from zero replace the factor. |x_k|_Q grows towards
|Q^-1 g|_Q (Hestenes and Stiefel 1952), so that the result is a close lower bound. The preconditioner is multigrid,
which affects only the number of iterations, not the limit; about ten are needed on meshes of any size.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, cg, splu
from springbench.solvers.linalg.multigrid.smoothed_aggregation import Multigrid
from springbench.solvers.model.rounding_bound import ROUNDOFF_FACTOR, clip_to_roundoff, gradient_roundoff
from springbench.solvers.model.step_problem import Positions, ProjectiveEnergy, StepProblem, System
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix, energy_norm

MAX_DIRECT_NNZ = 1_500_000
"""Entries of Q up to which its factor takes seconds at most: sheets of some 150,000 vertices, solids of 50,000."""

MULTIGRID_RTOL = 1e-9
"""Tolerance of conjugate gradients relative to the scaled gradient norm |D^-1/2 g|, D the diagonal of Q.

It gives four digits of |Q^-1 g|_Q where a heavy pin contributes nearly all of g, and more elsewhere."""

MAX_CG_ITERATIONS = 500


class StationarityReading(NamedTuple):
    """Stationarity of a point.

    Attributes:
        stationarity: residual relative to the initial residual.
        roundoff_bound: bound on the share of it that is due to round-off.
        above_roundoff: the share that round-off does not explain.
    """

    stationarity: float
    roundoff_bound: float
    above_roundoff: float


class ReferenceEvaluator:
    """Evaluator of the residuals of step problems of one system."""

    def __init__(self, system: System) -> None:
        """Assemble Q; raises NotPositiveDefinite."""
        self._system = system
        self._Q = assemble_stiffness(system)
        self._known: tuple[StepProblem, float] | None = None

    @cached_property
    def _free_matrix(self) -> csr_array:
        free = self._system.free_vertices
        return csr_array(self._Q[free][:, free])

    @cached_property
    def _factor(self) -> Any:
        return factorise_symmetric_lu(self._free_matrix)

    @cached_property
    def _multigrid(self) -> Multigrid:
        return Multigrid(self._free_matrix)

    def _solve(self, right: Positions) -> Positions:
        """Return Q^-1 (f, 3) [m] of a right-hand side (f, 3) [N] of free vertices."""
        Q = self._free_matrix
        if Q.nnz <= MAX_DIRECT_NNZ:
            return self._factor.solve(right)
        half = Q.diagonal()[:, None] ** -0.5
        of_all: Any = {"shape": (right.size, right.size), "dtype": np.dtype(np.float64)}  # columns side by side
        product = LinearOperator(matvec=lambda x: (half * (Q @ (half * x.reshape(-1, 3)))).ravel(), **of_all)
        near = LinearOperator(matvec=lambda r: (self._apply_v_cycle(r.reshape(-1, 3) / half) / half).ravel(), **of_all)
        found, _ = cg(product, (half * right).ravel(), rtol=MULTIGRID_RTOL, maxiter=MAX_CG_ITERATIONS, M=near)
        return half * found.reshape(-1, 3)

    def _apply_v_cycle(self, right: Positions) -> Positions:
        """Apply a V-cycle in float32 to a right-hand side (f, 3)."""
        size = float(np.abs(right).max(initial=0.0)) or 1.0
        self._multigrid.right_hand_side[:, :3] = right / size
        return size * self._multigrid.apply_cycle()[:, :3].astype(np.float64)

    def compute_residual(self, problem: StepProblem, p: Positions) -> float:
        """Compute |Q^-1 grad g(p)|_Q [J^(1/2)] over the unpinned vertices.

        Args:
            problem: step problem of the evaluator's system, with the objective g.
            p: positions (n, 3) [m].

        Returns:
            The residual; infinite on overflow.
        """
        return self.compute_energy_norm(problem.gradient(p))

    def compute_energy_norm(self, gradient: Positions) -> float:
        """Compute |Q^-1 g|_Q [J^(1/2)] of a gradient (n, 3) [N]; infinite on overflow.

        The norm is over the unpinned vertices.
        """
        free, e = self._system.free_vertices, np.zeros_like(gradient)
        if len(free):
            e[free] = self._solve(gradient[free])
        e[self._system.pins.vertices] = 0.0
        with np.errstate(over="ignore", invalid="ignore"):
            length = energy_norm(self._Q, e)
        return length if np.isfinite(length) else np.inf

    def bound_roundoff(self, problem: StepProblem, p: Positions) -> float:
        """Bound the round-off of the residual [J^(1/2)] at p.

        Args:
            problem: step problem of the evaluator's system, whose gradient is rounded.
            p: positions (n, 3) [m].
        """
        return self._bound_roundoff(gradient_roundoff(problem, p))

    def _bound_roundoff(self, bound: NDArray[np.float64]) -> float:
        """Bound the residual's round-off [J^(1/2)] from that of the gradient (n,) [N]."""
        loose = self._system.unpinned_mask
        with np.errstate(over="ignore"):
            return ROUNDOFF_FACTOR * float(np.sqrt(np.sum(bound[loose] ** 2 / self._Q.diagonal()[loose])))

    def compute_initial_residual(self, problem: StepProblem) -> float:
        """Compute the initial residual [J^(1/2)], or its round-off bound if larger."""
        if self._known is None or self._known[0] is not problem:
            floor = max(self.bound_roundoff(problem, problem.current_positions), np.finfo(float).tiny)
            self._known = problem, max(self.compute_residual(problem, problem.current_positions), floor)
        return self._known[1]

    def measure_stationarity(
        self, problem: StepProblem, p: Positions, initial_residual: float | None = None
    ) -> StationarityReading:
        """Measure the stationarity of p.

        Args:
            problem: step problem.
            p: positions (n, 3) [m].
            initial_residual: residual [J^(1/2)] that the result is relative to; that of the problem if omitted.
        """
        initial_residual = self.compute_initial_residual(problem) if initial_residual is None else initial_residual
        gradient, bound = problem.gradient(p), gradient_roundoff(problem, p)
        reached = self.compute_energy_norm(gradient) / initial_residual
        doubtless = gradient - clip_to_roundoff(gradient, ROUNDOFF_FACTOR * bound)
        beyond = min(reached, self.compute_energy_norm(doubtless) / initial_residual)
        return StationarityReading(reached, self._bound_roundoff(bound) / initial_residual, beyond)


def assemble_stiffness(system: System) -> csr_array:
    """Assemble Q (n, n) [N/m] of a system's projective energies; raises NotPositiveDefinite."""
    return assemble_system_matrix(system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)])


def measure_component_sizes(system: System, p: Positions) -> NDArray[np.float64]:
    """Measure the bounding box diagonal (n,) [m] of each vertex's component.

    Args:
        system: system, in whose matrix Q vertices of one component are connected.
        p: positions (n, 3) [m].

    Raises:
        NotPositiveDefinite: Q is not positive definite.
    """
    return measure_graph_components(assemble_stiffness(system), p)


def measure_graph_components(graph: csr_array, p: Positions) -> NDArray[np.float64]:
    """Measure the bounding box diagonal (n,) [m] of each vertex's component of a graph.

    A component without extent is assigned the median size of those that have one, and 1 m where none has.

    Args:
        graph: adjacency matrix (n, n).
        p: positions (n, 3) [m].
    """
    count, label = connected_components(graph, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, label, p)
    np.maximum.at(high, label, p)
    size = np.linalg.norm(high - low, axis=1)
    extended = size[size > 0.0]
    size[size == 0.0] = np.median(extended) if len(extended) else 1.0
    return size[label]


def factorise_symmetric_lu(matrix: csr_array) -> Any:
    """Factorise a symmetric matrix by SuperLU with diagonal pivots; raises RuntimeError for zero ones."""
    settings: Any = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return splu(matrix.tocsc(), **settings)
