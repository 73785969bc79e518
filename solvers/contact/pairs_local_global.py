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
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from solvers.contact.local_global import Corrections, Model, PreparedContact
from solvers.contact.touching import without_contact
from solvers.core.bounds import PairBlocks, without_bounded
from solvers.core.descent import Point, search
from solvers.core.driver import Iterating
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.prefactored import PreparedLocalGlobal
from solvers.problem import Positions, Solver, StepProblem, System, Unsupported

_ITERATIONS = 60
"""Maximum number of conjugate gradient iterations."""


def local_global(solver: Solver, system: System) -> PreparedPairs:
    """Prepare a local-global method with barrier contact.

    Args:
        solver: the method without contact.
        system: the system, with barriers.

    Raises:
        Unsupported: if the system also has vertex contact, or if the solver does not support it without contact.
    """
    if without_contact(system) is not system:
        raise Unsupported(
            "local-global: vertex contact (Contact) and barrier contact of pairs are not supported together; use "
            "surface-contact"
        )
    idle: Any = solver.prepare(without_bounded(system))
    base = idle if isinstance(idle, PreparedLocalGlobal) else idle.base
    return PreparedPairs(replace(base, system=system), idle, Objective(system), Corrections(base))


@dataclass(frozen=True, eq=False)
class PreparedPairs(PreparedContact):
    """Local-global iterations with barrier contact."""

    @property
    def choice(self) -> str:
        """Description of the linear solver."""
        return f"{self.idle.choice}; where pairs touch, by conjugate gradients"

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Return the initial state of the iteration of a step."""
        return _Iterating(self, problem, guess)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return no phases: those of an iteration are not separable."""
        return {}

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Return the function that computes the residual of positions."""
        step = StepObjective(self.objective, problem)
        return lambda p: self.corrections.residual(self.corrections.plain(step.gradient(p)))


class _Iterating(Iterating):
    """Iteration state; each step is collision-free and does not increase the objective.

    The state of the method without contact is reused as long as its iterates are accepted.
    """

    def __init__(self, prepared: PreparedPairs, problem: StepProblem, guess: Positions) -> None:
        self._prepared, self._problem = prepared, problem
        self._step = StepObjective(prepared.objective, problem)
        self.positions = self._step.placed(guess)
        self._far: Iterating | None = None
        self._residual: Callable[[], float] = lambda: float("nan")

    def advance(self) -> bool:
        """Perform one iteration."""
        blocks = self._blocks(self.positions)
        return self._near(blocks) if blocks else self._alone()

    def residual(self) -> float:
        """Return the residual of the previous positions."""
        return self._residual()

    def _blocks(self, p: Positions) -> list[PairBlocks]:
        """Return the Hessian blocks of the pairs active at p."""
        found = (energy.blocks(p, 0.0) for energy in self._step.bounded)
        return [blocks for blocks in found if len(blocks.vertices)]

    def _alone(self) -> bool:
        """Perform an iteration without contact, as far as its step is collision-free."""
        if self._far is None:
            self._far = self._prepared.idle.begin(self._problem, self.positions)
        far, p = self._far, self.positions
        self._residual, moved = far.residual, far.advance()
        q = far.positions.copy()
        if self._step.reach(p, q - p) == 1.0 and not self._blocks(q):
            self.positions = q
            return moved
        self._far = None
        return self._along(Point(p, self._step.gradient(p)), q - p)

    def _near(self, blocks: list[PairBlocks]) -> bool:
        """Perform an iteration with Q + W."""
        self._far, corrections, p = None, self._prepared.corrections, self.positions
        at = Point(p, self._step.gradient(p))
        plain = corrections.plain(at.gradient)
        self._residual = lambda: corrections.residual(plain)
        model = Model(corrections.plain, _matrix(blocks, len(p)), -at.gradient)
        model.iterate(model.product, _ITERATIONS)
        return self._along(at, model.x) or self._along(at, -plain)

    def _along(self, at: Point, direction: Positions) -> bool:
        found = search(self._step, at, direction)
        self.positions = found.positions if found else at.positions
        return found is not None


def _matrix(blocks: list[PairBlocks], n: int) -> csr_array:
    """Return W (3n, 3n), without vertices that do not move."""
    at: NDArray[np.int64] = np.concatenate([one.vertices for one in blocks])
    values = np.concatenate([one.values for one in blocks])
    rows = (3 * at[:, :, None] + np.arange(3)).reshape(len(at), -1)
    i, j = np.repeat(rows, rows.shape[1], axis=1).ravel(), np.tile(rows, rows.shape[1]).ravel()
    own = (i >= 0) & (j >= 0)
    return csr_array(coo_array((values.ravel()[own], (i[own], j[own])), shape=(3 * n, 3 * n)))
