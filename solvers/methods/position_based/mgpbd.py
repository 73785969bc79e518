"""XPBD with a global dual solve by multigrid-preconditioned conjugate gradients (MGPBD: Li et al. 2025).

It starts as XPBD does (`springbench.solvers.methods.position_based.xpbd`): at the positions without springs, with zero
tensions. An iteration linearises all springs, solves for the increments of their tensions t, and moves the vertices
accordingly:

    (J W J' + K^-1) dt = C(p) - K^-1 t,    p <- p - W J' dt,   t <- t + dt

with C the elongations of the springs (m,), J its derivative, a row n_e at i and -n_e at j, and W = 1/q the compliance
of the vertices (`springbench.solvers.iteration.vertex_terms`). This is the paper's formula in terms of forces,
lambda = -t dt^2. It is solved for s = K^-1/2 t instead, which avoids a division by a stiffness:

    A ds = b,    A = G o (N N'),    G = I + K^1/2 A_s W A_s' K^1/2,    b = K^1/2 C(p) - s

where A_s is the signed incidence matrix of the springs, N their directions (m, 3) and o the entrywise product. G is
computed once; a row has an entry for each spring that shares a vertex. |b|^2 is the error of the tensions in joules. A
step is halved until |b| decreases, as it does along ds (the authors' code halves the displacement of positions only).

Like XPBD, it does not minimise the objective of the step: tensions are accumulated along directions that change during
the iteration. Its limit is the minimiser if springs do not rotate, close to it if they rotate little, and differs from
the limit of XPBD.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.linalg.multigrid.near_nullspace import (
    PreconditionedSolve,
    ProlongationHierarchy,
    VCycle,
    compute_near_nullspace,
    is_coarsest_level,
    normalise_columns,
    ordered_norm,
)
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.model.energies.edge_energy import unit_directions
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions, ResidualIterate, StepProblem, System
from springbench.solvers.model.system_matrix_assembly import diagonal_matrix, drop_zeros, signed_incidence_matrix_sparse

_NEAR_NULL_SWEEPS = 30
"""Gauss-Seidel sweeps on random vectors that yield near-null-space vectors."""

_CG_RTOL, _MAX_CG_ITERATIONS = 1e-5, 100
"""Relative residual at which a linear solve ends, and the maximum number of its iterations."""

_MIN_STEP_LENGTH = 2.0**-30
"""Shortest step size: a shorter step is round-off."""


@dataclass(frozen=True)
class MultigridXpbd:
    """MGPBD, which stops at round-off of the tensions.

    It uses neither the initial guess nor a tolerance.

    Args:
        near_null_vectors: number of near-null-space vectors, each from sweeps on a random vector; 0 for constant
            tensions only.
        setup_interval: iterations between constructions of the prolongations; each step starts with one.
        smooth_prolongation: whether prolongations are smoothed.
    """

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "position-based",
        Citation(
            "Li, Chunlei and Yu, Peng and Liu, Tiantian and Yu, Siyuan and Xiao, Yuting and Li, Shuai and Hao, Aimin "
            "and Gao, Yang and Zhao, Qinping",
            2025,
            "MGPBD: A Multigrid Accelerated Global XPBD Solver",
            "10.1145/3721238.3730720",
        ),
        formula="(J W Jᵀ + K⁻¹) Δt = C − K⁻¹ t, multigrid CG",
        cost="tens of V-cycles",
    )

    near_null_vectors: int = 6
    setup_interval: int = 20
    smooth_prolongation: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        for name, least in (("near_null_vectors", 0), ("setup_interval", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: should be at least {least}, not {getattr(self, name)}")

    def prepare(self, system: System) -> PreparedMultigridXpbd:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and for unpinned vertices without mass.
        """
        springs, anchor_stiffness = require_only_springs(system, "mgpbd"), vertex_terms.compute_anchor_stiffness(system)
        vertex_terms.require_mass(system, anchor_stiffness, "mgpbd")
        keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])  # self-loops stretch nothing
        incidence, root = (
            signed_incidence_matrix_sparse(springs.edges[keep], len(anchor_stiffness)),
            np.sqrt(springs.stiffness[keep]),
        )
        half = csr_array(diagonal_matrix(root) @ incidence)
        one = csr_array(eye_array(len(keep)))
        coupling = drop_zeros(
            one + csr_array(half @ diagonal_matrix(1.0 / anchor_stiffness)) @ csr_array(half.T)
        )  # rows in order
        return PreparedMultigridXpbd(
            self,
            system,
            incidence,
            coupling,
            root,
            springs.rest_length[keep],
            springs.rest_direction[keep],
            1.0 / anchor_stiffness,
            f"{self.near_null_vectors or 'no'} near-null vectors, conjugate gradients with multigrid",
            {"nnz_system": float(coupling.nnz)},
        )


@dataclass(frozen=True, eq=False)
class PreparedMultigridXpbd(IterativeSolver):
    """MGPBD, prepared for a system.

    Attributes:
        incidence_matrix: A_s (m, n).
        coupling_matrix: G (m, m).
        root_stiffness: square roots of the stiffnesses (m,).
        rest_length: (m,) [m].
        rest_direction: (m, 3).
        vertex_compliance: 1/q (n,) [m/N].
    """

    residual_iterate: ClassVar[ResidualIterate] = "none"

    parameters: MultigridXpbd
    system: System
    incidence_matrix: csr_array
    coupling_matrix: csr_array
    root_stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]
    vertex_compliance: NDArray[np.float64]
    description: str
    stats: dict[str, float] = field(default_factory=dict)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> MgpbdState:
        """Start a solve at the positions that the vertices have without springs.

        Args:
            problem: step whose inertia, forces and pins determine these positions.
            initial_guess: not used.
        """
        return MgpbdState(self, vertex_terms.compute_anchor_positions(problem))

    def scaled_constraints(self, p: Positions) -> tuple[NDArray[np.float64], Positions]:
        """Compute K^1/2 C(p) (m,) [J^(1/2)] and the spring directions N (m, 3)."""
        length, unit = unit_directions(self.incidence_matrix @ p, self.rest_direction)
        return self.root_stiffness * (length - self.rest_length), unit

    def dual_matrix(self, directions: Positions) -> csr_array:
        """Assemble the dual matrix A (m, m) for spring directions N (m, 3)."""
        G = self.coupling_matrix
        rows = np.repeat(np.arange(len(directions)), np.diff(G.indptr))
        entries = G.data * np.einsum("ij,ij->i", directions[rows], directions[G.indices])
        return csr_array((entries, G.indices, G.indptr), shape=G.shape)

    def build_prolongation(self, A: csr_array) -> ProlongationHierarchy:
        """Build the prolongations for A and the dual matrices of the following iterations."""
        made = self.parameters
        if is_coarsest_level(A):
            return ProlongationHierarchy(A, np.empty((A.shape[0], 0)))
        if made.near_null_vectors:
            return ProlongationHierarchy(
                A, compute_near_nullspace(A, made.near_null_vectors, _NEAR_NULL_SWEEPS), made.smooth_prolongation
            )
        equal = np.divide(
            1.0, self.root_stiffness, out=np.zeros_like(self.root_stiffness), where=self.root_stiffness > 0.0
        )
        return ProlongationHierarchy(A, normalise_columns(equal[:, None]), made.smooth_prolongation)


class MgpbdState(SolverState):
    """State of an MGPBD solve.

    Attributes:
        scaled_tension: s = K^-1/2 t (m,) [J^(1/2)].
        dual_residual: b, the error of s (m,) [J^(1/2)].
        num_cg_iterations: conjugate gradient iterations of the most recent iteration.
    """

    def __init__(self, prepared: PreparedMultigridXpbd, p: Positions) -> None:
        self._prepared, self.positions, self.num_cg_iterations, self._num_iterations = prepared, p, 0, 0
        self.scaled_tension = np.zeros_like(prepared.root_stiffness)
        self.dual_residual, self._directions = prepared.scaled_constraints(p)

    def step_state(self) -> bool:
        """Update all springs; return False at round-off."""
        made, before = self._prepared, ordered_norm(self.dual_residual)
        round_off = EPS * ordered_norm(
            np.abs(self.dual_residual + self.scaled_tension) + made.root_stiffness * made.rest_length
        )
        if not round_off < before < np.inf:
            return False
        A = made.dual_matrix(self._directions)
        if self._num_iterations % made.parameters.setup_interval == 0:
            self._prolongation = made.build_prolongation(A)
        solving = PreconditionedSolve(A, VCycle(A, self._prolongation), self.dual_residual, _CG_RTOL)
        self.num_cg_iterations = solving.solve(_MAX_CG_ITERATIONS)
        change = solving.x
        direction = made.vertex_compliance[:, None] * (
            made.incidence_matrix.T @ ((made.root_stiffness * change)[:, None] * self._directions)
        )
        length = 1.0
        while length >= _MIN_STEP_LENGTH:
            p, tension = self.positions - length * direction, self.scaled_tension + length * change
            stretched, unit = made.scaled_constraints(p)
            misfit = stretched - tension
            if ordered_norm(misfit) < before:
                self.positions, self.scaled_tension, self.dual_residual, self._directions = p, tension, misfit, unit
                self._num_iterations += 1
                return True
            length *= 0.5
        return False
