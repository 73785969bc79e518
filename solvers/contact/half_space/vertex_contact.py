"""Interface of vertex contact to prefactored methods.

Contact acts on single vertices with forces that appear and vanish, and is far stiffer than anything in Q. No constant Q
contains it, so it is not a projective energy. It provides its stiffness as rows instead, which
`springbench.solvers.methods.local_global.half_space_contact` adds to Q in each iteration.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple, Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Energy, LaggedEnergy, Positions, StepProblem, System


class PenaltyRows(NamedTuple):
    """Penalty terms w/2 (direction.x_v + gap)^2 of the displacements x of vertices v (r,).

    Attributes:
        vertices: v (r,).
        direction: unit vectors (r, 3).
        stiffness: w [N/m], (r,).
        gap: [m], (r,); zero where the gradient includes the contact force at p, the distance where there is none at p.
    """

    vertices: NDArray[np.int64]
    direction: Positions
    stiffness: NDArray[np.float64]
    gap: NDArray[np.float64]


@runtime_checkable
class VertexContactEnergy(LaggedEnergy, Protocol):
    """An energy of single vertices, convex and once differentiable."""

    def has_no_active_collisions(self) -> bool:
        """Return whether no vertex can collide in the current step."""
        ...

    def build_penalty_rows(self, p: Positions, trial: Positions, *, majorise: bool) -> PenaltyRows:
        """Return the rows of contacts active at p or between p and `trial`.

        Args:
            p: positions (n, 3) [m].
            trial: trial positions (n, 3) [m].
            majorise: whether the stiffness majorises the energy; it is the exact second derivative otherwise.
        """
        ...


def is_vertex_contact(energy: Energy) -> TypeGuard[VertexContactEnergy]:
    """Return whether an energy is one of vertex contact."""
    return _is_vertex_contact_type(type(energy))


@cache
def _is_vertex_contact_type(kind: type) -> bool:
    return issubclass(kind, VertexContactEnergy)  # takes 30 us, and is called in each step


def begin_active_contacts(problem: StepProblem) -> list[VertexContactEnergy]:
    """Begin the vertex contacts of a step, and return those that are active.

    Other energies are not begun, because they may not be needed.
    """
    begun = [energy.begin_step(problem.step_start) for energy in problem.system.energies if is_vertex_contact(energy)]
    return [energy for energy in begun if is_vertex_contact(energy) and not energy.has_no_active_collisions()]


def without_vertex_contact(system: System) -> System:
    """Return the system without vertex contact; the same object if it has none."""
    remaining = tuple(energy for energy in system.energies if not is_vertex_contact(energy))
    return system if len(remaining) == len(system.energies) else replace(system, energies=remaining)
