"""How a solve converges: residual and objective of each iterate, by the oracle and not by the solver."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

from scipy.sparse import csr_array

from solvers.matrices import assemble, energy_norm
from solvers.problem import Positions, Prepared, ProjectiveEnergy, StepProblem, System


@dataclass(frozen=True, slots=True, eq=False)
class Convergence:
    """residuals |p - previous p|_Q [J^(1/2)] over the unpinned vertices and objective [J] of iterates 1, 2, ..."""

    residuals: list[float]
    objective: list[float]


class EnergyNorm:
    """|e|_Q [J^(1/2)] over the unpinned vertices, from a Q that is assembled here."""

    def __init__(self, system: System) -> None:
        projective = [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
        self._Q: csr_array = assemble(system, projective)
        self._pinned = system.pins.vertices

    def __call__(self, e: Positions) -> float:
        """The norm of a displacement (n, 3) [m]."""
        e = e.copy()
        e[self._pinned] = 0.0
        return energy_norm(self._Q, e)


def trace(prepared: Prepared, problem: StepProblem, norm: EnergyNorm, iterations: int) -> Convergence:
    """The convergence of a solve of `problem` over a number of iterations."""
    residuals, objective = list[float](), list[float]()
    previous = problem.first_guess.copy()
    for p in islice(prepared.iterates(problem), iterations):
        residuals.append(norm(p - previous))
        objective.append(problem.value(p))
        previous[:] = p
    return Convergence(residuals, objective)
