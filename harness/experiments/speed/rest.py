"""Measure whether a factor of lower precision changes the solution, starting from a converged step.

Local-global iterations take tens of thousands of steps to the minimum of a stiff scene. Newton's method therefore finds
it. Then a candidate and a float64 solver iterate from the minimum. Their difference is the effect of the precision on a
converged step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from harness.config.sweep import RunSpec
from solvers.methods.local_global_compiled import CompiledLocalGlobal
from solvers.methods.newton import Newton
from solvers.problem import Positions, Prepared, StepProblem, StopRule, Unsupported

_FROM_MINIMUM = StopRule(50)
_TO_MINIMUM = StopRule(200, 1e-12)
_LARGEST = 10_000
"""Largest number of vertices for which a minimum is computed: 1 s for 64 a side, 30 s for 128."""


class Rest(NamedTuple):
    """Step problem that starts at its minimum, and float64's final positions from there.

    The positions are (n, 3) [m].
    """

    problem: StepProblem
    positions: Positions


def precision(run: RunSpec) -> str:
    """Return the precision of a run's factor."""
    return run.solver.parameters.get("precision", "float64")


def rest_of(problem: StepProblem) -> Rest | None:
    """Find the minimum of a step problem.

    The result is None for a large one, or one that Newton's method does not support.
    """
    if problem.system.vertices > _LARGEST:
        return None
    try:
        found = Newton().prepare(problem.system).solve(problem, _TO_MINIMUM)
    except Unsupported:
        return None
    there = replace(problem, first_guess=found.positions)
    return Rest(there, CompiledLocalGlobal().prepare(problem.system).solve(there, _FROM_MINIMUM).positions)


def apart(rest: Rest, prepared: Prepared) -> float:
    """Return the largest distance of a solver's positions from float64's.

    It is relative to the scene's size.
    """
    found = prepared.solve(rest.problem, _FROM_MINIMUM).positions
    return float(np.abs(found - rest.positions).max()) / float(np.ptp(rest.positions, axis=0).max())
