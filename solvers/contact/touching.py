"""Interface of vertex contact to prefactored methods.

Contact acts on single vertices with forces that appear and vanish, and is far stiffer than anything in Q. No constant Q
contains it, so that it is no projective energy. It provides its stiffness as rows instead, which
`solvers.contact.local_global` adds to Q in each iteration.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple, Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from solvers.problem import Energy, LaggedEnergy, Positions, StepProblem, System


class ContactRows(NamedTuple):
    """Penalty terms w/2 (direction.x_v + gap)^2 of the displacements x of vertices v (r,).

    Attributes:
        vertices: v (r,).
        direction: unit vectors (r, 3).
        weight: w [N/m], (r,).
        gap: [m], (r,); zero where the gradient includes the contact force at p, the distance where there is none at p.
    """

    vertices: NDArray[np.int64]
    direction: Positions
    weight: NDArray[np.float64]
    gap: NDArray[np.float64]


@runtime_checkable
class ContactEnergy(LaggedEnergy, Protocol):
    """An energy of single vertices, convex and once differentiable."""

    def idle(self) -> bool:
        """Return whether no vertex can collide in the current step."""
        ...

    def rows(self, p: Positions, trial: Positions, *, cautious: bool) -> ContactRows:
        """Return the rows of contacts active at p or between p and `trial`.

        Args:
            p: positions (n, 3) [m].
            trial: trial positions (n, 3) [m].
            cautious: whether the stiffness majorises the energy; it is the exact second derivative otherwise.
        """
        ...


def is_contact(energy: Energy) -> TypeGuard[ContactEnergy]:
    """Return whether an energy is one of vertex contact."""
    return _is_contact(type(energy))


@cache
def _is_contact(kind: type) -> bool:
    return issubclass(kind, ContactEnergy)  # takes 30 us each time, and is asked each step


def touching(problem: StepProblem) -> list[ContactEnergy]:
    """Return the active contacts of a step, begun separately from energies that may not be needed."""
    begun = [energy.begin_step(problem.start) for energy in problem.system.energies if is_contact(energy)]
    return [energy for energy in begun if is_contact(energy) and not energy.idle()]


def without_contact(system: System) -> System:
    """Return the system without vertex contact; the same object if it has none."""
    kept = tuple(energy for energy in system.energies if not is_contact(energy))
    return system if len(kept) == len(system.energies) else replace(system, energies=kept)
