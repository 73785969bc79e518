"""Vertex contact for accelerated methods: corrections use Q + W instead of Q, as in `half_space_contact`.

All pairs of a window belong to one W. W is reused while the same vertices are in contact with about the same stiffness;
when that changes, the window restarts with another W. Without active contact the method is unchanged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from solvers.contact.local_global import Corrections
from solvers.contact.touching import ContactEnergy, ContactRows, touching
from solvers.core.acceleration import Accelerating, Engine, Interpreted, Scheme
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.prefactored import PreparedLocalGlobal
from solvers.kernels import accelerate
from solvers.problem import Positions, StepProblem, System

_ALIKE = 2.0
"""Factor up to which contact stiffnesses may differ for W to be reused."""


class Touching:
    """Acceleration engine with vertex contact; idle: the engine used while no contact is active."""

    def __init__(self, scheme: Scheme, system: System, base: PreparedLocalGlobal, idle: Engine) -> None:
        self._scheme, self._base, self._idle = scheme, base, idle
        self._objective, self._corrections = Objective(system), Corrections(base)

    def begin(self, problem: StepProblem, guess: Positions) -> Accelerating:
        """Return the initial state of a step."""
        contacts = touching(problem)
        if not contacts:
            return self._idle.begin(problem, guess)
        step = StepObjective(self._objective, problem)
        return _Touching(self._base, self._scheme, step, guess, contacts, self._corrections)


class _Touching(Interpreted):
    def __init__(
        self,
        base: PreparedLocalGlobal,
        scheme: Scheme,
        step: StepObjective,
        guess: Positions,
        contacts: list[ContactEnergy],
        corrections: Corrections,
    ) -> None:
        self._contacts, self._corrections = contacts, corrections
        self._rows: ContactRows | None = None
        self._begun = True
        super().__init__(base, scheme, step, guess)

    def _solved(self) -> NDArray[np.float64]:
        """Return the correction at the trial point, with the previous rows if they are compatible."""
        super()._solved()
        self._plain = -self._image
        gradient, at = -self._there, (self._contacts, self._trial)
        x, rows = self._corrections.around(*at, gradient, self._plain, cautious=True)
        self._begun = self._rows is None or not _alike(self._rows, rows)
        if self._begun or self._rows is None:
            self._rows = rows
        else:
            x = self._corrections.displacement(self._rows, gradient, self._plain)
        self._image[:] = x
        return self._image.ravel()

    def _accept(self) -> None:
        correction = self._solved()
        (accelerate.begin if self._begun else accelerate.accept)(self._window, correction)

    def residual(self) -> float:
        """Return the residual of the trial point."""
        return self._corrections.residual(self._plain)


def _alike(one: ContactRows, other: ContactRows) -> bool:
    """Return whether the rows of one point can be reused at another; rows with a gap belong to one point alone."""
    if not np.array_equal(one.vertices, other.vertices) or one.gap.any() or other.gap.any():
        return False
    return bool((np.maximum(one.weight, other.weight) <= _ALIKE * np.minimum(one.weight, other.weight)).all())
