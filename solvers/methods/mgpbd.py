"""XPBD solved globally, in its dual, by conjugate gradients with multigrid (MGPBD: Li et al. 2025).

It begins as XPBD does (`solvers.methods.xpbd`): where the vertices would go without springs, and with no tension. An
iteration linearises all springs at once, solves for the changes of their tensions t, and moves the vertices by them:

    (J W J' + K^-1) dt = C(p) - K^-1 t,    p <- p - W J' dt,   t <- t + dt

with C the springs' lengthening (m,), J its derivative, a row n_e at i and -n_e at j, and W = 1/held the compliance of
the vertices (`solvers.core.vertex_terms`): the paper's formula in forces, lambda = -t dt^2. It is solved for
s = K^-1/2 t instead, which needs no division by a stiffness:

    A ds = b,    A = G o (N N'),    G = I + K^1/2 A_s W A_s' K^1/2,    b = K^1/2 C(p) - s

where A_s is the signed incidence of the springs, N their directions (m, 3) and o the product entry by entry: G is made
once, and a row has an entry for each spring that shares a vertex. |b|^2 is what the tensions of springs are off by, in
joules. A step is halved until |b| falls, as along ds it does (the authors' code halves the way of positions alone).

It does not minimise the step's objective, as XPBD does not: tensions are added up along directions that turn meanwhile.
Its end is the minimiser where springs do not turn, near to it where they turn little, and another than XPBD's.
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
"""Of Gauss-Seidel's method, on random vectors, for components of the near-kernel."""

_NEAR, _MOST = 1e-5, 100
"""The residual that a linear solve ends at, relative to its right-hand side's, and its iterations at most."""

_SHORTEST = 2.0**-30
"""Of a step: a shorter one is round-off."""


@dataclass(frozen=True)
class MultigridXpbd:
    """MGPBD; the first guess is not used, nor is a tolerance; it stops where round-off lets no tension be nearer.

    components: of the near-kernel, each made by sweeps from a random vector; 0 for equal tensions alone. setup: after
    so many iterations prolongations are made anew; they are in each step's first. smoothed: whether they are smoothed.
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
        """Raises ValueError."""
        for name, least in (("components", 0), ("setup", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: should be at least {least}, not {getattr(self, name)}")

    def prepare(self, system: System) -> PreparedMultigridXpbd:
        """Raises Unsupported for energies other than springs, and for vertices without mass that are not pinned."""
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
    """incidence: A_s (m, n); coupling: G (m, m); root: of the stiffnesses (m,); rest_length (m,) [m]; rest_direction
    (m, 3); compliance: 1/held (n,) [m/N]."""

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
        """See Iterative; from where the vertices would go without springs."""
        return Dual(self, vertex_terms.anchors(problem))

    def stretched(self, p: Positions) -> tuple[NDArray[np.float64], Positions]:
        """K^1/2 C(p) (m,) [J^(1/2)], and the springs' directions N (m, 3)."""
        length, unit = directions(self.incidence @ p, self.rest_direction)
        return self.root * (length - self.rest_length), unit

    def matrix(self, unit: Positions) -> csr_array:
        """A (m, m), at directions N (m, 3)."""
        G = self.coupling
        rows = np.repeat(np.arange(len(unit)), np.diff(G.indptr))
        entries = G.data * np.einsum("ij,ij->i", unit[rows], unit[G.indices])
        return csr_array((entries, G.indices, G.indptr), shape=G.shape)

    def prolongation(self, A: csr_array) -> Prolongation:
        """For A and later ones, by the solver's rule."""
        made = self.solver
        if coarsest(A):
            return Prolongation(A, np.empty((A.shape[0], 0)))
        if made.components:
            return Prolongation(A, near_kernel(A, made.components, _SWEEPS), made.smoothed)
        equal = np.divide(1.0, self.root, out=np.zeros_like(self.root), where=self.root > 0.0)
        return Prolongation(A, scaled(equal[:, None]), made.smoothed)


class Dual(Iterating):
    """A solve that has begun. tension: s = K^-1/2 t (m,) [J^(1/2)]; misfit: b, what it is off by (m,); iterations: of
    conjugate gradients in the last iteration."""

    def __init__(self, prepared: PreparedMultigridXpbd, p: Positions) -> None:
        self._prepared, self.positions, self.iterations, self._count = prepared, p, 0, 0
        self.tension = np.zeros_like(prepared.root)
        self.misfit, self._unit = prepared.stretched(p)

    def advance(self) -> bool:
        """See Iterating: all springs at once."""
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
