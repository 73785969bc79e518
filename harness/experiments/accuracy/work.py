"""Work-precision of whole simulations: error at the horizon and wall time.

    error = |p(T) - reference(T)| / |reference(T) - p(0)|        Frobenius norms over the vertices that are not pinned

The error combines time stepping and solver, which is what a user gets. Pins are exact here, as they are in the
reference. Where the error is smaller than the reference's own error, the row is `uncertified`.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Any

import numpy as np

from harness.base import machine
from harness.config.accuracy import WorkSpec
from harness.experiments.accuracy.failures import OverTime, lost
from harness.experiments.accuracy.scales import stiffness_ratio
from harness.experiments.provenance import tolerance
from harness.reference.frozen import bind
from harness.reference.trajectory import Trajectory
from harness.scenes.bind import Scene
from harness.simulation.algebraic import stop_rule
from harness.simulation.clock import Clock, Watch, measured_again
from harness.simulation.measure import Diverged
from harness.simulation.step import prepare, simulate
from solvers.problem import Positions, Prepared, Solver
from solvers.registry import EVERY, load

Row = dict[str, Any]

WARM_UP = 2
"""Steps before the clock starts: they compile, and access memory for the first time."""


def work_rows(spec: WorkSpec, trajectory: Trajectory | Exception, tick: Callable[[], None]) -> list[Row]:
    """Measure one simulation and build its row; an error becomes status and reason.

    Args:
        spec: the simulation.
        trajectory: reference up to the horizon, or the error that prevents it.
        tick: called after each round.
    """
    shared: Row = {"kind": "work", "status": "ok", **options(spec), "horizon": spec.horizon}
    try:
        if isinstance(trajectory, Exception):
            raise trajectory
        with machine.pinned_threads(spec.how.threads):
            return [shared | _simulated(spec, trajectory, tick)]
    except Exception as error:  # whatever a solver raises, the others go on
        return [shared | lost(error)]


def options(spec: WorkSpec) -> Row:
    """Build the columns of a simulation's options."""
    return {**spec.options, "tolerance": tolerance(spec.options["tolerance"])}


def _simulated(spec: WorkSpec, trajectory: Trajectory, tick: Callable[[], None]) -> Row:
    case = spec.case
    scene = bind(case.scene, case.size, case.integrator)
    solver: Solver = load(EVERY[spec.solver.name])(**spec.solver.parameters)
    prepared = prepare(scene, solver)
    row: Row = {"vertices": scene.system.vertices, "springs": len(scene.springs.edges), "choice": prepared.choice}
    row["stiffness_ratio"] = stiffness_ratio(scene.system, scene.springs.stiffness)
    frames = round(spec.horizon / case.scene.time_step)
    seconds: list[float] = []
    row["interrupted"] = False
    p, *_ = _run(spec, scene, prepared, min(WARM_UP, frames), limit=inf)  # compiling counts against nobody
    for _ in range(spec.how.rounds):
        p, iterations, watched = _run(spec, scene, prepared, frames)
        seconds.append(watched["summed_seconds"])
        row["cpu_seconds"] = min(row.get("cpu_seconds", inf), watched["cpu_seconds"])
        row["interrupted"] |= watched["interrupted"]
        row["iterations_done"] = iterations
        tick()
    away = (p - trajectory.positions[-1])[scene.system.free]
    row["error"], row["truth"] = trajectory.error(-1, p), trajectory.truth
    row["error_rms_m"] = float(np.sqrt(np.einsum("ij,ij->i", away, away).mean()))
    row |= {"seconds": seconds, "seconds_per_simulated": float(np.median(seconds)) / spec.horizon}
    trajectory.require(row["error"])
    return row


@measured_again
def _run(
    spec: WorkSpec, scene: Scene, prepared: Prepared, frames: int, *, limit: float | None = None
) -> tuple[Positions, int, Row]:
    """Simulate under a clock.

    Return the last positions (n, 3) [m], the number of iterations and timing columns.

    `limit` is in seconds; that of the spec if left out. Raises RunFailed where another clock disagrees.
    """
    seconds, iterations, p, watch = 0.0, 0, scene.mesh.rest, Watch(spec.how.threads)
    clock = Clock(watch)
    stop = stop_rule(spec.options["iterations"], spec.options["tolerance"])
    limit = spec.how.time_limit if limit is None else limit
    run = simulate(scene, prepared, stop, first_guess=spec.options["first_guess"], frames=frames)
    for _ in range(frames):
        with clock:
            step = next(run)
        p = step.positions
        seconds += clock.seconds
        iterations += step.iterations
        if not np.isfinite(p).all():
            raise Diverged(f"positions are not finite from frame {step.index} on")
        if seconds > limit and step.index < frames:
            raise OverTime(f"the limit of {limit:g} s was reached in frame {step.index} of {frames}")
    return p, iterations, watch.columns("step", [seconds])
