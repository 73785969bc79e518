"""XPBD with a global dual solve by multigrid-preconditioned conjugate gradients (MGPBD: Li et al. 2025).

It starts as XPBD does (`solvers.methods.xpbd`): at the positions without springs, with zero tensions. An
iteration linearises all springs, solves for the increments of their tensions t, and moves the vertices accordingly:

    (J W J' + K^-1) dt = C(p) - K^-1 t,    p <- p - W J' dt,   t <- t + dt

with C the elongations of the springs (m,), J its derivative, a row n_e at i and -n_e at j, and W = 1/q the compliance
of the vertices (`solvers.methods.base.vertex_terms`). This is the paper's formula in terms of forces, lambda = -t dt^2.
It is solved for s = K^-1/2 t instead, which avoids a division by a stiffness:

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

from solvers.about import About, Reference
from solvers.core import vertex_terms
from solvers.core.driver import Iterating, Iterative
from solvers.core.prefactored import only_springs
from solvers.energies.edges import directions
from solvers.linear.near_kernel import Cycle, Prolongation, Solving, coarsest, near_kernel, norm, scaled
from solvers.matrices import diagonal, signed_incidence_matrix_sparse, without_zeros
from solvers.problem import Positions, ResidualOf, StepProblem, System
from solvers.round_off import EPS

_SWEEPS = 30
"""Gauss-Seidel sweeps on random vectors that yield near-null-space vectors."""

_NEAR, _MOST = 1e-5, 100
"""Relative residual at which a linear solve ends, and its maximum number of iterations."""

_SHORTEST = 2.0**-30
"""Shortest step size: a shorter step is round-off."""


@dataclass(frozen=True)
class MultigridXpbd:
    """MGPBD; uses neither the initial guess nor a tolerance, and stops at round-off of the tensions.

    Args:
        components: number of near-null-space vectors, each from sweeps on a random vector; 0 for constant
            tensions only.
        setup: iterations between constructions of the prolongations; each step starts with one.
        smoothed: whether prolongations are smoothed.
    """

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    about: ClassVar[About] = About(
        "position-based",
        Reference(
            "Li, Chunlei and Yu, Peng and Liu, Tiantian and Yu, Siyuan and Xiao, Yuting and Li, Shuai and Hao, Aimin "
            "and Gao, Yang and Zhao, Qinping",
            2025,
            "MGPBD: A Multigrid Accelerated Global XPBD Solver",
            "10.1145/3721238.3730720",
        ),
    )

    components: int = 6
    setup: int = 20
    smoothed: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        for name, least in (("components", 0), ("setup", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: should be at least {least}, not {getattr(self, name)}")

    def prepare(self, system: System) -> PreparedMultigridXpbd:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and for unpinned vertices without mass.
        """
        springs, held = only_springs(system, "mgpbd"), vertex_terms.held(system)
        vertex_terms.require_mass(system, held, "mgpbd")
        keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])  # self-loops stretch nothing
        incidence, root = (
            signed_incidence_matrix_sparse(springs.edges[keep], len(held)),
            np.sqrt(springs.stiffness[keep]),
        )
        half = csr_array(diagonal(root) @ incidence)
        one = csr_array(eye_array(len(keep)))
        coupling = without_zeros(one + csr_array(half @ diagonal(1.0 / held)) @ csr_array(half.T))  # rows in order
        return PreparedMultigridXpbd(
            self,
            system,
            incidence,
            coupling,
            root,
            springs.rest_length[keep],
            springs.rest_direction[keep],
            1.0 / held,
            f"{self.components or 'no'} components of the near-kernel, conjugate gradients with multigrid",
            {"nnz_system": float(coupling.nnz)},
        )


@dataclass(frozen=True, eq=False)
class PreparedMultigridXpbd(Iterative):
    """MGPBD, prepared for a system.

    Attributes:
        incidence: A_s (m, n).
        coupling: G (m, m).
        root: square roots of the stiffnesses (m,).
        rest_length: (m,) [m].
        rest_direction: (m, 3).
        compliance: 1/q (n,) [m/N].
    """

    residual_of: ClassVar[ResidualOf] = "none"

    solver: MultigridXpbd
    system: System
    incidence: csr_array
    coupling: csr_array
    root: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]
    compliance: NDArray[np.float64]
    choice: str
    facts: dict[str, float] = field(default_factory=dict)

    def begin(self, problem: StepProblem, guess: Positions) -> Dual:
        """Start a solve at the positions that the vertices have without springs."""
        return Dual(self, vertex_terms.anchors(problem))

    def stretched(self, p: Positions) -> tuple[NDArray[np.float64], Positions]:
        """Compute K^1/2 C(p) (m,) [J^(1/2)] and the spring directions N (m, 3) at positions p (n, 3)."""
        length, unit = directions(self.incidence @ p, self.rest_direction)
        return self.root * (length - self.rest_length), unit

    def matrix(self, unit: Positions) -> csr_array:
        """Assemble the dual matrix A (m, m) for spring directions N (m, 3)."""
        G = self.coupling
        rows = np.repeat(np.arange(len(unit)), np.diff(G.indptr))
        entries = G.data * np.einsum("ij,ij->i", unit[rows], unit[G.indices])
        return csr_array((entries, G.indices, G.indptr), shape=G.shape)

    def prolongation(self, A: csr_array) -> Prolongation:
        """Build the prolongation for A and its successors by the rule of the solver."""
        made = self.solver
        if coarsest(A):
            return Prolongation(A, np.empty((A.shape[0], 0)))
        if made.components:
            return Prolongation(A, near_kernel(A, made.components, _SWEEPS), made.smoothed)
        equal = np.divide(1.0, self.root, out=np.zeros_like(self.root), where=self.root > 0.0)
        return Prolongation(A, scaled(equal[:, None]), made.smoothed)


class Dual(Iterating):
    """State of an MGPBD solve.

    Attributes:
        tension: s = K^-1/2 t (m,) [J^(1/2)].
        misfit: b, the error of s (m,).
        iterations: conjugate gradient iterations of the most recent iteration.
    """

    def __init__(self, prepared: PreparedMultigridXpbd, p: Positions) -> None:
        self._prepared, self.positions, self.iterations, self._count = prepared, p, 0, 0
        self.tension = np.zeros_like(prepared.root)
        self.misfit, self._unit = prepared.stretched(p)

    def advance(self) -> bool:
        """Update all springs; return False at round-off."""
        made, before = self._prepared, norm(self.misfit)
        round_off = EPS * norm(np.abs(self.misfit + self.tension) + made.root * made.rest_length)
        if not round_off < before < np.inf:
            return False
        A = made.matrix(self._unit)
        if self._count % made.solver.setup == 0:
            self._prolongation = made.prolongation(A)
        solving = Solving(A, Cycle(A, self._prolongation), self.misfit, _NEAR)
        self.iterations = solving.solve(_MOST)
        change = solving.x
        way = made.compliance[:, None] * (made.incidence.T @ ((made.root * change)[:, None] * self._unit))
        length = 1.0
        while length >= _SHORTEST:
            p, tension = self.positions - length * way, self.tension + length * change
            stretched, unit = made.stretched(p)
            misfit = stretched - tension
            if norm(misfit) < before:
                self.positions, self.tension, self.misfit, self._unit = p, tension, misfit, unit
                self._count += 1
                return True
            length *= 0.5
        return False
