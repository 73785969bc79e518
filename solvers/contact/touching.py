"""The interface of contact to the prefactored methods.

Contact presses on single vertices with forces that come and go, far stiffer than anything in Q. No Q holds it, so it
is no projective energy; it tells its stiffness as rows instead, which `solvers.contact.local_global` adds to Q from
case to case.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple, Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from solvers.problem import Energy, LaggedEnergy, Positions, StepProblem, System


class ContactRows(NamedTuple):
    """Terms w/2 (direction.x_v + gap)^2 of the displacements x of vertices v (r,).

    direction: (r, 3), unit vectors; weight: w (r,) [N/m]; gap (r,) [m]: zero where the contact's force at p is part of
    the gradient, the distance where nothing touches at p.
    """

    vertices: NDArray[np.int64]
    direction: Positions
    weight: NDArray[np.float64]
    gap: NDArray[np.float64]


@runtime_checkable
class ContactEnergy(LaggedEnergy, Protocol):
    """An energy of single vertices, convex and once differentiable."""

    def idle(self) -> bool:
        """Whether nothing can be touched in the step that has begun."""
        ...

    def rows(self, p: Positions, trial: Positions, *, cautious: bool) -> ContactRows:
        """The rows that resist a displacement from p to `trial`, both (n, 3) [m]: contacts that press at p, and those
        that begin to press on the way.

        Their stiffness is the energy's exact second derivative; where `cautious`, a larger one that majorises the
        energy.
        """
        ...


def is_contact(energy: Energy) -> TypeGuard[ContactEnergy]:
    """Whether an energy is one of contact."""
    return _is_contact(type(energy))


@cache
def _is_contact(kind: type) -> bool:
    return issubclass(kind, ContactEnergy)  # takes 30 us each time, and is asked each step


def touching(problem: StepProblem) -> list[ContactEnergy]:
    """The step's contacts, less those that are idle; begun apart from the other energies, which may not be needed."""
    begun = [energy.begin_step(problem.start) for energy in problem.system.energies if is_contact(energy)]
    return [energy for energy in begun if is_contact(energy) and not energy.idle()]


def without_contact(system: System) -> System:
    """The same system without contact; itself where it has none."""
    kept = tuple(energy for energy in system.energies if not is_contact(energy))
    return system if len(kept) == len(system.energies) else replace(system, energies=kept)
