"""Explicit integrators with substeps chosen by a stability bound or an error tolerance.

    v' = M^-1 (f - grad E(p)) - c v,    p' = v

Compositions of kicks and drifts are symplectic: without drag their energy stays near its initial value for long times.
The Runge-Kutta methods of Tsitouras and of Dormand and Prince choose their substeps adaptively, by an error estimate.
The substeps of the other methods are stable while omega h is below a limit of the method, where omega^2 is the largest
eigenvalue of M^-1 A'KA, the value for springs at their largest stiffness.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.methods.time_stepping.explicit_forces import (
    ExplicitForces,
    SingleIterateState,
    estimate_max_frequency,
    pad_rows,
)
from springbench.solvers.methods.time_stepping.explicit_integrator_kernels import (
    AdaptiveSteps,
    FrameForces,
    StageScratch,
    TableauCoefficients,
    integrate_adaptive,
    run_splitting,
)
from springbench.solvers.methods.time_stepping.explicit_tableaus import (
    BLANES_MOAN_4,
    BLANES_MOAN_6,
    DORMAND_PRINCE_8,
    RUNGE_KUTTA_4,
    TSITOURAS_5,
    VELOCITY_VERLET,
    ExplicitTableau,
    SplittingMethod,
    compute_max_steps,
    integrate_drag,
)
from springbench.solvers.methods.time_stepping.substep_choice import (
    STABILITY_SAFETY,
    PreparedSubstepping,
    SubstepChoice,
    format_step_failure,
    require_few_evaluations,
)
from springbench.solvers.model.integrators.step_size_controller import build_pi_controller
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, System

_MAX_STEP_FACTOR, _FAILURE_FACTOR = 5.0, 0.2
"""Largest increase of the step size after one step; its decrease after a step that is not finite."""


@dataclass(frozen=True)
class ExplicitSolver:
    """Base class of the explicit solvers."""

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_name: ClassVar[str]
    coefficients: ClassVar[SplittingMethod | ExplicitTableau]

    def _prepare_explicit(self, system: System, substeps: int, error: float) -> PreparedSolver:
        """Prepare the method for a system.

        Args:
            system: the system.
            substeps: multiple of the smallest stable number of substeps.
            error: tolerance relative to the mean spring length, 0 for fixed substeps.
        """
        vertex_terms.require_implicit_euler(system, self.solver_name)
        vertex_terms.require_mass(system, np.where(system.unpinned_mask, system.mass, np.inf), self.solver_name)
        method, parts = self.coefficients, ExplicitForces.from_system(system, self.solver_name)
        omega = estimate_max_frequency(system)
        rate = omega + float(parts.drag_rate.max(initial=0.0))
        needed = substeps * max(1.0, ceil(system.time_step * rate / (STABILITY_SAFETY * method.stability_limit)))
        require_few_evaluations(self.solver_name, needed, method.num_evaluations, len(parts.springs.edges))
        soft = int((~system.pins.exact_mask).sum())
        exact = f"; {soft} pins by penalty taken as exact" if soft else ""
        description = (
            f"steps by an error of {error:.3g}"
            if error
            else f"{needed:.0f} substeps of {system.time_step / needed:.2g} s"
        )
        lengths = parts.springs.rest_length
        tolerance = error * (float(lengths.mean()) if len(lengths) else 1.0)
        choice = f"{description}, for vibrations of at most {omega:.3g} rad/s{exact}"
        taken = SubstepChoice(int(needed), tolerance, rate, choice)
        return PreparedExplicit(method, taken, system, parts)


@dataclass(frozen=True)
class _FixedStepSolver(ExplicitSolver):
    """Explicit solver with fixed substeps.

    Args:
        refinement_factor: number of substeps as a multiple of the smallest stable number.
    """

    refinement_factor: int = 1

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        if not self.refinement_factor >= 1:
            raise ValueError(f"refinement_factor: should be at least 1, not {self.refinement_factor}")

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, constant quadratic forms and drag on vertices; for integrators
                other than `substepping` and implicit Euler; for unpinned vertices without mass; for too many substeps.
        """
        return self._prepare_explicit(system, self.refinement_factor, 0.0)


@dataclass(frozen=True)
class _AdaptiveStepSolver(ExplicitSolver):
    """Explicit solver with adaptive substeps.

    Args:
        error_tolerance: error of each substep, root mean square over the vertices, relative to the mean spring length.
            An error of velocity counts by the displacement that it causes in a frame.
    """

    error_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        if not 1e-14 <= self.error_tolerance <= 1.0:
            raise ValueError(f"error_tolerance: should be from 1e-14 to 1, not {self.error_tolerance}")

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: as for fixed substeps.
        """
        return self._prepare_explicit(system, 1, self.error_tolerance)


def _explicit_info(
    authors: str,
    year: int,
    title: str,
    doi: str = "",
    *,
    has_fixed_step: bool = False,
    formula: str = "",
    cost: str = "",
) -> SolverInfo:
    return SolverInfo(
        "explicit",
        Citation(authors, year, title, doi),
        is_substepping=True,
        supports_error_control=True,
        has_fixed_step=has_fixed_step,
        formula=formula,
        cost=cost,
    )


_HAIRER_INFO = _explicit_info(
    "Hairer, Ernst and Norsett, Syvert Paul and Wanner, Gerhard",
    1993,
    "Solving Ordinary Differential Equations I",
    "10.1007/978-3-540-78862-1",
)
_BLANES_MOAN_INFO = _explicit_info(
    "Blanes, Sergio and Moan, Per Christian",
    2002,
    "Practical symplectic partitioned Runge-Kutta and Runge-Kutta-Nyström methods",
    "10.1016/S0377-0427(01)00492-7",
    has_fixed_step=True,
)


@dataclass(frozen=True)
class VelocityVerlet(_FixedStepSolver):
    """Velocity Verlet: kick, drift, kick; symplectic, order 2, one force evaluation per substep."""

    solver_name: ClassVar[str] = "velocity-verlet"
    solver_info: ClassVar[SolverInfo] = _explicit_info(
        "Swope, William C. and Andersen, Hans C. and Berens, Peter H. and Wilson, Kent R.",
        1982,
        "A computer simulation method for the calculation of equilibrium constants",
        "10.1063/1.442716",
        has_fixed_step=True,
        formula="kick h/2, drift h, kick h/2",
        cost="1 pass per substep",
    )
    coefficients: ClassVar[SplittingMethod | ExplicitTableau] = VELOCITY_VERLET


@dataclass(frozen=True)
class BlanesMoan4(_FixedStepSolver):
    """Symplectic composition of Blanes and Moan, order 4, six force evaluations per substep."""

    solver_name: ClassVar[str] = "blanes-moan-4"
    solver_info: ClassVar[SolverInfo] = replace(
        _BLANES_MOAN_INFO,
        formula="symplectic kicks and drifts, order 4",
        cost="6 passes per substep",
    )
    coefficients: ClassVar[SplittingMethod | ExplicitTableau] = BLANES_MOAN_4


@dataclass(frozen=True)
class BlanesMoan6(_FixedStepSolver):
    """Symplectic composition of Blanes and Moan, order 6, ten force evaluations per substep."""

    solver_name: ClassVar[str] = "blanes-moan-6"
    solver_info: ClassVar[SolverInfo] = replace(
        _BLANES_MOAN_INFO,
        formula="symplectic kicks and drifts, order 6",
        cost="10 passes per substep",
    )
    coefficients: ClassVar[SplittingMethod | ExplicitTableau] = BLANES_MOAN_6


@dataclass(frozen=True)
class RungeKutta4(_FixedStepSolver):
    """Kutta's Runge-Kutta method of order 4, four force evaluations per substep."""

    solver_name: ClassVar[str] = "runge-kutta-4"
    solver_info: ClassVar[SolverInfo] = replace(
        _HAIRER_INFO,
        supports_error_control=False,
        has_fixed_step=True,
        formula="classical Runge-Kutta method, order 4",
        cost="4 passes per substep",
    )
    coefficients: ClassVar[SplittingMethod | ExplicitTableau] = RUNGE_KUTTA_4


@dataclass(frozen=True)
class Tsitouras5(_AdaptiveStepSolver):
    """Tsitouras's embedded pair of orders 5 and 4, six force evaluations per substep."""

    solver_name: ClassVar[str] = "tsitouras-5"
    solver_info: ClassVar[SolverInfo] = _explicit_info(
        "Tsitouras, Charalampos",
        2011,
        "Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption",
        "10.1016/j.camwa.2011.06.002",
        formula="Runge-Kutta pair of orders 5(4)",
        cost="6 passes per substep",
    )
    coefficients: ClassVar[SplittingMethod | ExplicitTableau] = TSITOURAS_5


@dataclass(frozen=True)
class DormandPrince8(_AdaptiveStepSolver):
    """Dormand and Prince's method of orders 8(5,3), twelve force evaluations per substep."""

    solver_name: ClassVar[str] = "dormand-prince-8"
    solver_info: ClassVar[SolverInfo] = replace(
        _HAIRER_INFO,
        formula="Runge-Kutta method of orders 8(5,3)",
        cost="12 passes per substep",
    )
    coefficients: ClassVar[SplittingMethod | ExplicitTableau] = DORMAND_PRINCE_8


@dataclass(frozen=True, eq=False)
class PreparedExplicit(PreparedSubstepping, IterativeSolver):
    """Explicit integrator, prepared for a system; runs on the CPU."""

    system: System
    explicit_forces: ExplicitForces
    stats: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def description(self) -> str:
        """Description of the chosen substeps."""
        return self.substep_choice.description

    @cached_property
    def _inverse_mass_rows(self) -> NDArray[np.float64]:
        """1/m [1/kg] in rows of four, 0 for pinned vertices."""
        s = self.system
        return _expand_to_rows(np.divide(1.0, s.mass, out=np.zeros(s.num_vertices), where=s.unpinned_mask))

    @cached_property
    def _drag_rate_rows(self) -> NDArray[np.float64]:
        return _expand_to_rows(self.explicit_forces.drag_rate)

    @cached_property
    def _kick_factors(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Decay and gain of the velocities by the kicks of a substep."""
        assert isinstance(self.method, SplittingMethod)
        h = self.system.time_step / self.substep_choice.num_substeps
        return integrate_drag(self.method.kicks, h, self._drag_rate_rows)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve whose only iteration is the whole step.

        Args:
            problem: step that is integrated from its start.
            initial_guess: not used.
        """
        return SingleIterateState(*self.step(problem)[:2])

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, NDArray[np.float64]]:
        """Integrate one step.

        Args:
            problem: the step problem.
            h: first substep [s] of an adaptive method; by default from the largest frequency.

        Returns:
            Positions and velocities (n, 3) at the end of the step, and the statistics of `integrate_adaptive`.
        """
        s, pins, start, frame = self.system, self.system.pins.vertices, problem.step_start, self.system.time_step
        begin, end = np.ascontiguousarray(start.positions[pins]), problem.pin_targets.copy()
        p, v = pad_rows(start.positions, pad_far=True), pad_rows(start.velocity)
        v.reshape(-1, 4)[pins] = 0.0
        force = pad_rows(problem.external_force + self.explicit_forces.constant_force)
        right, x = (
            self.explicit_forces.spring_packets.build_right_hand_side(np.zeros(s.num_vertices + 2), force),
            self.explicit_forces,
        )
        forces = FrameForces(
            x.spring_packets,
            right,
            x.form_pairs,
            x.form_weight,
            x.form_vertex_weight,
            self._inverse_mass_rows,
            self._drag_rate_rows,
            pins.copy(),
            begin,
            end,
        )
        count = self.substep_choice.num_substeps
        step_stats = np.array([count, 0.0, frame / count, frame])
        if isinstance(self.method, SplittingMethod):
            self._compose(forces, self.method, p, v)
        else:
            self._integrate(forces, self.method, p, v, h, step_stats)
        velocity = v.reshape(-1, 4)[: s.num_vertices, :3].copy()
        velocity[pins] = (end - begin) / frame
        return p.reshape(-1, 4)[: s.num_vertices, :3].copy(), velocity, step_stats

    @cached_property
    def _run_splitting(self) -> TypedKernel:
        return TypedKernel(run_splitting)

    def _compose(
        self, forces: FrameForces, method: SplittingMethod, p: NDArray[np.float64], v: NDArray[np.float64]
    ) -> None:
        count = self.substep_choice.num_substeps
        h = self.system.time_step / count
        self._run_splitting.call(forces, method.drifts, *self._kick_factors, count, h, p, v, np.zeros_like(v))

    def _integrate(
        self,
        forces: FrameForces,
        method: ExplicitTableau,
        p: NDArray[np.float64],
        v: NDArray[np.float64],
        h: float | None,
        step_stats: NDArray[np.float64],
    ) -> None:
        frame, taken, fixed = self.system.time_step, self.substep_choice, not self.substep_choice.tolerance
        first = (
            frame / taken.num_substeps
            if fixed
            else min(frame, h or (1.0 / taken.fastest_rate if taken.fastest_rate else frame))
        )
        errors = np.zeros((1, len(method.a))) if fixed else method.error_weights
        most = float(compute_max_steps(taken.num_substeps, taken.tolerance))
        controller = build_pi_controller(method.error_exponent, _MAX_STEP_FACTOR, _FAILURE_FACTOR)
        steps = AdaptiveSteps(frame, taken.tolerance or 1.0, most, first, controller)
        stages = TableauCoefficients(method.a, method.stage_times, errors)
        integrate_adaptive(forces, stages, steps, p, v, StageScratch.from_sizes(len(method.a), len(p)), step_stats)
        if step_stats[3] < frame:
            raise RuntimeError(
                format_step_failure(step_stats[0] + step_stats[1], step_stats[2], step_stats[3], frame, taken.tolerance)
            )


def _expand_to_rows(of_vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Repeat the value of each vertex for the three coordinates of its row.

    The fourth number of a row and the padding rows are zero.
    """
    return pad_rows(np.repeat(of_vertices[:, None], 3, axis=1))
