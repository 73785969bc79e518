"""Error-controlled run of a sweep (`accuracy`) with a given solver.

Integrator and step size are chosen.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from harness.base.errors import RunFailed
from harness.base.quantities import ms_per_step
from harness.base.worker import Tick
from harness.config.sweep import RunSpec
from harness.experiments.asked.search import Answer, foresee, search
from harness.experiments.asked.ways import Asked, tried_by
from harness.scenes.bind import Scene
from harness.simulation.controlled import Path
from harness.simulation.measure import digest
from harness.simulation.observe import intersections, strain_of
from solvers.problem import Positions


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """Result of an error-controlled run.

    Attributes:
        scene: the scene, built with the frame as its time step.
        answer: method, setting and error estimate.
        asked: requested relative error.
        rounds: the same motion, timed again in each round.
        said: remarks, stored in the rows.
    """

    scene: Scene
    answer: Answer
    asked: float
    rounds: tuple[Path, ...]
    said: list[str] = field(default_factory=list[str])

    @property
    def positions(self) -> Positions:
        """Positions at the start and after each frame, (frames + 1, n, 3) [m]."""
        return self.rounds[0].positions

    @property
    def ms_per_step(self) -> float:
        """Time per step [ms], where each frame counts as one step."""
        return ms_per_step([seconds for path in self.rounds for seconds in path.frames])

    def rows(self) -> list[dict[str, Any]]:
        """Build a row for each frame of each round."""
        best, scene = self.answer.best, self.scene
        shared = {
            "phase": "step",
            "status": "ok",
            "reason": self.answer.note or None,
            "vertices": scene.system.vertices,
            "springs": len(scene.springs.edges),
            "max_iterations": None,
            "first_guess": None,
            "asked": self.asked,
            **best.columns,
            "estimate_seconds": self.answer.seconds,
            "choice": "; ".join([f"{best.way} of {len(self.answer.tried)} ways", *self.said]),
        }
        seen = [self._seen(k, p) for k, p in enumerate(self.positions) if k]
        return [
            shared
            | columns
            | {"round": number, "seconds": seconds, "pass_seconds": one.seconds, "summed_seconds": sum(one.frames)}
            for number, one in enumerate(self.rounds)
            for columns, seconds in zip(seen, one.frames, strict=True)
        ]

    def _seen(self, frame: int, p: Positions) -> dict[str, Any]:
        crossed = intersections(self.scene, p, self.scene.time(frame))
        return {"frame": frame, **strain_of(self.scene, p), "intersections": crossed, "digest": digest(p)}


def keep_to_error(run: RunSpec, error: float, tick: Tick) -> Kept:
    """Find the cheapest method of the run's solver, and repeat it.

    It is repeated for all rounds of the run.

    Args:
        run: specification of the run.
        error: relative error at the end of the run.
        tick: called with the name of the phase as the run progresses.

    Raises:
        RunFailed: no setting reaches the error, or a round ends at positions that are not bitwise identical.
        Unsupported: the solver does not support error control. Errors of the solver are raised unchanged.
    """
    pairs = tried_by(run.solver)
    asked = Asked.of(run.scene, run.size, run.frames * run.scene.time_step)
    said = list[str]()
    tick("choosing steps")
    answer = search(asked, error, foresee(asked, error, said.append), lambda line: tick("choosing steps"), pairs)
    best, rounds = answer.best, list[Path]()
    for _ in range(run.rounds):
        rounds.append(best.again())
        if not np.array_equal(rounds[-1].positions, best.path.positions):
            raise RunFailed("a round ended at other positions than the one before")
        for _ in range(run.frames):
            tick("timed pass")
    return Kept(asked.bound(asked.frame, "own"), answer, error, tuple(rounds), said)
