"""Rows of step snapshots: the step, its minima, and a solver's curves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

from harness.base import machine
from harness.config.accuracy import Case, CurveSpec, moment_name
from harness.experiments.accuracy.curves import GradedCurve, measure
from harness.experiments.accuracy.failures import lost
from harness.experiments.accuracy.recording import record
from harness.experiments.accuracy.scales import distances, stiffness_ratio
from harness.experiments.provenance import provenance
from harness.reference.frozen import Frozen, bind
from harness.reference.minimiser import KnownMinima, Minimum
from harness.reference.oracle import Oracle
from harness.reference.store import Store
from harness.scenes.bind import Scene
from harness.simulation.step import guessed
from solvers import device
from solvers.problem import Positions, Prepared, Solver, System
from solvers.registry import EVERY, load

Row = dict[str, Any]

CONVERGED = 1e-2
"""Stationarity below which a solver counts as having reached the basin of its last iterate."""

CLOSE = 1e-3
"""Largest distance of a vertex from a known minimum at which the minimum counts as reached, in mean rest lengths."""


@dataclass(frozen=True, eq=False)
class GradedStep:
    """Step snapshot of a case, with the objects that score iterates on it.

    Attributes:
        case: scene, size and integrator.
        moment: name of the snapshot, as in the rows.
        frozen: the problem of the step.
        store: store of the reference solutions.
    """

    case: Case
    moment: str
    frozen: Frozen
    store: Store

    @classmethod
    def find(cls, case: Case, moment: str | int, store: Store) -> GradedStep:
        """Load a step snapshot and find its minima. Raises InputError, RunFailed.

        Args:
            case: scene, size and integrator.
            moment: name of the snapshot, or number of the frame.
            store: store of the reference solutions.
        """
        scene, size, integrator = case.scene, case.size, case.integrator
        if isinstance(moment, int):
            frozen = store.frames(scene, size, [moment], integrator)[moment]
        else:
            frozen = store.moments(scene, size, integrator)[moment]
        return cls(case, moment_name(moment), frozen, store)

    @cached_property
    def scene(self) -> Scene:
        """The scene with all pins exact."""
        return bind(self.case.scene, self.case.size, self.case.integrator)

    @cached_property
    def oracle(self) -> Oracle:
        """Reference evaluator that scores iterates."""
        return Oracle(self.frozen.problem.system)

    @property
    def reference(self) -> KnownMinima:
        """The minima that are known at the time of the call."""
        return self.store.reference(self.frozen)

    @cached_property
    def mean_rest_length(self) -> float:
        """Mean rest length of the springs [m]; nan without springs."""
        lengths = self.scene.springs.rest_length
        return float(lengths.mean()) if len(lengths) else float("nan")

    def common(self) -> Row:
        """Build the columns of the step that all its rows share."""
        return {
            "vertices": self.frozen.problem.system.vertices,
            "springs": len(self.scene.springs.edges),
            "problem": self.frozen.digest,
            "moment": self.moment,
            "frame": self.frozen.frame,
            "status": "ok",
        }

    def rows(self) -> list[Row]:
        """Build the rows of the step and of its minima.

        The first is `uncertified` without a certified minimum.
        """
        case, problem, reference = self.case, self.frozen.problem, self.reference
        common = self.common() | provenance()
        common |= {"scene": case.scene_name, "size": case.size, "integrator": case.integrator}
        common["time_step"] = case.scene.time_step
        best = reference.minima[0].positions if reference.minima else problem.current
        row = common | {
            "kind": "problem",
            "stiffness_ratio": stiffness_ratio(problem.system, self.scene.springs.stiffness),
            "mean_rest_length": self.mean_rest_length,
            "g0": problem.value(problem.current),
            "g0_inertial": problem.value(guessed(problem, "inertial").first_guess),
            "magnitude": problem.magnitude(best),
        }
        if not reference.minima:
            row |= {"status": "uncertified", "reason": reference.reason}
        return [row, *(common | self._minimum(branch, m) for branch, m in enumerate(reference.minima))]

    def _minimum(self, branch: int, minimum: Minimum) -> Row:
        return {
            "kind": "minimum",
            "branch": branch,
            "minimum": minimum.name,
            "g": minimum.g,
            "stationarity": self.oracle.stationarity(self.frozen.problem, minimum.positions).reached,
            "smallest_eigenvalue": minimum.smallest_eigenvalue,
            "certified": minimum.certified,
        }

    def reached(self, p: Positions, stationarity: float) -> Minimum | None:
        """Return the minimum whose basin contains p (n, 3) [m].

        The result is None if p has not converged enough.
        """
        if not stationarity <= CONVERGED:
            return None
        for known in self.reference.minima:
            if distances(self.frozen.problem.system, p, known.positions)[0] <= CLOSE * self.mean_rest_length:
                return known
        found = self.store.classify(self.frozen, p)
        return found if found.certified else None


def curve_rows(spec: CurveSpec, graded: GradedStep, folder: Path, tick: Callable[[], None]) -> list[Row]:
    """Measure one solver on one step: its preparation, and a curve from each initial guess.

    An error of the solver becomes a row.

    Args:
        spec: the curves of the solver.
        graded: the step snapshot.
        folder: folder of the config's results.
        tick: called after each curve.
    """
    solver: Solver = load(EVERY[spec.solver.name])(**spec.solver.parameters)
    shared = graded.common()
    try:
        with machine.pinned_threads(spec.how.threads):
            prepared, row = _prepared(solver, graded, spec.how.rounds)
            shared |= device.told(prepared)
            found = [shared | row]
            for first_guess in spec.first_guesses:
                found += [shared | row for row in _curve(spec, prepared, graded, first_guess, folder)]
                tick()
    except Exception as error:  # whatever a solver raises, the others go on
        return [shared | lost(error) | {"kind": "curve", "first_guess": guess} for guess in spec.first_guesses]
    return found


def _prepared(solver: Solver, graded: GradedStep, rounds: int) -> tuple[Prepared, Row]:
    system, seconds = graded.frozen.problem.system, list[float]()
    began = perf_counter()
    prepared = solver.prepare(system)
    cold = perf_counter() - began
    for _ in range(rounds):
        began = perf_counter()
        prepared = solver.prepare(system)
        seconds.append(perf_counter() - began)
    return prepared, {"kind": "prepare", "cold": cold, "seconds": seconds}


def _curve(spec: CurveSpec, prepared: Prepared, graded: GradedStep, first_guess: str, folder: Path) -> list[Row]:
    known = graded.reference.minima
    curve = measure(
        prepared,
        graded.frozen.stated(first_guess),
        graded.oracle,
        known[0].g if known else None,
        iterations=spec.iterations,
        time_limit=spec.how.time_limit,
        rounds=spec.how.rounds,
    )
    reached = graded.reached(curve.positions[-1], curve.stationarity[-1]) if curve.status != "saddle" else None
    shared: Row = {
        "kind": "curve",
        "first_guess": first_guess,
        "iterations": spec.iterations,
        "status": curve.status,
        "reason": curve.reason or None,
        "interrupted": curve.interrupted,
    }
    reference = graded.reference  # again: this solver may have found a minimum
    if not reference.minima and curve.status == "ok":
        shared |= {"status": "uncertified", "reason": reference.reason}
    if reached:
        shared["branch"] = reference.branch(reached)
    if spec.recordings and first_guess == spec.first_guesses[0]:
        shared["recording"] = str(record(spec, graded, graded.scene, first_guess, curve, folder).relative_to(folder))
    against = reached or next(iter(reference.minima), None)
    return [shared | row for row in _points(curve, graded.frozen.problem.system, against)]


def _points(curve: GradedCurve, system: System, minimum: Minimum | None) -> list[Row]:
    rows: list[Row] = []
    for k, number in enumerate(curve.numbers):
        row: Row = {
            "iteration": number,
            "g": _number(curve.g[k]),
            "stationarity": _number(curve.stationarity[k]),
            "seconds": curve.seconds[k].tolist(),
        }
        if minimum:
            largest, rms = distances(system, curve.positions[k], minimum.positions)
            row |= {"minimum": minimum.name, "largest_error": largest, "rms_error": rms}
        rows.append(row)
    return rows


def _number(value: float) -> float | None:
    """Return the value, or None if it is not finite because an iterate overflows."""
    return value if math.isfinite(value) else None
