"""Judges each step by the oracle: whether its answer is stationary, whether it is a minimum, how far off the motion is.

What is stationary `harness.reference.oracle` tells, with a matrix that it assembles and factorises itself, whatever the
solver does. A stationary point is a minimum where the smallest eigenvalue of its Hessian is positive beyond round-off
(`harness.reference.curvature`). The motion is compared with a reference run, each step of which was taken down to
round-off, and vertex by vertex: a distance counts by the size of the component that the vertex belongs to. A step
that keeps lengths exactly is judged by its Lagrangian (`harness.reference.exact`).
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
"""A reference step ends at most this far, in stationarity beyond round-off, from a stationary point."""


class Judge:
    """Tells of each step of one run what its row says of the answer."""

    def __init__(self, scene: Scene, reference: NDArray[np.float64] | None, *, minimises: bool) -> None:
        """reference: positions (frames, n, 3) [m], nan from the frame on in which there is none, None for none at all;
        minimises: whether the solver means to."""
        self._stationarity = Stationarity()
        self._sizes = sizes(scene.system, scene.mesh.rest)
        self._reference, self._minimises = reference, minimises

    def __call__(self, step: Step) -> dict[str, Any]:
        """The columns `stationarity`, `attainable`, `beyond`, `minimum` and `flat` (null for a method that does not
        minimise) and `distance` of the step's row. Of a step of several unknowns all are judged, and the first three
        are those of the worst."""
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
        """See `harness.reference.exact.Stationarity`."""
        return self._stationarity(problem, p)

    def curvature(self, problem: StepProblem, p: Positions) -> Curvature:
        """That of the objective, or of a Lagrangian whose penalties are large."""
        exact = self._stationarity.exact(problem.system)
        return curvature(exact.lagrangian(problem, exact.tensions(problem, p), FIRM) if exact else problem, p)


def reference(scene: Scene, solver: Solver, *, first_guess: str, frames: int) -> NDArray[np.float64]:
    """The positions (frames, n, 3) [m] of a run whose steps `solver` takes down to round-off; nan from the step on
    that does not end at a stationary point."""
    judge, found = Judge(scene, None, minimises=True), np.full((frames, len(scene.mesh.rest), 3), np.nan)
    for step in simulate(scene, prepare(scene, solver), TO_THE_END, first_guess=first_guess, frames=frames):
        if not all(judge.stationarity(stated, s.positions).beyond <= LOST for stated, s in step.stages):
            break
        found[step.index - 1] = step.positions
    return found


def _worse(reading: Reading) -> float:
    """What a reading is ranked by, one that is no number first."""
    return reading.beyond if np.isfinite(reading.beyond) else np.inf


def is_minimum(problem: StepProblem, p: Positions) -> bool:
    """Whether the objective curves upwards in all directions at p (n, 3) [m], beyond round-off."""
    return curvature(problem, p).convex
