"""Whether a factor of less precision leads elsewhere: from where a step has converged, not along the way there.

Local-global iterations take tens of thousands of steps to the minimum of a stiff scene, so Newton's method finds it,
and then a candidate and one of float64 iterate from there. They part by what the precision does to a converged step.
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
"""Vertices up to which a minimum is looked for: a second for 64 a side, half a minute for 128."""


class Rest(NamedTuple):
    """A step problem that begins at its minimum, and the positions (n, 3) [m] where float64 ends from there."""

    problem: StepProblem
    positions: Positions


def precision(run: RunSpec) -> str:
    """The precision of a run's factor."""
    return run.solver.parameters.get("precision", "float64")


def rest_of(problem: StepProblem) -> Rest | None:
    """Where a step problem converges; None for a large one, or one that Newton's method does not take."""
    if problem.system.vertices > _LARGEST:
        return None
    try:
        found = Newton().prepare(problem.system).solve(problem, _TO_MINIMUM)
    except Unsupported:
        return None
    there = replace(problem, first_guess=found.positions)
    return Rest(there, CompiledLocalGlobal().prepare(problem.system).solve(there, _FROM_MINIMUM).positions)


def apart(rest: Rest, prepared: Prepared) -> float:
    """How far from float64's a prepared solver's positions end, in the scene's size."""
    found = prepared.solve(rest.problem, _FROM_MINIMUM).positions
    return float(np.abs(found - rest.positions).max()) / float(np.ptp(rest.positions, axis=0).max())
