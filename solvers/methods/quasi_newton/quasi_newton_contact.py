"""Vertex contact for accelerated methods, whose corrections use Q + W instead of Q.

W is that of `half_space_contact`. All pairs of a window belong to one W. It is reused while the same vertices are in
contact with about the same stiffness; when that changes, the window restarts with another W. Without active contact the
method is unchanged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.vertex_contact import (
    PenaltyRows,
    VertexContactEnergy,
    begin_active_contacts,
)
from springbench.solvers.kernels import accelerated_descent
from springbench.solvers.methods.local_global.accelerated_local_global import (
    AcceleratedState,
    AccelerationEngine,
    AccelerationScheme,
    InterpretedState,
)
from springbench.solvers.methods.local_global.half_space_contact import ContactCorrections
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal
from springbench.solvers.model.step_problem import Positions, StepProblem
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

_MAX_WEIGHT_RATIO = 2.0
"""Factor up to which contact stiffnesses may differ for W to be reused."""


class ContactEngine:
    """Acceleration engine with vertex contact.

    The engine `contact_free` is used while no contact is active.
    """

    def __init__(
        self,
        scheme: AccelerationScheme,
        objective: FixedObjective,
        base: PreparedLocalGlobal,
        contact_free: AccelerationEngine,
    ) -> None:
        self._scheme, self._base, self._contact_free = scheme, base, contact_free
        self._objective, self._corrections = objective, ContactCorrections(base)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> AcceleratedState:
        """Return the initial state of a step; that of the contact-free engine without active contact.

        Args:
            problem: step with vertex contact.
            initial_guess: positions (n, 3) [m], not modified.
        """
        contacts = begin_active_contacts(problem)
        if not contacts:
            return self._contact_free.init_state(problem, initial_guess)
        step = StepObjective(self._objective, problem)
        return _ContactAcceleration(self._base, self._scheme, step, initial_guess, contacts, self._corrections)


class _ContactAcceleration(InterpretedState):
    def __init__(
        self,
        base: PreparedLocalGlobal,
        scheme: AccelerationScheme,
        step: StepObjective,
        initial_guess: Positions,
        contacts: list[VertexContactEnergy],
        corrections: ContactCorrections,
    ) -> None:
        self._contacts, self._corrections = contacts, corrections
        self._rows: PenaltyRows | None = None
        self._starts_window = True
        super().__init__(base, scheme, step, initial_guess)

    def _solve_trial(self) -> NDArray[np.float64]:
        """Return the correction at the trial point, with the previous rows if they are compatible."""
        super()._solve_trial()
        self._contact_free_correction = -self._trial_correction
        gradient, at = -self._trial_descent, (self._contacts, self._trial_positions)
        x, rows = self._corrections.solve_with_contact(*at, gradient, self._contact_free_correction, majorise=True)
        self._starts_window = self._rows is None or not _are_rows_compatible(self._rows, rows)
        if self._starts_window or self._rows is None:
            self._rows = rows
        else:
            x = self._corrections.solve_with_rows(self._rows, gradient, self._contact_free_correction)
        self._trial_correction[:] = x
        return self._trial_correction.ravel()

    def _accept_trial(self) -> None:
        correction = self._solve_trial()
        (accelerated_descent.init_window if self._starts_window else accelerated_descent.accept_trial)(
            self._window, correction
        )

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the iterate."""
        return self._corrections.residual_norm(self._contact_free_correction)


def _are_rows_compatible(one: PenaltyRows, other: PenaltyRows) -> bool:
    """Return whether the rows of one point can be reused at another.

    Rows with a gap belong to one point alone.
    """
    if not np.array_equal(one.vertices, other.vertices) or one.gap.any() or other.gap.any():
        return False
    return bool(
        (
            np.maximum(one.stiffness, other.stiffness) <= _MAX_WEIGHT_RATIO * np.minimum(one.stiffness, other.stiffness)
        ).all()
    )
