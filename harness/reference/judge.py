"""Judges each step by the oracle: whether its answer is stationary, whether it is a minimum, how far off the motion is.

    residual(p)     = |Q^-1 grad g(p)|_Q over the unpinned vertices, which a heavy pin does not blind
    stationarity(p) = residual(p) / max(residual(current positions), floor)

with a Q that is assembled and factorised here, by SuperLU, whatever the solver does. The floor is the residual that
round-off leaves, as `solvers.problem.StopRule` has it. A stationary point is a minimum where the Hessian has a Cholesky
factor, which the signs of its pivots say. The motion is compared with a reference run, each step of which was taken
down to round-off.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu

from harness.reference.minimiser import TO_THE_END, free_hessian
from harness.scenes.bind import Scene
from harness.simulation.step import Step, prepare, simulate
from solvers.matrices import assemble, energy_norm
from solvers.problem import Positions, ProjectiveEnergy, Solver, StepProblem, StopRule, System

SLACK = 2.0
"""Two factorisations of one Q differ by round-off, and some methods stop by the residual one iteration earlier."""
LOST = 1e-6
"""A reference step ends at most this far, in stationarity, from a stationary point."""


class Oracle:
    """The residual of step problems of one system."""

    def __init__(self, system: System) -> None:
        """Raises NotPositiveDefinite."""
        self._system = system
        self._Q = assemble(system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)])
        self._trace = float(self._Q.diagonal()[system.unpinned].sum())

    @cached_property
    def _factor(self) -> Any:
        free = self._system.free
        return _lu(csr_array(self._Q[free][:, free]))

    def residual(self, problem: StepProblem, p: Positions) -> float:
        """|Q^-1 grad g(p)|_Q [J^(1/2)] over the unpinned vertices."""
        free, e = self._system.free, np.zeros_like(p)
        if len(free):
            e[free] = self._factor.solve(problem.gradient(p)[free])
        e[self._system.pins.vertices] = 0.0
        return energy_norm(self._Q, e)

    def floor(self, p: Positions) -> float:
        """The residual [J^(1/2)] that the stop rule takes for round-off at p."""
        return StopRule().floor * float(np.abs(p).max(initial=0.0)) * self._trace**0.5

    def stationarity(self, problem: StepProblem, p: Positions) -> tuple[float, float]:
        """The stationarity at p, and the least that round-off lets anyone reach."""
        floor = self.floor(problem.current)
        yardstick = max(self.residual(problem, problem.current), floor, np.finfo(float).tiny)
        return self.residual(problem, p) / yardstick, floor / yardstick


class Judge:
    """Tells of each step of one run what its row says of the answer."""

    def __init__(self, scene: Scene, reference: NDArray[np.float64] | None, *, minimises: bool) -> None:
        """reference: positions (frames, n, 3) [m], nan from the frame on in which there is none, None for none at all;
        minimises: whether the solver means to."""
        self._oracles: dict[float, Oracle] = {}
        self._size = scene.mesh.size or 1.0
        self._reference, self._minimises = reference, minimises

    def __call__(self, step: Step) -> dict[str, Any]:
        """The columns `stationarity`, `attainable` and `minimum` (null for a method that does not minimise) and
        `distance` of the step's row."""
        row: dict[str, Any] = {}
        if self._reference is not None:
            away = np.linalg.norm(step.positions - self._reference[step.index - 1], axis=1).max()
            row["distance"] = float(away) / self._size if np.isfinite(away) else None
        if self._minimises:
            p, stated = step.solution.positions, step.problem
            row["stationarity"], row["attainable"] = self.stationarity(stated, p)
            row["minimum"] = is_minimum(stated, p)
        return row

    def stationarity(self, problem: StepProblem, p: Positions) -> tuple[float, float]:
        """As `Oracle` has it; a scene whose first step or every second one differs has two systems."""
        system = problem.system
        if system.rate not in self._oracles:
            self._oracles[system.rate] = Oracle(system)
        return self._oracles[system.rate].stationarity(problem, p)


def reference(scene: Scene, solver: Solver, *, first_guess: str, frames: int) -> NDArray[np.float64]:
    """The positions (frames, n, 3) [m] of a run whose steps `solver` takes down to round-off; nan from the step on
    that does not end at a stationary point."""
    judge, found = Judge(scene, None, minimises=True), np.full((frames, len(scene.mesh.rest), 3), np.nan)
    for step in simulate(scene, prepare(scene, solver), TO_THE_END, first_guess=first_guess, frames=frames):
        reached, attainable = judge.stationarity(step.problem, step.solution.positions)
        if not reached <= SLACK * max(LOST, attainable):
            break
        found[step.index - 1] = step.positions
    return found


def is_minimum(problem: StepProblem, p: Positions) -> bool:
    """Whether the Hessian of the objective at p is positive definite: all pivots of its factor are positive."""
    if not len(problem.system.free):
        return True
    try:
        factor = _lu(free_hessian(problem, p))
    except RuntimeError:  # a pivot is zero
        return False
    symmetric = np.array_equal(factor.perm_r, factor.perm_c)  # else a pivot was not to be had on the diagonal
    return bool(symmetric and (factor.U.diagonal() > 0.0).all())


def _lu(matrix: csr_array) -> Any:
    """SuperLU of a symmetric matrix, with its pivots on the diagonal."""
    settings: Any = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return splu(matrix.tocsc(), **settings)
