"""Audit of the residuals that a solver reports, on some steps of every run.

    claimed >= |Q^-1 grad g(p)|_Q / RESIDUAL_SLACK,   p the solution or the iterate before it, apart from round-off

At a solution whose gradient is round-off at each vertex, as `springbench.solvers.model.rounding_bound` bounds it, two
evaluations of the residual need not agree, and the claim is not compared.

Where lengths are exact, g is the Lagrangian with the tensions that minimise its gradient at p
(`springbench.harness.reference.exact_lengths`). With the tensions of the method itself the gradient may vanish where
lengths are wrong.

The audit runs in the instrumentation pass, which is not timed. It detects a method that does nothing and reports a zero
residual. If the bound of a solve's rounding errors is as large as the measured residual, the error names them as the
cause (`springbench.harness.simulation.direct_solve_remarks`). A method whose iterations do not end at the minimum of
the step's objective (`is_minimiser = False`, and no substepping) is never rejected; its stationarity is measured all
the same.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from springbench.harness.errors import RunFailed
from springbench.harness.reference.exact_lengths import StationarityEvaluator
from springbench.harness.simulation.direct_solve_remarks import explain_residual
from springbench.harness.simulation.solver_contract import DelegatingSolver
from springbench.solvers.model.rounding_bound import is_gradient_roundoff
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solution, Solver, StepProblem, StopRule
from springbench.solvers.registry import find_solver_info, find_solver_name, is_minimiser

RESIDUAL_SLACK = 10.0
"""Factor allowed between reported and measured residual, for a factor of few digits or a preconditioner close to Q."""

_SAME_POSITION_RTOL = 1e-9
"""Relative difference, in the largest coordinate, of two sums of the same terms after many iterations."""


class AuditedSolver(DelegatingSolver):
    """A prepared solver whose solutions in some frames are audited in sequence."""

    def __init__(self, prepared: PreparedSolver, solver: Solver, frames: Collection[int]) -> None:
        """Wrap a prepared solver.

        Args:
            prepared: prepared solver, to which all solves are delegated.
            solver: solver from which it was prepared; states whether it minimises.
            frames: frames to be audited, counted from 1; ignored for a solver that takes its own substeps and does not
                minimise.
        """
        super().__init__(prepared)
        self._claims = is_minimiser(solver)
        own_steps = find_solver_info(type(solver), find_solver_name(solver)).is_substepping
        self._frames, self._done = frames if self._claims or not own_steps else (), 0
        self._begun = -np.inf
        self._solver, self._name = solver, type(solver).__name__
        self._stationarity = StationarityEvaluator()
        self.found: dict[int, dict[str, Any]] = {}
        """Column `stationarity_audit` of the row of each audited frame."""

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the solver's solution, audited in the chosen frames.

        Args:
            problem: step problem; a later start time than before begins the next frame.
            stop: stop rule of the solve, whose tolerance a converged solution has to meet.

        Raises:
            RunFailed: the residual that the solver reports is wrong.
        """
        found = self._prepared.solve(problem, stop)
        if problem.step_start.time > self._begun:  # the first stage of the next frame
            self._done, self._begun = self._done + 1, problem.step_start.time
        if self._done in self._frames and np.isfinite(found.positions).all():
            graded = self._audit_solution(problem, found, stop)
            self.found[self._done] = max(
                graded, self.found.get(self._done, graded), key=lambda row: row["stationarity_audit"]
            )
        return found

    def _audit_solution(self, problem: StepProblem, found: Solution, stop: StopRule) -> dict[str, Any]:
        reached, round_off, _ = self._stationarity(problem, found.positions)
        if not self._claims:
            return {"stationarity_audit": reached}
        initial_residual = self._stationarity.compute_initial_residual(problem)
        message, truth = f"{self._name}: reports a residual of {found.residual:.3g} J^(1/2)", reached * initial_residual
        if np.isnan(found.residual) and found.num_iterations:
            raise RunFailed(f"{message}; expected |Q^-1 grad g|_Q, which is {truth:.3g}, or `is_minimiser = False`")
        claimed = RESIDUAL_SLACK * found.residual / initial_residual + round_off
        enough = (
            RESIDUAL_SLACK * max(stop.rtol or 0.0, stop.atol / initial_residual if initial_residual else 0.0)
            + round_off
        )
        if found.termination_reason != "converged":
            enough = np.inf
        if claimed < reached or enough < reached:  # it may be the residual of the iterate before
            before = [self._stationarity(problem, p).stationarity for p in self._find_previous_iterate(problem, found)]
            least = min(reached, *before, np.inf)
            explain = partial(explain_residual, self._solver, problem.system, found.positions, truth)
            if claimed < least and not is_gradient_roundoff(problem, found.positions, stop.roundoff_floor):
                raise RunFailed(f"{message}; expected |Q^-1 grad g|_Q, which is {truth:.3g}{explain()}")
            if enough < least:
                raise RunFailed(
                    f"{message} and the reason `converged`; expected a residual within the tolerance, "
                    f"but it is {least:.3g} of the initial one{explain()}"
                )
        return {"stationarity_audit": reached}

    def _find_previous_iterate(self, problem: StepProblem, found: Solution) -> list[Positions]:
        """Return the iterate before the solution, if the iterates lead to that solution."""
        if found.num_iterations < 1:
            return []
        p = before = problem.initial_guess.copy()
        pins = problem.system.pins
        p[pins.vertices[pins.exact_mask]] = problem.pin_targets[pins.exact_mask]
        for count, iterate in enumerate(islice(self._prepared.iterates(problem), found.num_iterations), 1):
            if count == found.num_iterations:
                before = p
            p = iterate.copy()
        same = np.abs(p - found.positions).max(initial=0.0) <= _SAME_POSITION_RTOL * np.abs(p).max(initial=0.0)
        return [before] if same else []
