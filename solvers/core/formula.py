"""A solver defined by one formula for the next iterate.

    p' = formula(p, p_before, Q^-1 grad g(p))

Local-global is p - Q^-1 grad g(p). Q is assembled from the projective energies and factorised by SuperLU.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from solvers.core.driver import Iterating, Iterative
from solvers.core.prefactored import PreparedLocalGlobal, prepared, projective
from solvers.linear.factors import SparseLU
from solvers.problem import Positions, ResidualOf, StepProblem, System, WrongAnswer


class Formula(ABC):
    """The base of such a solver, a frozen dataclass of its parameters."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = False

    @abstractmethod
    def formula(self, p: Positions, before: Positions, correction: Positions) -> Positions:
        """Return the next iterate (n, 3) [m].

        No argument may be modified.

        Args:
            p: current positions (n, 3) [m].
            before: positions of the previous iterate (n, 3) [m]; p itself in the first iteration.
            correction: Q^-1 grad g(p) (n, 3) [m].
        """

    def prepare(self, system: System) -> Ready:
        """Return the prepared solver; raise Unsupported for other than projective energies, or NotPositiveDefinite."""
        name = type(self).__name__
        try:
            inspect.signature(self.formula).bind(None, None, None)
        except TypeError:
            raise WrongAnswer(f"{line_of(self.formula)}: `formula` should take p, before and correction") from None
        return Ready(prepared(system, projective(system, name), lambda Q: (SparseLU(Q), "SuperLU")), self.formula)


class Ready(Iterative):
    """The formula with a factor of one system's Q."""

    residual_of: ClassVar[ResidualOf] = "previous"

    def __init__(self, base: PreparedLocalGlobal, formula: Callable[..., Positions]) -> None:
        self.base, self.formula = base, formula
        self.choice, self.facts = base.choice, base.facts

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return _Running(self, problem, guess)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return self.base.scale(problem)


class _Running(Iterating):
    def __init__(self, ready: Ready, problem: StepProblem, guess: Positions) -> None:
        self._ready, self._problem = ready, problem
        self.positions = self._before = ready.base.placed(guess, problem)
        self._correction = np.full_like(guess, np.nan)

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        p, base = self.positions, self._ready.base
        self._correction = base.correction(self._problem.gradient(p), np.zeros_like(p))
        self.positions, self._before = self._checked(self._ready.formula(p, self._before, self._correction)), p
        return True

    def _checked(self, found: Any) -> Positions:
        wanted = self._correction.shape
        if isinstance(found, np.ndarray) and found.shape == wanted and found.dtype == np.float64:
            return found
        came = f"{found.dtype} of shape {found.shape}" if isinstance(found, np.ndarray) else f"a {type(found).__name__}"
        raise WrongAnswer(f"{line_of(self._ready.formula)}: `formula` gave {came}; wanted float64 of shape {wanted}")

    def residual(self) -> float:
        """Return |Q^-1 grad g|_Q of the previous iterate."""
        return self._ready.base.residual(self._correction.copy())


def line_of(function: Callable[..., Any]) -> str:
    """Return `file:line` of the definition of a function, or its name if it is not written in Python."""
    code = getattr(function, "__code__", None)
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else getattr(function, "__qualname__", "")
