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
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.methods.time_stepping.explicit_forces import (
    ExplicitForces,
    SingleIterateState,
    estimate_max_frequency,
)
from springbench.solvers.methods.time_stepping.explicit_integrator_kernels import (
    AdaptiveSteps,
    FrameMotions,
    FrameStart,
    SplittingSteps,
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

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve whose only iteration is the whole step.

        Args:
            problem: step that is integrated from its start.
            initial_guess: not used.
        """
        motions, _ = self.integrate_frames(problem)
        return SingleIterateState(motions.positions[0], motions.velocities[0])

    def integrate_frames(
        self, problem: StepProblem, num_frames: int = 1, h: float | None = None
    ) -> tuple[FrameMotions, NDArray[np.float64]]:
        """Integrate frames with the same external force and pin targets.

        Args:
            problem: step problem of the first frame.
            num_frames: number of frames.
            h: first substep [s] of an adaptive method; by default from the largest frequency.

        Returns:
            Motions at the ends of the frames, up to one that cannot be finished, and their statistics, as in
            `integrate_adaptive`.

        Raises:
            RuntimeError: the first frame cannot be finished.
        """
        begin, shape = problem.step_start, (num_frames, self.system.num_vertices, 3)
        start = FrameStart(
            as_kernel_array(begin.positions),
            as_kernel_array(begin.velocity),
            as_kernel_array(problem.external_force),
            as_kernel_array(problem.pin_targets),
        )
        motions, step_stats = FrameMotions(np.empty(shape), np.empty(shape)), np.empty((num_frames, 4))
        forces, rows = self.explicit_forces.frame_forces, self.explicit_forces.motion_rows
        if isinstance(self.method, SplittingMethod):
            steps = self._splitting_steps
            self._run_splitting.call(forces, steps, start, rows, motions)
            step_stats[:] = steps.num_steps, 0.0, steps.step_size, steps.frame_length
            return motions, step_stats
        done = self._integrate_adaptive.call(
            forces, *self._tableau, self._choose_steps(h), start, rows, motions, step_stats
        )
        if not done:
            accepted, rejected, last, reached = step_stats[0]
            tolerance, frame = self.substep_choice.tolerance, self.system.time_step
            raise RuntimeError(format_step_failure(accepted + rejected, last, reached, frame, tolerance))
        return FrameMotions(motions.positions[:done], motions.velocities[:done]), step_stats[:done]

    @cached_property
    def _run_splitting(self) -> TypedKernel:
        return TypedKernel(run_splitting)

    @cached_property
    def _integrate_adaptive(self) -> TypedKernel:
        return TypedKernel(integrate_adaptive)

    @cached_property
    def _splitting_steps(self) -> SplittingSteps:
        assert isinstance(self.method, SplittingMethod)
        frame, count = float(self.system.time_step), self.substep_choice.num_substeps
        h = frame / count
        decay, gain = integrate_drag(self.method.kicks, h, self.explicit_forces.frame_forces.drag_rate)
        free, rates = np.flatnonzero(self.system.unpinned_mask), self.explicit_forces.drag_rate
        if len(free) and (rates[free] == rates[free[0]]).all():  # the velocity of a pinned vertex is zero
            decay, gain = (np.array(x[:, 4 * free[0]])[:, None] for x in (decay, gain))
        return SplittingSteps(self.method.drifts, decay, gain, count, h, frame)

    @cached_property
    def _tableau(self) -> tuple[TableauCoefficients, StageScratch]:
        """Coefficients of a Runge-Kutta method, and its scratch."""
        method = self.method
        assert isinstance(method, ExplicitTableau)
        weights = method.error_weights if self.substep_choice.tolerance else np.zeros((1, len(method.a)))
        return (
            TableauCoefficients(method.a, method.stage_times, weights),
            StageScratch.from_sizes(len(method.a), len(self.explicit_forces.motion_rows.p)),
        )

    def _choose_steps(self, h: float | None) -> AdaptiveSteps:
        """Choose the steps of a Runge-Kutta method, of which the first has size h [s]."""
        steps = self._adaptive_steps
        return steps._replace(initial_step=min(steps.frame_length, h)) if h and self.substep_choice.tolerance else steps

    @cached_property
    def _adaptive_steps(self) -> AdaptiveSteps:
        """The steps of a Runge-Kutta method, the first one of its default size."""
        assert isinstance(self.method, ExplicitTableau)
        frame, taken = float(self.system.time_step), self.substep_choice
        first = min(frame, 1.0 / taken.fastest_rate if taken.fastest_rate else frame)
        return AdaptiveSteps(
            frame,
            taken.tolerance or 1.0,
            float(compute_max_steps(taken.num_substeps, taken.tolerance)),
            first if taken.tolerance else frame / taken.num_substeps,
            build_pi_controller(self.method.error_exponent, _MAX_STEP_FACTOR, _FAILURE_FACTOR),
        )
