"""Grades some steps of a run by the oracle, whatever the run asks for: a residual that is claimed must be one.

    claimed >= |Q^-1 grad g(p)|_Q / SLACK,   p the answer, or the iterate before it, round-off apart

Where lengths are exact, g is the Lagrangian with the tensions that leave least of its gradient at p
(`harness.reference.exact`): by the tensions of a method itself it may vanish where lengths are wrong.

It is done in the second pass, where no clock runs. Whoever does nothing and reports that nothing is left is found out.
Of a method whose iterations end elsewhere than at the minimum of the step's objective (`minimises = False`, and no
steps of its own) nothing is refused; what is left is measured all the same.
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
"""A residual may be measured with a factor of few digits, or with a preconditioner that is like Q."""

_SAME = 1e-9
"""Of the largest coordinate, what two sums of the same terms may differ by after many iterations."""


class Graded(Passing):
    """A prepared solver whose answers in some frames are graded, as it gives them in turn."""

    def __init__(self, prepared: Prepared, solver: Solver, frames: Collection[int]) -> None:
        """frames: counted from 1."""
        super().__init__(prepared)
        self._claims = minimises(solver)
        own_steps = about(type(solver), name_of(solver)).own_steps
        self._frames, self._done = frames if self._claims or not own_steps else (), 0
        self._begun = -np.inf
        self._name = type(solver).__name__
        self._stationarity = Stationarity()
        self.found: dict[int, dict[str, Any]] = {}
        """By frame, the column `graded` of its row."""

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The solver's answer; raises RunFailed where it claims what is not so."""
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
        """The iterate before the answer, where the iterates lead to that."""
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
