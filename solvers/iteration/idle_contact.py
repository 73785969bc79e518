"""Solves without contact while nothing is near.

A step with barrier energies is first solved by the method without them, with the same kernels as in a scene without
contact. Its solution q is one of the step with contact too if barriers vanish at q and the straight path from the
initial guess to q is free of collisions: there the gradient and the Hessian of barriers vanish as well. One certificate
per step replaces those of all iterates. Otherwise, and if a barrier acts at the initial guess, the method with contact
solves the step from the initial guess.

The k-th iterate is that of the method without contact where its certificate is valid, else that of the method with
contact. It depends on the problem alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

import numpy as np
from springbench.solvers.contact.lagged_friction import evaluates_friction
from springbench.solvers.model.barrier_energy import BarrierEnergy, is_barrier_energy, max_step_size, without_barriers
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solution, StepProblem, StopRule, System


class ResidualSolver(PreparedSolver, Protocol):
    """A prepared method that also builds residual functions."""

    def build_residual(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Build a function that returns `residual_at` for many positions of one step."""
        ...


@dataclass(frozen=True, eq=False)
class IdleContactSolver:
    """A method with barrier energies, prepared, that ignores them where they are certified to vanish.

    Attributes:
        with_contact: the method.
        contact_free: the method without barrier energies; accepts the same problems.
    """

    with_contact: ResidualSolver
    contact_free: PreparedSolver

    @property
    def description(self) -> str:
        """Description of the method with contact."""
        return self.with_contact.description

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the setup."""
        return self.with_contact.stats

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """Yield the iterates; the next one may overwrite a yielded array."""
        certificate, touching = _Certificate(problem), None
        if not certificate.can_be_idle():
            yield from self.with_contact.iterates(problem)
        for count, p in enumerate(self.contact_free.iterates(problem)):
            is_idle = certificate.is_idle_at(p)
            if touching is None and not is_idle:
                touching = islice(self.with_contact.iterates(problem), count, None)
            following = next(touching) if touching else p
            yield p if is_idle else following

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until `stop` terminates the solve.

        Contact is ignored if it is certified to make no difference.

        Args:
            problem: the step, with barrier energies.
            stop: the criteria that terminate the solve.
        """
        certificate = _Certificate(problem)
        if certificate.can_be_idle():
            found = self.contact_free.solve(problem, stop)
            if certificate.is_idle_at(found.positions):
                return found
        return self.with_contact.solve(problem, stop)

    @property
    def has_own_friction(self) -> bool:
        """Whether the method with contact evaluates friction itself, so that no normal forces are lagged."""
        return evaluates_friction(self.with_contact)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] at given positions, with contact.

        Args:
            problem: the step, with barrier energies.
            p: positions (n, 3) [m].
        """
        return self.with_contact.residual_at(problem, p)

    def build_residual(self, problem: StepProblem) -> Callable[[Positions], float]:
        """Build a function that returns `residual_at` for many positions of one step."""
        return self.with_contact.build_residual(problem)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration with contact."""
        return self.with_contact.iteration_phases(problem)


def skip_idle_contact(
    with_contact: ResidualSolver, system: System, prepare_contact_free: Callable[[], PreparedSolver]
) -> PreparedSolver:
    """Return the method that ignores barrier energies where they vanish.

    For a system without barrier energies it is the given method.

    Args:
        with_contact: the method, prepared for the system.
        system: the system.
        prepare_contact_free: returns the method without barrier energies, which accepts the same problems.
    """
    if without_barriers(system) is system:
        return with_contact
    return IdleContactSolver(with_contact, prepare_contact_free())


class _Certificate:
    """The test whether contact makes no difference to a step."""

    def __init__(self, problem: StepProblem) -> None:
        self._problem = problem
        self._energies: list[BarrierEnergy] = [energy for energy in problem.energies if is_barrier_energy(energy)]

    def can_be_idle(self) -> bool:
        """Return whether barriers vanish at the initial guess and at the current positions.

        The initial residual is computed at the latter.
        """
        guess, current = self._problem.initial_guess, self._problem.current_positions
        return self._vanish_at(guess) and (current is guess or self._vanish_at(current))

    def is_idle_at(self, p: Positions) -> bool:
        """Return whether contact makes no difference to a step that ends at p (n, 3).

        That is the case if barriers vanish at p and the path from the initial guess is free of collisions.
        """
        direction = p - self._problem.initial_guess
        return (
            bool(np.isfinite(direction).all())
            and max_step_size(self._energies, self._problem.initial_guess, direction) == 1.0
            and self._vanish_at(p)
        )

    def _vanish_at(self, p: Positions) -> bool:
        return all(energy.value(p) == 0.0 for energy in self._energies)
