"""Measure whether a factor of lower precision changes the solution, starting from a converged step.

Local-global solvers need tens of thousands of iterations to the minimum of a stiff scene. Newton's method therefore
finds it. Then a candidate and a float64 solver iterate from the minimum. Their difference is the effect of the
precision on a converged step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from springbench.harness.config.sweep_config import RunSpec
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, StopRule, Unsupported

_STOP_FROM_MINIMUM = StopRule(50)
_STOP_AT_MINIMUM = StopRule(200, 1e-12)
_MAX_VERTICES = 10_000
"""Largest number of vertices for which a minimum is computed: 1 s for 64 a side, 30 s for 128."""


class ConvergedProblem(NamedTuple):
    """Step problem that starts at its minimum, and float64's final positions from there.

    The positions are (n, 3) [m].
    """

    problem: StepProblem
    positions: Positions


def read_precision(run: RunSpec) -> str:
    """Return the precision of a run's factor."""
    return run.solver.parameters.get("precision", "float64")


def find_converged_problem(problem: StepProblem) -> ConvergedProblem | None:
    """Find the minimum of a step problem.

    The result is None for a large one, or one that Newton's method does not support.
    """
    if problem.system.num_vertices > _MAX_VERTICES:
        return None
    try:
        found = NewtonSolver().prepare(problem.system).solve(problem, _STOP_AT_MINIMUM)
    except Unsupported:
        return None
    there = replace(problem, initial_guess=found.positions)
    return ConvergedProblem(
        there, CompiledLocalGlobal().prepare(problem.system).solve(there, _STOP_FROM_MINIMUM).positions
    )


def compute_precision_error(converged: ConvergedProblem, prepared: PreparedSolver) -> float:
    """Return the largest difference of a coordinate from float64's positions, relative to the scene's size.

    Args:
        converged: step problem that starts at its minimum, and float64's positions.
        prepared: solver, prepared for the system of the problem.
    """
    found = prepared.solve(converged.problem, _STOP_FROM_MINIMUM).positions
    return float(np.abs(found - converged.positions).max()) / float(np.ptp(converged.positions, axis=0).max())
