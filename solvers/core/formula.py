"""A solver that is one formula: the next iterate from the positions, those before them, and Q^-1 grad g.

    p' = formula(p, p_before, Q^-1 grad g(p))

Local-global is p - Q^-1 grad g(p). Q is assembled of the projective energies and factorised by SuperLU.
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
        """The next iterate (n, 3) [m] from that of p, of the positions before them, p itself at first, and of
        Q^-1 grad g(p), all (n, 3) [m]; none of these may be written to."""

    def prepare(self, system: System) -> Ready:
        """Raises Unsupported for energies that are not projective, NotPositiveDefinite."""
        name = type(self).__name__
        try:
            inspect.signature(self.formula).bind(None, None, None)
        except TypeError:
            raise WrongAnswer(f"{line_of(self.formula)}: `formula` should take p, before and correction") from None
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
        self.positions, self._before = self._checked(self._ready.formula(p, self._before, self._correction)), p
        return True

    def _checked(self, found: Any) -> Positions:
        wanted = self._correction.shape
        if isinstance(found, np.ndarray) and found.shape == wanted and found.dtype == np.float64:
            return found
        came = f"{found.dtype} of shape {found.shape}" if isinstance(found, np.ndarray) else f"a {type(found).__name__}"
        raise WrongAnswer(f"{line_of(self._ready.formula)}: `formula` gave {came}; wanted float64 of shape {wanted}")

    def residual(self) -> float:
        """|Q^-1 grad g|_Q of the previous iterate."""
        return self._ready.base.residual(self._correction.copy())


def line_of(function: Callable[..., Any]) -> str:
    """`file:line` where a function or a method begins; its name where it is not written in Python."""
    code = getattr(function, "__code__", None)
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else getattr(function, "__qualname__", "")
