"""Work of contact in a step, separated into that of obstacles and what friction dissipates.

The energy of contact depends on the positions x of the mesh and q of the obstacles. While these move by dx and dq,
the obstacles do the work dE/dq . dq, and friction dissipates df/dx . dx + df/dq . dq, with f the friction part of E.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from springbench.solvers.model.step_problem import Energy, Positions


class ObstacleWork(NamedTuple):
    """Work [J] of moving obstacles in a step by normal and by friction forces."""

    normal_work: float = 0.0
    friction_work: float = 0.0


@runtime_checkable
class ContactEnergy(Energy, Protocol):
    """A contact energy whose friction and moving obstacles are separable."""

    def friction_gradient(self, p: Positions) -> Positions | None:
        """Return the gradient of friction alone [N] at p (n, 3); None where it is zero."""
        ...

    def friction_potential(self, p: Positions) -> float:
        """Return the part of friction in the energy [J] at p (n, 3)."""
        ...

    def obstacle_work(self, p: Positions, start: Positions) -> ObstacleWork:
        """Return the work of the obstacles from the step's start to its stage.

        Args:
            p: positions (n, 3) [m] of the stage, whose forces act.
            start: positions (n, 3) [m] at the step's start.
        """
        ...
