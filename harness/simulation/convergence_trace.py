"""Convergence of a solve: residual and objective of each iterate, computed independently of the solver."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

from scipy.sparse import csr_array
from springbench.solvers.model.step_problem import Positions, PreparedSolver, ProjectiveEnergy, StepProblem, System
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix, energy_norm


@dataclass(frozen=True, slots=True, eq=False)
class ConvergenceTrace:
    """Convergence of a solve at the iterates 1, 2, ...

    Attributes:
      residuals: |p - previous p|_Q [J^(1/2)] over the unpinned vertices.
      objective: objective [J].
    """

    residuals: list[float]
    objective: list[float]


class EnergyNorm:
    """Norm |e|_Q [J^(1/2)] over the unpinned vertices, with a Q that is assembled here."""

    def __init__(self, system: System) -> None:
        projective = [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
        self._Q: csr_array = assemble_system_matrix(system, projective)
        self._pinned = system.pins.vertices

    def __call__(self, e: Positions) -> float:
        """Compute the norm of a displacement (n, 3) [m]."""
        e = e.copy()
        e[self._pinned] = 0.0
        return energy_norm(self._Q, e)


def trace_convergence(
    prepared: PreparedSolver, problem: StepProblem, norm: EnergyNorm, iterations: int
) -> ConvergenceTrace:
    """Trace the convergence of a solve over a number of iterations.

    Args:
      prepared: prepared solver.
      problem: step problem.
      norm: norm of the residuals.
      iterations: number of iterations.
    """
    residuals, objective = list[float](), list[float]()
    previous = problem.initial_guess.copy()
    for p in islice(prepared.iterates(problem), iterations):
        residuals.append(norm(p - previous))
        objective.append(problem.value(p))
        previous[:] = p
    return ConvergenceTrace(residuals, objective)
