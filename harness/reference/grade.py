"""Audit of the residuals that a solver reports, on some steps of every run.

    claimed >= |Q^-1 grad g(p)|_Q / SLACK,   p the solution or the iterate before it, apart from round-off

Where lengths are exact, g is the Lagrangian with the tensions that minimise its gradient at p
(`harness.reference.exact`). With the tensions of the method itself the gradient may vanish where lengths are
wrong.

The audit runs in the instrumentation pass, which is not timed. It detects a method that does nothing and reports a zero
residual. A method whose iterations do not end at the minimum of the step's objective (`minimises = False`, and no
substepping) is never rejected; its stationarity is measured all the same.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import islice
from typing import Any

import numpy as np

from harness.base.errors import RunFailed
from harness.reference.exact import Stationarity
from harness.simulation.passing import Passing
from solvers.problem import Positions, Prepared, Solution, Solver, StepProblem, StopRule
from solvers.registry import about, minimises, name_of

SLACK = 10.0
"""Factor between reported and measured residual: a factor of few digits, or a preconditioner close to Q, is allowed."""

_SAME = 1e-9
"""Relative difference, in the largest coordinate, of two sums of the same terms after many iterations."""


class Graded(Passing):
    """A prepared solver whose solutions in some frames are audited in sequence."""

    def __init__(self, prepared: Prepared, solver: Solver, frames: Collection[int]) -> None:
        """Wrap a prepared solver; `frames` are counted from 1."""
        super().__init__(prepared)
        self._claims = minimises(solver)
        own_steps = about(type(solver), name_of(solver)).own_steps
        self._frames, self._done = frames if self._claims or not own_steps else (), 0
        self._begun = -np.inf
        self._name = type(solver).__name__
        self._stationarity = Stationarity()
        self.found: dict[int, dict[str, Any]] = {}
        """Column `graded` of the row of each audited frame."""

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the solver's solution; raises RunFailed where its reported residual is wrong."""
        found = self._prepared.solve(problem, stop)
        if problem.start.time > self._begun:  # the first unknown of the next frame
            self._done, self._begun = self._done + 1, problem.start.time
        if self._done in self._frames and np.isfinite(found.positions).all():
            graded = self._graded(problem, found, stop)
            self.found[self._done] = max(graded, self.found.get(self._done, graded), key=lambda row: row["graded"])
        return found

    def _graded(self, problem: StepProblem, found: Solution, stop: StopRule) -> dict[str, Any]:
        reached, round_off, _ = self._stationarity(problem, found.positions)
        if not self._claims:
            return {"graded": reached}
        yardstick = self._stationarity.yardstick(problem)
        told, truth = f"{self._name}: reports a residual of {found.residual:.3g} J^(1/2)", reached * yardstick
        if np.isnan(found.residual) and found.iterations:
            raise RunFailed(f"{told}; wanted |Q^-1 grad g|_Q, which is {truth:.3g} (or `minimises = False`)")
        claimed = SLACK * found.residual / yardstick + round_off
        enough = SLACK * max(stop.tolerance or 0.0, stop.within / yardstick if yardstick else 0.0) + round_off
        if found.stopped != "tolerance":
            enough = np.inf
        if claimed < reached or enough < reached:  # it may be the residual of the iterate before
            before = [self._stationarity(problem, p).reached for p in self._before(problem, found)]
            least = min(reached, *before, np.inf)
            if claimed < least:
                raise RunFailed(f"{told}, where |Q^-1 grad g|_Q is {truth:.3g}")
            if enough < least:
                raise RunFailed(
                    f"{told} and says that it reached the tolerance, where {least:.3g} of the start's is left"
                )
        return {"graded": reached}

    def _before(self, problem: StepProblem, found: Solution) -> list[Positions]:
        """Return the iterate before the solution, if the iterates lead to that solution."""
        if found.iterations < 1:
            return []
        p = before = problem.first_guess.copy()
        pins = problem.system.pins
        p[pins.vertices[pins.exact]] = problem.pin_targets[pins.exact]
        for count, iterate in enumerate(islice(self._prepared.iterates(problem), found.iterations), 1):
            if count == found.iterations:
                before = p
            p = iterate.copy()
        same = np.abs(p - found.positions).max(initial=0.0) <= _SAME * np.abs(p).max(initial=0.0)
        return [before] if same else []
