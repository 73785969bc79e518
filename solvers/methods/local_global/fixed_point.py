"""A solver defined by one formula for the next iterate.

    p' = next_iterate(p, p_before, Q^-1 grad g(p))

Local-global is p - Q^-1 grad g(p). Q is assembled from the projective energies and factorised by SuperLU.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.linalg.direct_solvers import SparseLU
from springbench.solvers.methods.local_global.prefactored import (
    PreparedLocalGlobal,
    prepare_local_global,
    require_projective,
)
from springbench.solvers.model.step_problem import PluginContractError, Positions, ResidualIterate, StepProblem, System


class FixedPointSolver(ABC):
    """The base of a solver that is defined by one formula.

    A subclass is a frozen dataclass of its parameters.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Damped(springbench.FixedPointSolver):
        ...     share: float = 0.5
        ...     def next_iterate(self, p, before, correction):
        ...         return p - self.share * correction

        >>> Damped(0.75)
        Damped(share=0.75)
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = False

    @abstractmethod
    def next_iterate(self, p: Positions, before: Positions, correction: Positions) -> Positions:
        """Return the next iterate (n, 3) [m].

        No argument may be modified.

        Args:
            p: current positions (n, 3) [m].
            before: positions of the previous iterate (n, 3) [m]; p itself in the first iteration.
            correction: Q^-1 grad g(p) (n, 3) [m].
        """

    def prepare(self, system: System) -> PreparedFixedPoint:
        """Prepare the solver for a system.

        Raises:
            Unsupported: if an energy is not projective.
            NotPositiveDefinite: if the system leaves some positions undetermined.
            PluginContractError: if `next_iterate` does not take three arguments.
        """
        name = type(self).__name__
        try:
            inspect.signature(self.next_iterate).bind(None, None, None)
        except TypeError:
            raise PluginContractError(
                f"{describe_source_line(self.next_iterate)}: `next_iterate` should take p, before and correction"
            ) from None
        return PreparedFixedPoint(
            prepare_local_global(system, require_projective(system, name), lambda Q: (SparseLU(Q), "SuperLU")),
            self.next_iterate,
        )


class PreparedFixedPoint(IterativeSolver):
    """The formula with a factor of one system's Q."""

    residual_iterate: ClassVar[ResidualIterate] = "previous"

    def __init__(self, base: PreparedLocalGlobal, formula: Callable[..., Positions]) -> None:
        self.base, self.next_iterate = base, formula
        self.description, self.stats = base.description, base.stats

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return _FixedPointState(self, problem, initial_guess)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return self.base.residual_scale(problem)


class _FixedPointState(SolverState):
    def __init__(self, ready: PreparedFixedPoint, problem: StepProblem, guess: Positions) -> None:
        self._ready, self._problem = ready, problem
        self.positions = self._previous_positions = vertex_terms.apply_exact_pins(guess, problem)
        self._correction = np.full_like(guess, np.nan)

    def step_state(self) -> bool:
        """Do one iteration; return True."""
        p, base = self.positions, self._ready.base
        self._correction = base.solve_correction(self._problem.gradient(p), np.zeros_like(p))
        self.positions, self._previous_positions = (
            self._check_iterate(self._ready.next_iterate(p, self._previous_positions, self._correction)),
            p,
        )
        return True

    def _check_iterate(self, found: Any) -> Positions:
        expected = self._correction.shape
        if isinstance(found, np.ndarray) and found.shape == expected and found.dtype == np.float64:
            return found
        got = f"{found.dtype} of shape {found.shape}" if isinstance(found, np.ndarray) else f"a {type(found).__name__}"
        line = describe_source_line(self._ready.next_iterate)
        raise PluginContractError(f"{line}: `next_iterate` gave {got}; expected float64 of shape {expected}")

    def residual(self) -> float:
        """Return |Q^-1 grad g|_Q of the previous iterate."""
        return self._ready.base.correction_residual(self._correction.copy())


def describe_source_line(function: Callable[..., Any]) -> str:
    """Return `file:line` of the definition of a function.

    For a function that is not written in Python, it is the name.
    """
    code = getattr(function, "__code__", None)
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else getattr(function, "__qualname__", "")
