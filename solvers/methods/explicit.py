"""Explicit integrators with substeps chosen by a stability bound or an error tolerance.

    v' = M^-1 (f - grad E(p)) - c v,    p' = v

Compositions of kicks and drifts are symplectic: without drag their energy stays near its initial value for long times.
The Runge-Kutta methods of Tsitouras and of Dormand and Prince choose their substeps adaptively, by an error estimate.
The substeps of the other methods are stable while omega h is below a limit of the method, where omega^2 is the largest
eigenvalue of M^-1 A'KA, the value for springs at their largest stiffness.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import ceil
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.core import vertex_terms
from solvers.core.driver import Iterating, Iterative
from solvers.core.explicit_tables import (
    BLANES_MOAN_4,
    BLANES_MOAN_6,
    RUNGE_KUTTA_4,
    TSITOURAS_5,
    VERLET,
    Composition,
    Tableau,
    dormand_prince_8,
    in_time,
    most_steps,
)
from solvers.core.forces import ForceParts, Whole, frequency, rows_of_four
from solvers.core.substeps import Substepping, Substeps
from solvers.kernels.explicit_steps import Coefficients, Forces, Scratch, Subdivision, compose, integrate
from solvers.problem import Positions, Prepared, StepProblem, System, Unsupported

_SAFETY = 0.95
"""Fraction of the stability limit: at the limit a vibration neither grows nor decays, and springs are nonlinear."""

_MOST = 1e9
"""Maximum number of spring evaluations in a step, some seconds: compiled code cannot be interrupted meanwhile."""


@dataclass(frozen=True)
class Explicit:
    """Base class of the explicit solvers."""

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    name: ClassVar[str]
    coefficients: ClassVar[Composition | Tableau]

    def method(self) -> Composition | Tableau:
        """Return the coefficients of the method."""
        return self.coefficients

    def _prepared(self, system: System, substeps: int, error: float) -> Prepared:
        """Prepare the method for a system.

        Args:
            system: the system.
            substeps: multiple of the smallest stable number of substeps.
            error: tolerance relative to the mean spring length, 0 for fixed substeps.
        """
        vertex_terms.require_implicit_euler(system, self.name)
        vertex_terms.require_mass(system, np.where(system.unpinned, system.mass, np.inf), self.name)
        method, parts = self.method(), ForceParts.of(system, self.name)
        omega = frequency(system)
        rate = omega + float(parts.drag.max(initial=0.0))
        needed = substeps * max(1.0, ceil(system.time_step * rate / (_SAFETY * method.limit)))
        if needed * method.evaluations * max(1, len(parts.springs.edges)) > _MOST:
            raise Unsupported(
                f"{self.name}: is stable with {needed:.3g} substeps a step of {method.evaluations} evaluations, which "
                f"for {len(parts.springs.edges)} springs are beyond the {_MOST:.0e} allowed; take a shorter time step"
            )
        soft = int((~system.pins.exact).sum())
        exact = f"; {soft} pins by penalty taken as exact" if soft else ""
        told = (
            f"steps by an error of {error:.3g}"
            if error
            else f"{needed:.0f} substeps of {system.time_step / needed:.2g} s"
        )
        lengths = parts.springs.rest_length
        tolerance = error * (float(lengths.mean()) if len(lengths) else 1.0)
        choice = f"{told}, for vibrations of at most {omega:.3g} rad/s{exact}"
        taken = Substeps(int(needed), tolerance, rate, choice)
        return PreparedExplicit(method, taken, system, parts)


@dataclass(frozen=True)
class _Fixed(Explicit):
    """Explicit solver with fixed substeps.

    Args:
        refine: number of substeps as a multiple of the smallest stable number.
    """

    refine: int = 1

    def prepare(self, system: System) -> Prepared:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, constant quadratic forms and drag on vertices; for integrators
                other than `own` and implicit Euler; for unpinned vertices without mass; for too many substeps.
        """
        if not self.refine >= 1:
            raise Unsupported(f"{self.name}: refine came as {self.refine}; wanted 1 or more")
        return self._prepared(system, self.refine, 0.0)


@dataclass(frozen=True)
class _Controlled(Explicit):
    """Explicit solver with adaptive substeps.

    Args:
        error: error of each substep, root mean square over the vertices, relative to the mean spring length.
            An error of velocity counts by the displacement that it causes in a frame.
    """

    error: float = 1e-6

    def prepare(self, system: System) -> Prepared:
        """Prepare the method for a system.

        Raises:
            Unsupported: as for fixed substeps, and for a tolerance outside [1e-14, 1].
        """
        if not 1e-14 <= self.error <= 1.0:
            raise Unsupported(f"{self.name}: error came as {self.error}; wanted a number from 1e-14 to 1")
        return self._prepared(system, 1, self.error)


def _about(authors: str, year: int, title: str, doi: str = "", *, even: bool = False) -> About:
    return About("explicit", Reference(authors, year, title, doi), own_steps=True, to_error=True, even=even)


_HAIRER = _about(
    "Hairer, Ernst and Norsett, Syvert Paul and Wanner, Gerhard",
    1993,
    "Solving Ordinary Differential Equations I",
    "10.1007/978-3-540-78862-1",
)
_BLANES_MOAN = _about(
    "Blanes, Sergio and Moan, Per Christian",
    2002,
    "Practical symplectic partitioned Runge-Kutta and Runge-Kutta-Nyström methods",
    "10.1016/S0377-0427(01)00492-7",
    even=True,
)


@dataclass(frozen=True)
class VelocityVerlet(_Fixed):
    """Velocity Verlet: kick, drift, kick; symplectic, order 2, one force evaluation per substep."""

    name: ClassVar[str] = "velocity-verlet"
    about: ClassVar[About] = _about(
        "Swope, William C. and Andersen, Hans C. and Berens, Peter H. and Wilson, Kent R.",
        1982,
        "A computer simulation method for the calculation of equilibrium constants",
        "10.1063/1.442716",
        even=True,
    )
    coefficients: ClassVar[Composition | Tableau] = VERLET


@dataclass(frozen=True)
class BlanesMoan4(_Fixed):
    """Symplectic composition of Blanes and Moan, order 4, six force evaluations per substep."""

    name: ClassVar[str] = "blanes-moan-4"
    about: ClassVar[About] = _BLANES_MOAN
    coefficients: ClassVar[Composition | Tableau] = BLANES_MOAN_4


@dataclass(frozen=True)
class BlanesMoan6(_Fixed):
    """Symplectic composition of Blanes and Moan, order 6, ten force evaluations per substep."""

    name: ClassVar[str] = "blanes-moan-6"
    about: ClassVar[About] = _BLANES_MOAN
    coefficients: ClassVar[Composition | Tableau] = BLANES_MOAN_6


@dataclass(frozen=True)
class RungeKutta4(_Fixed):
    """Kutta's Runge-Kutta method of order 4, four force evaluations per substep."""

    name: ClassVar[str] = "runge-kutta-4"
    about: ClassVar[About] = replace(_HAIRER, to_error=False, even=True)
    coefficients: ClassVar[Composition | Tableau] = RUNGE_KUTTA_4


@dataclass(frozen=True)
class Tsitouras5(_Controlled):
    """Tsitouras's embedded pair of orders 5 and 4, six force evaluations per substep."""

    name: ClassVar[str] = "tsitouras-5"
    about: ClassVar[About] = _about(
        "Tsitouras, Charalampos",
        2011,
        "Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption",
        "10.1016/j.camwa.2011.06.002",
    )
    coefficients: ClassVar[Composition | Tableau] = TSITOURAS_5


@dataclass(frozen=True)
class DormandPrince8(_Controlled):
    """Dormand and Prince's method of order 8, error orders 5 and 3, twelve force evaluations per substep."""

    name: ClassVar[str] = "dormand-prince-8"
    about: ClassVar[About] = _HAIRER

    def method(self) -> Composition | Tableau:
        """Return the coefficients, taken from SciPy."""
        return dormand_prince_8()


@dataclass(frozen=True, eq=False)
class PreparedExplicit(Substepping, Iterative):
    """Explicit integrator, prepared for a system; runs on the CPU."""

    system: System
    parts: ForceParts
    facts: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def choice(self) -> str:
        """Description of the chosen substeps."""
        return self.substeps.choice

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve whose only iteration is the whole step."""
        return Whole(*self.step(problem)[:2])

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, NDArray[np.float64]]:
        """Integrate one step.

        Args:
            problem: the step problem.
            h: first substep [s] of an adaptive method; by default from the largest frequency.

        Returns:
            Positions and velocities (n, 3) at the end of the step, and the statistics of `integrate`.
        """
        s, pins, start, frame = self.system, self.system.pins.vertices, problem.start, self.system.time_step
        begin, end = np.ascontiguousarray(start.positions[pins]), problem.pin_targets.copy()
        p, v = rows_of_four(start.positions, far=True), rows_of_four(start.velocity)
        v.reshape(-1, 4)[pins] = 0.0
        force = rows_of_four(problem.force + self.parts.load)
        inverse = _of_rows(np.divide(1.0, s.mass, out=np.zeros(s.vertices), where=s.unpinned))
        right, x = self.parts.bundles.right(np.zeros(s.vertices + 2), force), self.parts
        forces = Forces(x.bundles, right, x.pairs, x.weight, x.held, inverse, _of_rows(x.drag), pins.copy(), begin, end)
        count = self.substeps.count
        told = np.array([count, 0.0, frame / count, frame])
        if isinstance(self.method, Composition):
            self._compose(forces, self.method, p, v)
        else:
            self._integrate(forces, self.method, p, v, h, told)
        velocity = v.reshape(-1, 4)[: s.vertices, :3].copy()
        velocity[pins] = (end - begin) / frame
        return p.reshape(-1, 4)[: s.vertices, :3].copy(), velocity, told

    def _compose(self, forces: Forces, method: Composition, p: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        count = self.substeps.count
        h = self.system.time_step / count
        kept, gained = in_time(method.kicks, h, forces.drag)
        compose(forces, method.drifts, kept, gained, count, h, p, v, np.zeros_like(v))

    def _integrate(
        self,
        forces: Forces,
        method: Tableau,
        p: NDArray[np.float64],
        v: NDArray[np.float64],
        h: float | None,
        told: NDArray[np.float64],
    ) -> None:
        frame, taken, fixed = self.system.time_step, self.substeps, not self.substeps.tolerance
        first = frame / taken.count if fixed else min(frame, h or (1.0 / taken.rate if taken.rate else frame))
        errors = np.zeros((1, len(method.a))) if fixed else method.errors
        most = float(most_steps(taken.count, taken.tolerance))
        steps = Subdivision(frame, taken.tolerance or 1.0, most, first)
        stages = Coefficients(method.a, method.times, errors, method.power)
        integrate(forces, stages, steps, p, v, Scratch.of(len(method.a), len(p)), told)
        if told[3] < frame:
            raise RuntimeError(method.unfinished(told[0] + told[1], told[2], told[3], frame, taken.tolerance))


def _of_rows(of_vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Repeat the value of each vertex for the four numbers of its row; zero for padding rows."""
    return rows_of_four(np.repeat(of_vertices[:, None], 3, axis=1))
