"""Verifier of steps: stationarity, whether the solution is a minimum, and distance from a reference run.

Stationarity is measured by `harness.reference.oracle` with a matrix that it assembles and factorises
itself, independently of the solver. A stationary point is a minimum where the smallest eigenvalue of its Hessian is
positive beyond round-off (`harness.reference.curvature`). The motion is compared with a reference run, each
step of which was solved to round-off. The comparison is by vertex: a distance is relative to the size of the vertex's
connected component. A step with exact lengths is evaluated by its Lagrangian (`harness.reference.exact`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.reference.curvature import Curvature, curvature
from harness.reference.exact import FIRM, Stationarity
from harness.reference.minimiser import TO_THE_END
from harness.reference.oracle import Reading, sizes
from harness.scenes.bind import Scene
from harness.simulation.step import Step, prepare, simulate
from solvers.problem import Positions, Solver, StepProblem

LOST = 1e-6
"""Maximum stationarity beyond round-off at the end of a step of the reference run."""


class Judge:
    """Computes the accuracy columns of each step of one run."""

    def __init__(self, scene: Scene, reference: NDArray[np.float64] | None, *, minimises: bool) -> None:
        """Create a verifier for a scene.

        Args:
          scene: scene of the run.
          reference: positions (frames, n, 3) [m], nan from the frame on in which there is none; None without a
            reference.
          minimises: whether the solver minimises the step's objective.
        """
        self._stationarity = Stationarity()
        self._sizes = sizes(scene.system, scene.mesh.rest)
        self._reference, self._minimises = reference, minimises

    def __call__(self, step: Step) -> dict[str, Any]:
        """Compute the accuracy columns of a step's row.

        Columns: `stationarity`, `attainable`, `beyond`, `minimum` and `flat` (absent for a method that does not
        minimise), and `distance`. In a step of several stages all are evaluated, and the first three columns are those
        of the worst.
        """
        row: dict[str, Any] = {}
        if self._reference is not None:
            away = np.linalg.norm(step.positions - self._reference[step.index - 1], axis=1) / self._sizes
            row["distance"] = float(away.max()) if np.isfinite(away).all() else None
        if self._minimises:
            readings = [self.stationarity(stated, solution.positions) for stated, solution in step.stages]
            row["stationarity"], row["attainable"], row["beyond"] = max(readings, key=_worse)
            found = [self.curvature(stated, solution.positions) for stated, solution in step.stages]
            row["minimum"], row["flat"] = all(one.convex for one in found), any(one.flat for one in found)
        return row

    def stationarity(self, problem: StepProblem, p: Positions) -> Reading:
        """Evaluate the stationarity at p (n, 3) [m] (`harness.reference.exact`)."""
        return self._stationarity(problem, p)

    def curvature(self, problem: StepProblem, p: Positions) -> Curvature:
        """Compute the curvature of the objective, or of a Lagrangian with large penalties."""
        exact = self._stationarity.exact(problem.system)
        return curvature(exact.lagrangian(problem, exact.tensions(problem, p), FIRM) if exact else problem, p)


def reference(scene: Scene, solver: Solver, *, first_guess: str, frames: int) -> NDArray[np.float64]:
    """Compute positions of a run with steps solved to round-off.

    Args:
      scene: scene that is stepped.
      solver: solver of the steps.
      first_guess: name of the initial guess.
      frames: number of steps.

    Returns: positions (frames, n, 3) [m], nan from the first step on that does not end at a stationary point.
    """
    judge, found = Judge(scene, None, minimises=True), np.full((frames, len(scene.mesh.rest), 3), np.nan)
    for step in simulate(scene, prepare(scene, solver), TO_THE_END, first_guess=first_guess, frames=frames):
        if not all(judge.stationarity(stated, s.positions).beyond <= LOST for stated, s in step.stages):
            break
        found[step.index - 1] = step.positions
    return found


def _worse(reading: Reading) -> float:
    """Return the key by which a reading is ranked; non-finite readings are the worst."""
    return reading.beyond if np.isfinite(reading.beyond) else np.inf


def is_minimum(problem: StepProblem, p: Positions) -> bool:
    """Return whether the objective is convex at p (n, 3) [m], beyond round-off."""
    return curvature(problem, p).convex
