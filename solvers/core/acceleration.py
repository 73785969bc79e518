"""Accelerated first-order methods with any energies and any factor of Q.

Kernels of `solvers.kernels.accelerate` alternate with the energies' own values and gradients and with the
factor's solve.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from solvers.core.driver import Iterating
from solvers.core.objective import StepObjective
from solvers.core.prefactored import PreparedLocalGlobal
from solvers.kernels import accelerate
from solvers.kernels.accelerate import Window
from solvers.memory import aligned
from solvers.problem import Positions, StepProblem


@dataclass(frozen=True)
class Scheme:
    """An acceleration scheme.

    Attributes:
        name: name in the registry.
        coefficients: rule of the coefficients, see `acceleration_coefficients`.
        pairs: number of pairs in the history.
        retries: shorter steps along a direction before the plain correction.
        projective: whether energies must be projective.
    """

    name: str
    coefficients: int
    pairs: int
    retries: int
    projective: bool


class Accelerating(Iterating):
    """The state of a solve that also provides the gradient and the total decrease of the objective."""

    @property
    @abstractmethod
    def fallen(self) -> float:
        """Decrease of the objective so far [J], as far as it exceeds round-off."""

    @abstractmethod
    def gradient(self) -> Positions:
        """Return the gradient of the objective [N], (n, 3), at the iterate."""


class Engine(Protocol):
    """A factory of solves."""

    def begin(self, problem: StepProblem, guess: Positions) -> Accelerating:
        """Start a solve from an initial guess (n, 3)."""
        ...


def window_for(scheme: Scheme, entries: int, whole: int, precision: Any = np.float64) -> Window:
    """Allocate vectors of `whole`, of which `entries` are unknown; `precision` is that of the factor."""
    m = scheme.pairs
    now = np.zeros(1, accelerate.NOW)
    now["method"], now["retries"] = scheme.coefficients, scheme.retries
    steps, images, correction, direction = (aligned(k * entries, precision) for k in (m, m, 1, 1))
    position, trial, descent, there = (aligned(whole) for _ in range(4))
    sy, wy = np.zeros((2, m, m))
    sg, wg, a, b = np.zeros((4, m))
    block = aligned(accelerate.BLOCK)
    return Window(
        steps, images, position, trial, descent, there, correction, direction, block, sy, wy, sg, wg, a, b, now
    )


class Interpreted(Accelerating):
    """A solve with any energies and any factor."""

    def __init__(self, base: PreparedLocalGlobal, scheme: Scheme, objective: StepObjective, guess: Positions) -> None:
        window = window_for(scheme, guess.size, guess.size)
        self._base, self._window, self._objective = base, window, objective
        self.positions, self._trial, self._there = (
            x.reshape(-1, 3) for x in (window.position, window.trial, window.descent_there)
        )
        self._image = np.zeros_like(self._trial)
        self._trial[:] = objective.placed(guess)
        self._look()
        accelerate.begin(window, self._solved())

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        window, now = self._window, self._window.now
        accelerate.propose(window)
        verdict = accelerate.AGAIN
        while verdict == accelerate.AGAIN:
            if not self._free():
                return False
            self._look()
            now["rise"], now["noise"] = self._objective.rise(self.positions, self._trial)
            verdict = accelerate.judge(window)
        if verdict == accelerate.STALLED:
            return False
        self._accept()
        return True

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self._base.residual(self._window.correction.reshape(-1, 3).copy())

    @property
    def fallen(self) -> float:
        """Decrease of the objective so far [J]."""
        return float(self._window.now["fallen"][0])

    def gradient(self) -> Positions:
        """Return the gradient of the objective [N], (n, 3)."""
        return -self._window.descent.reshape(-1, 3)

    def _free(self) -> bool:
        """Shorten the trial to the collision-free step size; return whether that is positive."""
        if self._objective.bounded:
            most = self._objective.reach(self.positions, self._trial - self.positions)
            if most < 1.0:
                accelerate.shorten(self._window, most)
            return most > 0.0
        return True

    def _look(self) -> None:
        np.negative(self._objective.gradient(self._trial), out=self._there)

    def _solved(self) -> NDArray[np.float64]:
        self._base.correction(self._there, self._image)
        return self._image.ravel()

    def _accept(self) -> None:
        accelerate.accept(self._window, self._solved())
