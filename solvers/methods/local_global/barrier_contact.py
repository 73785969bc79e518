"""Barrier contact for local-global methods.

The barrier Hessian is a change W of Q, which stays factorised:

    p <- p + t x,   x = -(Q + W)^-1 grad g(p),   W = the Hessian of barriers and their friction at p, clamped

Q is not less than all other second derivatives, so that x is Newton's step for a majorant of the model at p. The system
is solved by conjugate gradients preconditioned by Q^-1. Only as many eigenvalues of Q^-1 W are large as there are
pairs, and each iterate is a descent direction. A barrier has no constant majorant. The step size t is therefore the
first of 1, 1/2, ... that is collision-free and gives sufficient decrease. Ly, Jouve, Boissieux and Bertails-Descoubes
(2020, "Projective dynamics with dry frictional contact") treat contact in the local step instead, vertex by vertex, and
allow violations until that has converged. Here every iterate is intersection-free.

While no pair is active, an iteration is bitwise identical to that of the method without contact; CCD checks its step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.descent_method import DescentPoint, backtracking_line_search
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.methods.local_global.half_space_contact import (
    ContactCorrections,
    ContactFreeSolver,
    ContactQuadraticModel,
    PreparedHalfSpaceLocalGlobal,
    find_prefactored,
)
from springbench.solvers.model.barrier_energy import PairBlocks, without_barriers
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solver, StepProblem, System, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

_MAX_CG_ITERATIONS = 60
"""Maximum number of conjugate gradient iterations."""


def prepare_with_barriers(solver: Solver, system: System) -> PreparedSolver:
    """Prepare a local-global method with barrier contact.

    Args:
        solver: the method without contact.
        system: the system, with barriers.

    Raises:
        Unsupported: if the system also has vertex contact, or if the solver does not support it without contact.
    """
    if without_vertex_contact(system) is not system:
        raise Unsupported(
            "local-global: vertex contact (HalfSpaceContact) and barrier contact of pairs are not supported together; "
            "use surface-contact"
        )
    idle = cast("ContactFreeSolver", solver.prepare(without_barriers(system)))
    base = find_prefactored(idle)
    found = PreparedBarrierLocalGlobal(
        replace(base, system=system), idle, FixedObjective(system), ContactCorrections(base)
    )
    return skip_idle_contact(found, system, lambda: idle)


@dataclass(frozen=True, eq=False)
class PreparedBarrierLocalGlobal(PreparedHalfSpaceLocalGlobal):
    """Local-global iterations with barrier contact."""

    @property
    def description(self) -> str:
        """Description of the linear solver."""
        return f"{self.contact_free.description}; where pairs touch, by conjugate gradients"

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Return the initial state of the iteration of a step.

        Args:
            problem: step with barrier energies.
            initial_guess: positions without intersections (n, 3) [m], not modified.
        """
        return _BarrierState(self, problem, initial_guess)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return no phases: those of an iteration are not separable."""
        return {}

    def build_residual(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return the function that computes the residual of positions."""
        step = StepObjective(self.fixed_objective, problem)
        return lambda p: self.corrections.residual_norm(self.corrections.solve_without_contact(step.gradient(p)))


class _BarrierState(SolverState):
    """Iteration state; each step is collision-free and does not increase the objective.

    The state of the method without contact is reused as long as its iterates are accepted.
    """

    def __init__(self, prepared: PreparedBarrierLocalGlobal, problem: StepProblem, initial_guess: Positions) -> None:
        self._prepared, self._problem = prepared, problem
        self._step = StepObjective(prepared.fixed_objective, problem)
        self.positions = self._step.apply_exact_pins(initial_guess)
        self._contact_free_state: SolverState | None = None
        self._residual: Callable[[], float] = lambda: float("nan")

    def step_state(self) -> bool:
        """Perform one iteration."""
        blocks = self._step.compute_active_blocks(self.positions)
        return self._step_with_contact(blocks) if blocks else self._step_without_contact()

    def residual(self) -> float:
        """Return the residual of the previous positions."""
        return self._residual()

    def _step_without_contact(self) -> bool:
        """Perform an iteration without contact, as far as its step is collision-free."""
        if self._contact_free_state is None:
            self._contact_free_state = self._prepared.contact_free.init_state(self._problem, self.positions)
        far, p = self._contact_free_state, self.positions
        self._residual, moved = far.residual, far.step_state()
        q = far.positions.copy()
        if self._step.max_step_size(p, q - p) == 1.0 and not self._step.compute_active_blocks(q):
            self.positions = q
            return moved
        self._contact_free_state = None
        return self._line_search(DescentPoint(p, self._step.gradient(p)), q - p)

    def _step_with_contact(self, blocks: list[PairBlocks]) -> bool:
        """Perform an iteration with Q + W."""
        self._contact_free_state, corrections, p = None, self._prepared.corrections, self.positions
        at = DescentPoint(p, self._step.gradient(p))
        plain = corrections.solve_without_contact(at.gradient)
        self._residual = lambda: corrections.residual_norm(plain)
        model = ContactQuadraticModel(
            corrections.solve_without_contact, _assemble_contact_matrix(blocks, len(p)), -at.gradient
        )
        model.run_iterations(model.residual_product, _MAX_CG_ITERATIONS)
        return self._line_search(at, model.x) or self._line_search(at, -plain)

    def _line_search(self, at: DescentPoint, direction: Positions) -> bool:
        found = backtracking_line_search(self._step, at, direction)
        self.positions = found.positions if found else at.positions
        return found is not None


def _assemble_contact_matrix(blocks: list[PairBlocks], n: int) -> csr_array:
    """Return W (3n, 3n), without vertices that do not move."""
    at: NDArray[np.int64] = np.concatenate([one.vertices for one in blocks])
    values = np.concatenate([one.values for one in blocks])
    rows = (3 * at[:, :, None] + np.arange(3)).reshape(len(at), -1)
    i, j = np.repeat(rows, rows.shape[1], axis=1).ravel(), np.tile(rows, rows.shape[1]).ravel()
    own = (i >= 0) & (j >= 0)
    return csr_array(coo_array((values.ravel()[own], (i[own], j[own])), shape=(3 * n, 3 * n)))
