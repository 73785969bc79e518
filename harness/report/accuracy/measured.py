"""The rows of an accuracy measurement as problems, curves and simulations (`harness.experiments.accuracy`).

The gap of an energy g is (g - g*)/(g0 - g*): g0 at the current positions (in the paper's reproduction at the inertial
target), g* of the lowest minimum that is known. Rows hold energies, so a lower minimum mends all gaps at once.
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
    """A frozen step. g0, minima (ascending), magnitude [J]; mean_rest_length [m]; time_step [s].

    names: of the minima, stable while their order may change; doubt: why `best` is no certified minimum, empty where
    it is; paper: whether it belongs to the reproduction of the paper.
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
        """g* [J]; nan where nothing is known."""
        return self.minima[0] if self.minima else np.nan

    @property
    def mesh(self) -> str:
        """The scene and its size."""
        return f"{self.scene} {self.size}" if self.size else self.scene

    @property
    def name(self) -> str:
        """Mesh and moment; problems that differ in nothing else have the same."""
        frame = "" if self.moment.startswith("frame") else f" (frame {self.frame})"
        euler = "" if self.integrator == "implicit-euler" else f", {self.integrator}"
        return f"{self.mesh}, {self.moment}{frame}{euler}"

    @property
    def round_off(self) -> float:
        """The gap below which energies are round-off; infinite where the step starts at its minimum."""
        scale = self.g0 - self.best
        return float(np.finfo(np.float64).eps) * self.magnitude / scale if scale > 0 else np.inf

    def gap(self, g: Values) -> Values:
        """The gaps of energies [J]."""
        return (g - self.best) / (self.g0 - self.best)

    def branch(self, name: str | None) -> int | None:
        """The number of the minimum of this name, 0 for the lowest; None for none."""
        return self.names.index(name) if name in self.names else None


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One solver's way to the minimum of one problem; family, reference: what it states of itself.

    iterations, gap, largest [mean rest lengths], stationarity (k,); seconds (rounds, k), nan where not timed;
    warm, cold: seconds to prepare, nan where not known; branch: the minimum that was reached;
    status and reason: of the rows; recording: relative to the results' folder, or ""; code: by which it was measured.
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
    """One simulation of a horizon [s]: its relative error, and wall seconds a simulated second (nan if it failed).

    family, reference, minimises, own_steps: what the solver states of itself; code: by which it was measured; cpu: CPU
    seconds a simulated second of the best round; stiffness: k/m [1/s^2] of the median spring and the mean free vertex.
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
        """What was chosen, in words."""
        stop = stop_words(self.tolerance, self.iterations)
        steps = "" if self.own_steps else f"{self.integrator}, "
        return f"{self.label}, {steps}dt {step_words(self.time_step)}, {stop}"


def stop_words(tolerance: float | None, iterations: int) -> str:
    """What ends a step's iterations."""
    if tolerance is None:
        return f"{iterations} iterations"
    return f"tolerance {tolerance:g}" if tolerance else "tolerance auto"


@dataclass(frozen=True, slots=True)
class Measurements:
    """All that the rows say, in their order; machine: processor, threads and commit, in words; newest: the
    code of the rows that were measured last."""

    problems: tuple[Problem, ...]
    curves: tuple[Curve, ...]
    works: tuple[WorkPoint, ...]
    machine: tuple[str, ...]
    newest: str


def older(one: Curve | WorkPoint) -> bool:
    """Whether other code than today's measured it; of rows that do not say by which code nobody can tell."""
    return one.code not in ("", machine.code_hash())


def by_other_code(measured: Iterable[Curve | WorkPoint], newest: str | None = None) -> list[str]:
    """A sentence about those that other code than today's measured, or than `newest`, if there are any: for what has no
    marks of its own for them."""
    names = sorted({one.label for one in measured if (older(one) if newest is None else one.code != newest)})
    than = "today's" if newest is None else "that of the newest rows"
    return [f"Measured by other code than {than}, in whole or in part: {', '.join(names)}."] if names else []


def by_self_converged(works: Iterable[WorkPoint]) -> list[str]:
    """A sentence about the meshes whose errors are told by a self-converged motion, if there are any."""
    names = sorted({work.mesh for work in works if work.truth == "self-converged"})
    return [f"Errors by a self-converged reference, for there is contact: {', '.join(names)}."] if names else []


LONG = 500
"""Iterations from which on a curve of the paper's reproduction is worth a picture of its own: Figure 2 has 1000."""


def without_short(table: Measurements) -> Measurements:
    """The table less the many short curves from which the paper's Figure 3 takes means."""
    long = {c.problem.digest for c in table.curves if not c.problem.paper or c.iterations.max(initial=0.0) >= LONG}
    problems = tuple(p for p in table.problems if p.digest in long)
    return replace(table, problems=problems, curves=tuple(c for c in table.curves if c.problem.digest in long))
