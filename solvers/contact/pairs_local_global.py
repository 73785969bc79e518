"""Contact by pairs for the local-global methods: a change W of Q, and Q stays factorised.

    p <- p + t x,   x = -(Q + W)^-1 grad g(p),   W = the barriers' and their friction's second derivatives at p, clamped

Q is not less than all other second derivatives, so that x is Newton's step for a majorant of the model at p. It is
found by conjugate gradients that Q^-1 preconditions, as a few numbers of Q^-1 W are large: no more than there are pairs
(a few iterations descend wherever they are stopped). A barrier has no constant majorant: t is the first of 1, 1/2, ...
that is no longer than is safe, and descends enough. Ly, Jouve, Boissieux and Bertails-Descoubes (2020, "Projective
dynamics with dry frictional contact") put contact into the local step instead, vertex by vertex, and let it be violated
until that has converged; here no iterate may be.

While nothing is in range an iteration is that of the method without contact, to the bit; the way to it is looked at.
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
"""Of conjugate gradients."""


def local_global(solver: Solver, system: System) -> PreparedPairs:
    """A local-global method with contact by pairs; raises what the solver raises for the system without it, and
    Unsupported beside contact of single vertices."""
    if without_contact(system) is not system:
        raise Unsupported(
            "local-global: contact of single vertices (Contact) is no part of W beside barriers of pairs; state "
            "surface-contact"
        )
    idle: Any = solver.prepare(without_bounded(system))
    base = idle if isinstance(idle, PreparedLocalGlobal) else idle.base
    return PreparedPairs(replace(base, system=system), idle, Objective(system), Corrections(base))


@dataclass(frozen=True, eq=False)
class PreparedPairs(PreparedContact):
    """Local-global iterations with contact by pairs."""

    @property
    def choice(self) -> str:
        """The linear solver in words."""
        return f"{self.idle.choice}; where pairs touch, by conjugate gradients"

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """See Iterative."""
        return _Iterating(self, problem, guess)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """None: an iteration has no parts that stand alone."""
        return {}

    def gauge(self, problem: StepProblem) -> Callable[[Positions], float]:
        """See Iterative."""
        step = StepObjective(self.objective, problem)
        return lambda p: self.corrections.residual(self.corrections.plain(step.gradient(p)))


class _Iterating(Iterating):
    """Each position is no higher than the one before, and the way to it is free. far: the method without contact, while
    it goes on from here."""

    def __init__(self, prepared: PreparedPairs, problem: StepProblem, guess: Positions) -> None:
        self._prepared, self._problem = prepared, problem
        self._step = StepObjective(prepared.objective, problem)
        self.positions = self._step.placed(guess)
        self._far: Iterating | None = None
        self._residual: Callable[[], float] = lambda: float("nan")

    def advance(self) -> bool:
        """See Iterating."""
        blocks = self._blocks(self.positions)
        return self._near(blocks) if blocks else self._alone()

    def residual(self) -> float:
        """That of the previous positions."""
        return self._residual()

    def _blocks(self, p: Positions) -> list[PairBlocks]:
        """What is in range at p."""
        found = (energy.blocks(p, 0.0) for energy in self._step.bounded)
        return [blocks for blocks in found if len(blocks.vertices)]

    def _alone(self) -> bool:
        """An iteration without contact, as far as its way is free."""
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
        """An iteration over Q + W."""
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
    """W (3n, 3n); what does not move has no part in it."""
    at: NDArray[np.int64] = np.concatenate([one.vertices for one in blocks])
    values = np.concatenate([one.values for one in blocks])
    rows = (3 * at[:, :, None] + np.arange(3)).reshape(len(at), -1)
    i, j = np.repeat(rows, rows.shape[1], axis=1).ravel(), np.tile(rows, rows.shape[1]).ravel()
    own = (i >= 0) & (j >= 0)
    return csr_array(coo_array((values.ravel()[own], (i[own], j[own])), shape=(3 * n, 3 * n)))
