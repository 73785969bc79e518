"""The rows of an accuracy measurement as problems, curves and simulations (`harness.experiments.accuracy`).

The gap of an energy g is (g - g*)/(g0 - g*): g0 at the current positions (at the inertial target in the reproduction of
Liu et al. 2013), g* at the lowest known minimum. Rows contain energies, so a lower minimum corrects all gaps.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from harness.base import machine
from harness.report.page import step_words

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Problem:
    """A step snapshot.

    Attributes:
        time_step: [s].
        mean_rest_length: [m].
        magnitude: magnitude of the objective's terms [J].
        g0: g0 [J].
        minima: objective values of the known minima, ascending [J].
        names: stable names of the minima, whose order may change.
        doubt: why the lowest minimum is not certified; empty if it is.
        paper: whether it belongs to the reproduction of Liu et al. 2013.
    """

    digest: str
    scene: str
    size: int
    vertices: int
    moment: str
    frame: int
    integrator: str
    time_step: float
    stiffness_ratio: float
    mean_rest_length: float
    magnitude: float
    g0: float
    minima: tuple[float, ...]
    names: tuple[str, ...]
    doubt: str
    paper: bool

    @property
    def best(self) -> float:
        """g* [J]; nan if no minimum is known."""
        return self.minima[0] if self.minima else np.nan

    @property
    def mesh(self) -> str:
        """The scene and its size."""
        return f"{self.scene} {self.size}" if self.size else self.scene

    @property
    def name(self) -> str:
        """Mesh, snapshot and, if not implicit Euler, the integrator.

        Problems that differ otherwise share the label.
        """
        frame = "" if self.moment.startswith("frame") else f" (frame {self.frame})"
        euler = "" if self.integrator == "implicit-euler" else f", {self.integrator}"
        return f"{self.mesh}, {self.moment}{frame}{euler}"

    @property
    def round_off(self) -> float:
        """The gap below which energies are round-off; infinite if the step starts at its minimum."""
        scale = self.g0 - self.best
        return float(np.finfo(np.float64).eps) * self.magnitude / scale if scale > 0 else np.inf

    def gap(self, g: Values) -> Values:
        """Compute the gaps of energies [J]."""
        return (g - self.best) / (self.g0 - self.best)

    def branch(self, name: str | None) -> int | None:
        """Return the index of a minimum by its name.

        The lowest has index 0; None if the name is unknown.
        """
        return self.names.index(name) if name in self.names else None


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """The convergence of one solver to the minimum of one problem.

    Attributes:
        family, reference: metadata of the solver.
        iterations, gap, stationarity: values (k,) of the recorded iterates.
        largest: (k,) [mean rest lengths].
        seconds: (rounds, k) [s]; nan if not timed.
        warm, cold: preparation time [s]; nan if unknown.
        branch: minimum that was reached.
        status, reason: values of the rows.
        recording: relative to the folder of the results, or "".
        code: code that the curve was measured by.
    """

    problem: Problem
    solver: str
    family: str
    reference: str
    label: str
    parameters: str
    first_guess: str
    threads: int
    iterations: Values
    gap: Values
    largest: Values
    stationarity: Values
    seconds: Values
    warm: float
    cold: float
    branch: int | None
    status: str
    reason: str
    recording: str
    code: str


@dataclass(frozen=True, slots=True)
class WorkPoint:
    """One simulation up to `horizon` [s], with its error and its cost.

    Times are wall seconds per simulated second; nan if the simulation failed.

    Attributes:
        family, reference, minimises, own_steps: metadata of the solver.
        cpu: CPU time of the best round.
        stiffness: k/m [1/s^2] of the median spring and the mean free vertex.
        code: code that the simulation was measured by.
    """

    scene: str
    size: int
    solver: str
    family: str
    reference: str
    minimises: bool
    own_steps: bool
    label: str
    parameters: str
    integrator: str
    time_step: float
    tolerance: float | None
    iterations: int
    first_guess: str
    horizon: float
    error: float
    truth: str
    error_rms: float
    seconds: float
    cpu: float
    vertices: int
    stiffness: float
    status: str
    reason: str
    code: str

    @property
    def mesh(self) -> str:
        """The scene and its size."""
        return f"{self.scene} {self.size}" if self.size else self.scene

    @property
    def setting(self) -> str:
        """The solver, the integrator, the time step and the stop rule in words."""
        stop = stop_words(self.tolerance, self.iterations)
        steps = "" if self.own_steps else f"{self.integrator}, "
        return f"{self.label}, {steps}dt {step_words(self.time_step)}, {stop}"


def stop_words(tolerance: float | None, iterations: int) -> str:
    """Format the stop rule of a step's iterations."""
    if tolerance is None:
        return f"{iterations} iterations"
    return f"tolerance {tolerance:g}" if tolerance else "tolerance auto"


@dataclass(frozen=True, slots=True)
class Measurements:
    """All data of the rows, in their order.

    Attributes:
        machine: processor, threads and commit in words.
        newest: source fingerprint of the latest rows.
    """

    problems: tuple[Problem, ...]
    curves: tuple[Curve, ...]
    works: tuple[WorkPoint, ...]
    machine: tuple[str, ...]
    newest: str


def older(one: Curve | WorkPoint) -> bool:
    """Return whether other code than the current version measured it.

    Rows without a fingerprint count as current.
    """
    return one.code not in ("", machine.code_hash())


def by_other_code(measured: Iterable[Curve | WorkPoint], newest: str | None = None) -> list[str]:
    """Describe which results were measured by other code, in at most one sentence.

    For charts that have no marks of their own for stale results.

    Args:
        measured: curves or simulations.
        newest: source fingerprint to compare with; None for the current version.
    """
    names = sorted({one.label for one in measured if (older(one) if newest is None else one.code != newest)})
    than = "today's" if newest is None else "that of the newest rows"
    return [f"Measured by other code than {than}, in whole or in part: {', '.join(names)}."] if names else []


def by_self_converged(works: Iterable[WorkPoint]) -> list[str]:
    """Describe which meshes have errors relative to a self-converged motion, in at most one sentence."""
    names = sorted({work.mesh for work in works if work.truth == "self-converged"})
    return [f"Errors by a self-converged reference, for there is contact: {', '.join(names)}."] if names else []


LONG = 500
"""Iterations from which on a curve of the reproduction gets a picture of its own: Figure 2 of the paper has 1000."""


def without_short(table: Measurements) -> Measurements:
    """Return the data without the short curves of the reproduction.

    From these many curves only means for the paper's Figure 3 are taken.
    """
    long = {c.problem.digest for c in table.curves if not c.problem.paper or c.iterations.max(initial=0.0) >= LONG}
    problems = tuple(p for p in table.problems if p.digest in long)
    return replace(table, problems=problems, curves=tuple(c for c in table.curves if c.problem.digest in long))
