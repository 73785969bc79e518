"""Rosenbrock methods: linearly implicit, with one factorisation per step, one solve per stage, no iteration.

For p' = v, M v' = F(p) - D v and s = 1/(gamma h), a stage (u, w) of positions and velocities solves

    (s^2 M + s D + K) u = F(P) - D V + M sum c/h w_j + (s M + D) r,    w = s u - r,    r = V + sum c/h u_j

with P = p + sum a u_j and V = v + sum a w_j. The velocities are eliminated, so the matrix is that of a step problem. It
is factorised at the start of the step. K is the exact Hessian of the energies there, as the order conditions require.
If the step is too long for compressed springs, it may have no Cholesky factor. Adaptive steps are then halved. Fixed
steps reduce the springs' negative lateral stiffness (`springbench.solvers.methods.newton.hessian_regularisation`); only
ROS2 retains its order in that case.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.methods.newton.hessian_regularisation import explain_missing_factor, factorise_shifted
from springbench.solvers.methods.time_stepping.explicit_forces import SingleIterateState
from springbench.solvers.methods.time_stepping.rosenbrock_tableaus import (
    RODAS_TABLEAU,
    ROS2_TABLEAU,
    ROS3P_TABLEAU,
    RosenbrockTableau,
)
from springbench.solvers.methods.time_stepping.substep_choice import format_step_failure
from springbench.solvers.model.barrier_energy import is_barrier_energy
from springbench.solvers.model.energies.quadratic_energy import drag_of_vertices
from springbench.solvers.model.integrators.step_size_controller import (
    build_pi_controller,
    choose_next_step_size,
    compute_rejection_factor,
)
from springbench.solvers.model.step_problem import (
    NotPositiveDefinite,
    Positions,
    ResidualIterate,
    StepProblem,
    System,
    Unsupported,
    is_lagged,
)
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

_MAX_STEP_FACTOR, _FAILURE_FACTOR = 6.0, 0.5
"""Largest increase of the step size after one step; its decrease after a step without a factor or finite error."""
_MIN_STEP_FRACTION, _MAX_STEPS = 1e-9, 100_000
"""Shortest step, relative to a frame; maximum number of attempted steps in a frame."""


@dataclass(frozen=True)
class _RosenbrockSolver:
    """Base class of the Rosenbrock solvers.

    Args:
        refinement_factor: number of fixed steps in a frame, used if `error_tolerance` is 0.
        error_tolerance: error of each adaptive step, root mean square over the vertices, relative to the mean spring
            length. An error of velocity counts by the displacement that it causes in a frame.
    """

    refinement_factor: int = 1
    error_tolerance: float = 0.0

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_name: ClassVar[str]
    coefficients: ClassVar[RosenbrockTableau]

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        if not self.refinement_factor >= 1:
            raise ValueError(f"refinement_factor: should be at least 1, not {self.refinement_factor}")
        if not 0.0 <= self.error_tolerance <= 1.0:
            raise ValueError(f"error_tolerance: should be from 0 to 1, not {self.error_tolerance}")

    def prepare(self, system: System) -> PreparedRosenbrock:
        """Prepare the method for a system.

        Raises:
            Unsupported: for integrators other than `substepping` and implicit Euler, for unpinned vertices without
                mass, and for energies that depend on the start of a step, except drag on vertices.
        """
        vertex_terms.require_implicit_euler(system, self.solver_name)
        vertex_terms.require_mass(system, np.where(system.unpinned_mask, system.mass, np.inf), self.solver_name)
        drag, remaining_energies = np.zeros(system.num_vertices), list[Any]()
        for energy in system.energies:
            if (c := drag_of_vertices(energy)) is not None:
                drag += c
            elif is_lagged(energy) or is_barrier_energy(energy):
                raise Unsupported(
                    f"{self.solver_name}: needs the exact derivatives of all forces, and supports energies of the "
                    f"positions alone and drag on vertices; the scene has {type(energy).__name__} as well"
                )
            else:
                remaining_energies.append(energy)
        objective = FixedObjective(replace(system, energies=tuple(remaining_energies), inertia_factor=0.0))
        lengths, factor = objective.springs.rest_length, objective.hessian_matrix.factor
        tolerance = self.error_tolerance * (float(lengths.mean()) if len(lengths) else 1.0)
        step_rule = (
            f"steps by an error of {self.error_tolerance:.3g}"
            if self.error_tolerance
            else f"{self.refinement_factor} steps a frame"
        )
        choice = (
            f"{step_rule}, a factor of the Hessian with {factor.nonzeros:,} entries{objective.interpreted_energies}"
        )
        facts = {"nnz_hessian_factor": float(factor.nonzeros)}
        return PreparedRosenbrock(
            system, self.coefficients, objective, drag, self.refinement_factor, tolerance, choice, facts
        )


def _rosenbrock_info(authors: str, year: int, title: str, doi: str, *, formula: str = "", cost: str = "") -> SolverInfo:
    citation = Citation(authors, year, title, doi)
    return SolverInfo("linearly implicit", citation, is_substepping=True, formula=formula, cost=cost)


@dataclass(frozen=True)
class Ros2(_RosenbrockSolver):
    """ROS2: two stages, order 2 for any matrix; L-stable."""

    solver_name: ClassVar[str] = "ros2"
    coefficients: ClassVar[RosenbrockTableau] = ROS2_TABLEAU
    solver_info: ClassVar[SolverInfo] = _rosenbrock_info(
        "Verwer, Jan G. and Spee, Edwin J. and Blom, Joke G. and Hundsdorfer, Willem",
        1999,
        "A second-order Rosenbrock method applied to photochemical dispersion problems",
        "10.1137/S1064827597326651",
        formula="Rosenbrock method of orders 2(1)",
        cost="1 factorisation, 2 solves and passes per step",
    )


@dataclass(frozen=True)
class Ros3P(_RosenbrockSolver):
    """ROS3P: three stages, order 3; A-stable."""

    solver_name: ClassVar[str] = "ros3p"
    coefficients: ClassVar[RosenbrockTableau] = ROS3P_TABLEAU
    solver_info: ClassVar[SolverInfo] = _rosenbrock_info(
        "Lang, Jens and Verwer, Jan",
        2001,
        "ROS3P: an accurate third-order Rosenbrock solver designed for parabolic problems",
        "10.1023/A:1021900219772",
        formula="Rosenbrock method of orders 3(2)",
        cost="1 factorisation, 3 solves and passes per step",
    )


@dataclass(frozen=True)
class Rodas(_RosenbrockSolver):
    """RODAS: six stages, order 4 with embedded order 3; L-stable and stiffly accurate."""

    solver_name: ClassVar[str] = "rodas"
    coefficients: ClassVar[RosenbrockTableau] = RODAS_TABLEAU
    solver_info: ClassVar[SolverInfo] = replace(
        _rosenbrock_info(
            "Hairer, Ernst and Wanner, Gerhard",
            1996,
            "Solving Ordinary Differential Equations II",
            "10.1007/978-3-642-05221-7",
        ),
        supports_error_control=True,
        formula="Rosenbrock method of orders 4(3)",
        cost="1 factorisation, 6 solves and passes per step",
    )


class AdaptiveStepStats(NamedTuple):
    """Statistics of adaptive steps in a frame.

    Attributes:
        num_accepted_steps, num_rejected_steps: numbers of accepted and of rejected steps.
        last_step_size: the last step size [s].
        reached_time: time reached in the frame [s].
    """

    num_accepted_steps: int
    num_rejected_steps: int
    last_step_size: float
    reached_time: float


class _StepResult(NamedTuple):
    """Positions and velocities (n, 3) after a step, and its error estimate for both."""

    positions: Positions
    velocity: Positions
    error: tuple[Positions, Positions]


@dataclass(frozen=True, eq=False)
class PreparedRosenbrock(IterativeSolver):
    """A Rosenbrock method, prepared for a system.

    Attributes:
        fixed_objective: objective of the energies without drag.
        drag: coefficients d (n,) [N s/m].
        refinement_factor: number of fixed steps in a frame.
        error_tolerance: error of each adaptive step [m], 0 for fixed steps.
        num_factorisations: factorisations of an attempted step.
    """

    residual_iterate: ClassVar[ResidualIterate] = "none"
    num_factorisations: ClassVar[int] = 1

    system: System
    coefficients: RosenbrockTableau
    fixed_objective: FixedObjective
    drag: NDArray[np.float64]
    refinement_factor: int
    error_tolerance: float
    description: str
    stats: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def order(self) -> int:
        """Order of the method."""
        return self.coefficients.order

    @property
    def num_evaluations(self) -> int:
        """Number of solves in a step."""
        return len(self.coefficients.a)

    def with_tolerance(self, tolerance: float) -> PreparedRosenbrock:
        """Return a copy with adaptive steps of the given error tolerance [m]."""
        return replace(self, error_tolerance=tolerance)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve whose only iteration is the whole frame.

        Args:
            problem: step that is integrated from its start.
            initial_guess: not used.
        """
        return SingleIterateState(*self._integrate_frame(problem, None)[:2])

    def integrate_frames(
        self, problem: StepProblem, num_frames: int = 1, h: float | None = None
    ) -> tuple[tuple[Positions, Positions], NDArray[np.float64]]:
        """Integrate one frame; exact pins move at constant velocity.

        Args:
            problem: the step problem.
            num_frames: not used.
            h: first step size [s] of an adaptive method, the frame by default.

        Returns:
            Positions and velocities (1, n, 3) at the end of the frame, and its `AdaptiveStepStats` (1, 4).

        Raises:
            RuntimeError: if no step size meets the error tolerance.
        """
        p, v, step_stats = self._integrate_frame(problem, h)
        return (p[None], v[None]), np.array([step_stats], float)

    def _integrate_frame(self, problem: StepProblem, h: float | None) -> tuple[Positions, Positions, AdaptiveStepStats]:
        frame = self.system.time_step
        within = _FrameIntegration(self, problem)
        p, v = within.initial_motion()
        if not self.error_tolerance:
            length = frame / self.refinement_factor
            for k in range(self.refinement_factor):
                made = within.try_step(p, v, length, require_exact=False)
                if made is None:
                    cause = within.explain_failure(p)
                    raise NotPositiveDefinite(f"{k * length:.6g} s after the start of the frame {cause}")
                p, v = made.positions, made.velocity
            return within.apply_pins(p, 1.0), v, AdaptiveStepStats(self.refinement_factor, 0, length, frame)
        t, accepted, rejected, h, before = 0.0, 0, 0, min(frame, h or frame), 1.0
        error_order = 1.0 + min(self.coefficients.order, self.coefficients.embedded_order)
        control = build_pi_controller(error_order, _MAX_STEP_FACTOR, _FAILURE_FACTOR)
        while t < frame:
            last = t + 1.0000001 * h >= frame  # round-off must not leave a tiny last step
            length = frame - t if last else h
            made = within.try_step(p, v, length)
            ratio = within.error_norm(made) / self.error_tolerance if made else np.inf
            if ratio <= 1.0 and made:
                accepted, t = accepted + 1, frame if last else t + length
                p, v = within.apply_pins(made.positions, t / frame), made.velocity
                h = choose_next_step_size(control, length, h, last, ratio, before)
                before = ratio
            else:
                rejected += 1
                h = length * compute_rejection_factor(control, ratio)
            if h < _MIN_STEP_FRACTION * frame or accepted + rejected >= _MAX_STEPS:
                raise RuntimeError(format_step_failure(accepted + rejected, h, t, frame, self.error_tolerance))
        return p, v, AdaptiveStepStats(accepted, rejected, h, t)


class _FrameIntegration:
    """Integration of one frame: its forces, and the motion of its pins."""

    def __init__(self, prepared: PreparedRosenbrock, problem: StepProblem) -> None:
        self._prepared, self._start = prepared, problem.step_start
        system, pins = prepared.system, prepared.system.pins
        p, targets = problem.step_start.positions, problem.pin_targets
        inner = StepProblem(
            prepared.fixed_objective.system, p, problem.external_force, targets, p, p, problem.step_start
        )
        self._step = StepObjective(prepared.fixed_objective, inner)
        self._exact_pins, self._frame = pins.vertices[pins.exact_mask], system.time_step
        self._start_targets, self._end_targets = p[self._exact_pins], targets[pins.exact_mask]
        self._pin_velocity = (self._end_targets - self._start_targets) / self._frame
        self._has_moving_pins = bool(self._pin_velocity.any())
        self._mass, self._drag = system.mass[:, None], prepared.drag[:, None]
        self._free = system.free_vertices

    def initial_motion(self) -> tuple[Positions, Positions]:
        """Return the motion at the start of the frame, with the velocity of the pins."""
        v = self._start.velocity.copy()
        v[self._exact_pins] = self._pin_velocity
        return self._start.positions.copy(), v

    def apply_pins(self, p: Positions, fraction: float) -> Positions:
        """Move the exact pins of p to a fraction of the frame; return p."""
        p[self._exact_pins] = (
            self._end_targets
            if fraction == 1.0
            else self._start_targets + fraction * (self._end_targets - self._start_targets)
        )
        return p

    def error_norm(self, made: _StepResult) -> float:
        """Return the norm of a step's error estimate [m]."""
        parts = (made.error[0][self._free], self._frame * made.error[1][self._free])
        with np.errstate(over="ignore", invalid="ignore"):
            found = (sum(float((x**2).sum()) for x in parts) / max(1, 3 * len(self._free))) ** 0.5
        return found if np.isfinite(found) else np.inf

    def explain_failure(self, p: Positions) -> str:
        """Explain why `try_step` finds no factor at positions p (n, 3) [m]."""
        return explain_missing_factor(self._step.hessian(p), "the inertia")

    def try_step(self, p: Positions, v: Positions, h: float, *, require_exact: bool = True) -> _StepResult | None:
        """Attempt one step.

        Args:
            p: positions (n, 3) [m].
            v: velocities (n, 3) [m/s].
            h: step size [s].
            require_exact: whether the exact Hessian is required.

        Returns:
            The motion after the step, None if the matrix has no factor.
        """
        table, step, m, d = self._prepared.coefficients, self._step, self._mass, self._drag
        s = 1.0 / (table.gamma * h)
        hessian = step.hessian(p)
        inertia = np.repeat((s * s * m + s * d)[self._free, 0], 3)
        if not (
            hessian.factorise(1.0, inertia)
            if require_exact
            else factorise_shifted(hessian, inertia, inertia) is not None
        ):
            return None
        us, ws = list[Positions](), list[Positions]()
        for a, c in zip(table.a, table.c, strict=True):
            at, speed = (_linear_combination(x, a, parts) for x, parts in ((p, us), (v, ws)))
            r = _linear_combination(speed, c, us, 1.0 / h)
            right = (
                m * _linear_combination(np.zeros_like(v), c, ws, 1.0 / h)
                + (s * m + d) * r
                - d * speed
                - step.gradient(at)
            )
            u = np.zeros_like(p)
            if self._has_moving_pins:
                u[self._exact_pins] = r[self._exact_pins] / s
                right -= hessian.matvec(u)
            u[self._free] = hessian.solve(right)[self._free]
            us.append(u)
            ws.append(s * u - r)
        zero = np.zeros_like(p)
        w = _linear_combination(v, table.m, ws)
        w[self._exact_pins] = self._pin_velocity
        return _StepResult(
            _linear_combination(p, table.m, us),
            w,
            (_linear_combination(zero, table.e, us), _linear_combination(zero, table.e, ws)),
        )


def _linear_combination(
    x: Positions, weights: tuple[float, ...], parts: list[Positions], factor: float = 1.0
) -> Positions:
    """Return x + factor sum_j weights_j parts_j as a new array."""
    out = x.copy()
    for weight, part in zip(weights, parts, strict=False):
        if weight:
            out += factor * weight * part
    return out
