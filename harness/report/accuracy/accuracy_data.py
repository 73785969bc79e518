"""The rows of an accuracy measurement as problems, curves and simulations (`springbench.harness.experiments.accuracy`).

The gap of an energy g is (g - g*)/(g0 - g*): g0 at the current positions (at the inertial target in the reproduction of
Liu et al. 2013), g* at the lowest known minimum. Rows contain energies, so a lower minimum corrects all gaps.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from springbench.harness.report.number_format import format_time_step
from springbench.harness.report.provenance_words import is_stale

FloatArray = NDArray[np.float64]

INITIAL_GUESS_LABELS: dict[str, str] = {
    "previous": "from the previous positions",
    "inertial": "from the inertial target",
    "extrapolated": "from extrapolated positions",
    "assignment": "as in the assignment",
}
"""Initial guesses in words."""


@dataclass(frozen=True, slots=True)
class SnapshotProblem:
    """A step snapshot.

    Attributes:
        time_step: [s].
        stiffness_ratio: k dt^2/m of the median spring and the mean free vertex.
        mean_rest_length: [m].
        objective_magnitude: magnitude of the objective's terms [J].
        objective_initial: g0 [J].
        minima: objective values of the known minima, ascending [J].
        minimum_ids: stable names of the minima, whose order may change.
        uncertified_reason: why the lowest minimum is not certified; empty if it is.
        is_liu2013: whether it belongs to the reproduction of Liu et al. 2013.
    """

    problem_digest: str
    scene: str
    size: int
    vertices: int
    snapshot: str
    frame: int
    integrator: str
    time_step: float
    stiffness_ratio: float
    mean_rest_length: float
    objective_magnitude: float
    objective_initial: float
    minima: tuple[float, ...]
    minimum_ids: tuple[str, ...]
    uncertified_reason: str
    is_liu2013: bool

    @property
    def objective_lowest(self) -> float:
        """g* [J]; nan if no minimum is known."""
        return self.minima[0] if self.minima else np.nan

    @property
    def mesh_label(self) -> str:
        """The scene and its size."""
        return f"{self.scene} {self.size}" if self.size else self.scene

    @property
    def problem_label(self) -> str:
        """Mesh, snapshot and, if not implicit Euler, the integrator.

        Problems that differ otherwise share the label.
        """
        frame = "" if self.snapshot.startswith("frame") else f" (frame {self.frame})"
        euler = "" if self.integrator == "implicit-euler" else f", {self.integrator}"
        return f"{self.mesh_label}, {self.snapshot}{frame}{euler}"

    @property
    def roundoff_gap(self) -> float:
        """The gap below which energies are round-off; infinite if the step starts at its minimum."""
        scale = self.objective_initial - self.objective_lowest
        return float(np.finfo(np.float64).eps) * self.objective_magnitude / scale if scale > 0 else np.inf

    def compute_gap(self, g: FloatArray) -> FloatArray:
        """Compute the gaps of energies [J]."""
        return (g - self.objective_lowest) / (self.objective_initial - self.objective_lowest)

    def minimum_index(self, name: str | None) -> int | None:
        """Return the index of a minimum by its name.

        The lowest has index 0; None if the name is unknown.
        """
        return self.minimum_ids.index(name) if name in self.minimum_ids else None


@dataclass(frozen=True, slots=True, eq=False)
class ConvergenceCurve:
    """The convergence of one solver to the minimum of one problem.

    Attributes:
        family, citation: metadata of the solver.
        iterations, gap, stationarity: values (k,) of the recorded iterates.
        max_vertex_error: (k,) [mean rest lengths].
        seconds: (rounds, k) [s]; nan if not timed.
        warm_seconds, cold_seconds: preparation time [s]; nan if unknown.
        minimum_index: minimum that was reached.
        status, reason: values of the rows.
        is_preempted: whether other processes interrupted a round.
        recording_path: relative to the folder of the results, or "".
        source_fingerprint: fingerprint of the code that measured the curve.
    """

    problem: SnapshotProblem
    solver: str
    family: str
    citation: str
    label: str
    parameters: str
    initial_guess: str
    threads: int
    iterations: FloatArray
    gap: FloatArray
    max_vertex_error: FloatArray
    stationarity: FloatArray
    seconds: FloatArray
    warm_seconds: float
    cold_seconds: float
    minimum_index: int | None
    status: str
    reason: str
    is_preempted: bool
    recording_path: str
    source_fingerprint: str


@dataclass(frozen=True, slots=True)
class WorkPoint:
    """One simulation up to `t_end` [s], with its error and its cost.

    Times are wall seconds per simulated second unless stated otherwise; nan if the simulation failed.

    Attributes:
        family, citation, is_minimiser, is_substepping: metadata of the solver.
        cpu_seconds_per_simulated_second: smallest CPU time of a round, per simulated second.
        round_seconds: wall time of each round [s].
        is_preempted: whether other processes interrupted a round.
        stiffness: k/m [1/s^2] of the median spring and the mean free vertex.
        source_fingerprint: fingerprint of the code that measured the simulation.
    """

    scene: str
    size: int
    solver: str
    family: str
    citation: str
    is_minimiser: bool
    is_substepping: bool
    label: str
    parameters: str
    integrator: str
    time_step: float
    residual_rtol: float | None
    max_iterations: int
    initial_guess: str
    t_end: float
    error: float
    reference_kind: str
    seconds_per_simulated_second: float
    cpu_seconds_per_simulated_second: float
    round_seconds: tuple[float, ...]
    is_preempted: bool
    vertices: int
    stiffness: float
    status: str
    reason: str
    source_fingerprint: str

    @property
    def mesh_label(self) -> str:
        """The scene and its size."""
        return f"{self.scene} {self.size}" if self.size else self.scene

    @property
    def setting_label(self) -> str:
        """The solver, the integrator, the time step and the stop rule in words."""
        stop = format_stop_rule(self.residual_rtol, self.max_iterations)
        steps = "" if self.is_substepping else f"{self.integrator}, "
        return f"{self.label}, {steps}dt {format_time_step(self.time_step)}, {stop}"


def format_stop_rule(residual_rtol: float | None, max_iterations: int) -> str:
    """Format the stop rule of a step's iterations.

    Args:
        residual_rtol: relative tolerance of the residual; 0 if it is derived from the scene, None for no tolerance.
        max_iterations: number of iterations, which is stated only where there is no tolerance.
    """
    if residual_rtol is None:
        return f"{max_iterations} iterations"
    return f"tolerance {residual_rtol:g}" if residual_rtol else "tolerance auto"


@dataclass(frozen=True, slots=True)
class AccuracyData:
    """All data of the rows, in their order.

    Attributes:
        machine_words: processor, threads and commit in words.
        newest_fingerprint: source fingerprint of the latest rows.
    """

    problems: tuple[SnapshotProblem, ...]
    curves: tuple[ConvergenceCurve, ...]
    work_points: tuple[WorkPoint, ...]
    machine_words: tuple[str, ...]
    newest_fingerprint: str


def describe_stale_results(
    measured: Iterable[ConvergenceCurve | WorkPoint], newest_fingerprint: str | None = None
) -> list[str]:
    """Describe which results were measured by other code, in at most one sentence.

    It is for charts that do not mark stale results at their points.

    Args:
        measured: curves or simulations.
        newest_fingerprint: source fingerprint to compare with; None for the current version.
    """
    names = sorted({one.label for one in measured if is_stale(one.source_fingerprint, newest_fingerprint)})
    than = "today's" if newest_fingerprint is None else "that of the newest rows"
    return [f"Measured by other code than {than}, in whole or in part: {', '.join(names)}."] if names else []


def describe_self_converged(works: Iterable[WorkPoint]) -> list[str]:
    """Describe which meshes have errors relative to a self-converged motion, in at most one sentence."""
    names = sorted({work.mesh_label for work in works if work.reference_kind == "self-converged"})
    return [f"Errors by a self-converged reference, for there is contact: {', '.join(names)}."] if names else []


LONG_CURVE_ITERATIONS = 500
"""Minimum iterations of a curve of the reproduction that is drawn separately; figure 2 of the paper has 1000."""


def without_short_curves(table: AccuracyData) -> AccuracyData:
    """Return the data without the short curves of the reproduction.

    Only the means of these curves are used, for figure 3 of the paper.
    """
    long = {
        c.problem.problem_digest
        for c in table.curves
        if not c.problem.is_liu2013 or c.iterations.max(initial=0.0) >= LONG_CURVE_ITERATIONS
    }
    problems = tuple(p for p in table.problems if p.problem_digest in long)
    return replace(table, problems=problems, curves=tuple(c for c in table.curves if c.problem.problem_digest in long))
