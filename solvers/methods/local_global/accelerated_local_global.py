"""Accelerated first-order methods with any energies and any factor of Q.

Kernels of `springbench.solvers.kernels.accelerated_descent` alternate with the energies' own values and gradients and
with the factor's solve.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.kernels import accelerated_descent, descent_rounds
from springbench.solvers.kernels.accelerated_descent import AccelerationWindow
from springbench.solvers.kernels.iteration_loop import LoopLimits
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal
from springbench.solvers.model.step_problem import Positions, StepProblem
from springbench.solvers.objective.step_objective import StepObjective


@dataclass(frozen=True)
class AccelerationScheme:
    """An acceleration scheme.

    Attributes:
        name: name in the registry.
        coefficient_rule: rule of the coefficients: CHEBYSHEV_RULE, ANDERSON_RULE or LBFGS_RULE.
        history_size: number of pairs in the history.
        max_retries: maximum number of shorter steps along a direction before the plain correction.
        needs_projective: whether energies must be projective.
    """

    name: str
    coefficient_rule: int
    history_size: int
    max_retries: int
    needs_projective: bool


class AcceleratedState(SolverState):
    """The state of a solve with the gradient and the total decrease of the objective."""

    @property
    @abstractmethod
    def objective_decrease(self) -> float:
        """Decrease of the objective so far [J], as far as it exceeds round-off."""

    @abstractmethod
    def gradient(self) -> Positions:
        """Return the gradient of the objective [N], (n, 3), at the iterate."""

    @property
    def kernel_data(self) -> tuple[Any, Any, Any, Any, Any, Any] | None:
        """Data for kernels that iterate further; None if the iterations are not compiled."""
        return None

    @abstractmethod
    def restart_at(self, p: Positions) -> Self:
        """Return a state of the same step that starts at positions p (n, 3) [m].

        This state must not be used again.
        """

    def run_rounds(self, rounds: NDArray[Any], limits: LoopLimits) -> tuple[int, float, int]:
        """Run rounds of iterations.

        Args:
            rounds: state of the rounds (1,) of type ROUND_STATE_DTYPE, updated.
            limits: limits, in rounds.

        Returns:
            Number of rounds, last residual [J^(1/2)] and termination reason.
        """
        return _interpreted_rounds(self, rounds.view(np.recarray), limits)


_interpreted_rounds = descent_rounds.build_rounds(
    lambda state, count: state.run_unchecked(count),
    lambda state, exact_below: state.residual(),
    attrgetter("objective_decrease"),
    lambda state: None,
)


class AccelerationEngine(Protocol):
    """A factory of solves."""

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> AcceleratedState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        ...


def allocate_window(
    scheme: AccelerationScheme, num_entries: int, vector_size: int, precision: Any = np.float64
) -> AccelerationWindow:
    """Allocate the state of an accelerated solve.

    Args:
        scheme: acceleration scheme, which sets the size of the history.
        num_entries: entries of a correction, of a direction and of each vector in the history.
        vector_size: entries of a position or descent vector, of which the first `num_entries` are unknown.
        precision: type of history, correction and direction, that of the factor.

    Returns:
        The window with all vectors zero.
    """
    m = scheme.history_size
    now = np.zeros(1, accelerated_descent.WINDOW_STATE_DTYPE)
    now["coefficient_rule"], now["max_retries"] = scheme.coefficient_rule, scheme.max_retries
    steps, images, correction, direction = (allocate_aligned(k * num_entries, precision) for k in (m, m, 1, 1))
    position, trial, descent, there = (allocate_aligned(vector_size) for _ in range(4))
    sy, wy = np.zeros((2, m, m))
    sg, wg, a, b = np.zeros((4, m))
    block = allocate_aligned(accelerated_descent.CACHE_BLOCK)
    return AccelerationWindow(
        steps, images, position, trial, descent, there, correction, direction, block, sy, wy, sg, wg, a, b, now
    )


_init_window, _propose_trial, _assess_trial, _accept_trial = (
    TypedKernel(accelerated_descent.init_window),
    TypedKernel(accelerated_descent.propose_trial),
    TypedKernel(accelerated_descent.assess_trial),
    TypedKernel(accelerated_descent.accept_trial),
)
"""The kernels of `InterpretedState`, whose windows are in float64."""


class InterpretedState(AcceleratedState):
    """A solve with any energies and any factor."""

    def __init__(
        self, base: PreparedLocalGlobal, scheme: AccelerationScheme, objective: StepObjective, guess: Positions
    ) -> None:
        window = allocate_window(scheme, guess.size, guess.size)
        self._base, self._scheme, self._window, self._objective = base, scheme, window, objective
        self.positions, self._trial_positions, self._trial_descent = (
            x.reshape(-1, 3) for x in (window.position, window.trial_position, window.trial_descent)
        )
        self._trial_correction = np.zeros_like(self._trial_positions)
        self._trial_positions[:] = objective.apply_exact_pins(guess)
        self._evaluate_trial()
        _init_window.call(window, self._solve_trial())

    def restart_at(self, p: Positions) -> Self:
        """Return a state of the same step that starts at positions p (n, 3) [m]."""
        return type(self)(self._base, self._scheme, self._objective, p)

    def step_state(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        window, now = self._window, self._window.window_state
        _propose_trial.call(window)
        verdict = accelerated_descent.TRIAL_AGAIN
        while verdict == accelerated_descent.TRIAL_AGAIN:
            if not self._shorten_trial():
                return False
            self._evaluate_trial()
            now["objective_change"], now["roundoff"] = self._objective.objective_change(
                self.positions, self._trial_positions
            )
            verdict = _assess_trial.call(window)
        if verdict == accelerated_descent.TRIAL_STALLED:
            return False
        self._accept_trial()
        return True

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self._base.correction_residual(self._window.correction.reshape(-1, 3).copy())

    @property
    def objective_decrease(self) -> float:
        """Decrease of the objective so far [J]."""
        return float(self._window.window_state["objective_decrease"][0])

    def gradient(self) -> Positions:
        """Return the gradient of the objective [N], (n, 3)."""
        return -self._window.descent.reshape(-1, 3)

    def _shorten_trial(self) -> bool:
        """Shorten the trial to the collision-free step size; return whether that is positive."""
        if self._objective.barrier_energies:
            most = self._objective.max_step_size(self.positions, self._trial_positions - self.positions)
            if most < 1.0:
                accelerated_descent.shorten_trial(self._window, most)
            return most > 0.0
        return True

    def _evaluate_trial(self) -> None:
        np.negative(self._objective.gradient(self._trial_positions), out=self._trial_descent)

    def _solve_trial(self) -> NDArray[np.float64]:
        self._base.solve_correction(self._trial_descent, self._trial_correction)
        return self._trial_correction.ravel()

    def _accept_trial(self) -> None:
        _accept_trial.call(self._window, self._solve_trial())
