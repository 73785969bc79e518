"""A solver that is one formula: the next iterate from the positions, those before them, and Q^-1 grad g.

    p' = formula(p, p_before, Q^-1 grad g(p))

Local-global is p - Q^-1 grad g(p). Q is assembled of the projective energies and factorised by SuperLU.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from solvers.core.driver import Iterating, Iterative
from solvers.core.prefactored import PreparedLocalGlobal, prepared, projective
from solvers.linear.factors import SparseLU
from solvers.problem import Positions, ResidualOf, StepProblem, System


class Formula(ABC):
    """The base of such a solver, a frozen dataclass of its parameters."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = False

    @abstractmethod
    def formula(self, p: Positions, before: Positions, correction: Positions) -> Positions:
        """The next iterate (n, 3) [m] from that of p, of the positions before them, p itself at first, and of
        Q^-1 grad g(p), all (n, 3) [m]; none of these may be written to."""

    def prepare(self, system: System) -> Ready:
        """Raises Unsupported for energies that are not projective, NotPositiveDefinite."""
        name = type(self).__name__
        return Ready(prepared(system, projective(system, name), lambda Q: (SparseLU(Q), "SuperLU")), self.formula)


class Ready(Iterative):
    """The formula over a factor of one system's Q."""

    residual_of: ClassVar[ResidualOf] = "previous"

    def __init__(self, base: PreparedLocalGlobal, formula: Callable[..., Positions]) -> None:
        self.base, self.formula = base, formula
        self.choice, self.facts = base.choice, base.facts

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """See Iterative."""
        return _Running(self, problem, guess)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return self.base.scale(problem)


class _Running(Iterating):
    def __init__(self, ready: Ready, problem: StepProblem, guess: Positions) -> None:
        self._ready, self._problem = ready, problem
        self.positions = self._before = ready.base.placed(guess, problem)
        self._correction = np.full_like(guess, np.nan)

    def advance(self) -> bool:
        """See Iterating."""
        p, base = self.positions, self._ready.base
        self._correction = base.correction(self._problem.gradient(p), np.zeros_like(p))
        self.positions, self._before = self._ready.formula(p, self._before, self._correction), p
        return True

    def residual(self) -> float:
        """|Q^-1 grad g|_Q of the previous iterate."""
        return self._ready.base.residual(self._correction.copy())
