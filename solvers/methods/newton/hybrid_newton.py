"""Hybrid of L-BFGS, vertex sweeps, Newton's method with predicted tensions and Newton's method.

    H(t) = M/dt^2 + sum_e k nn' + t_e/l_e (I - nn'),   d = -H(t)^-1 grad g(p),   t_e <- k_e (l_e + n (A d)_e - r_e)

Stiff springs hardly change their lengths between the start and the end of a step. During the iterations they do, and
their tensions k (l - r) then exceed the true ones by orders of magnitude. In the exact Hessian these tensions make
springs stiff against bending, or unstable, although they are neither. Here tensions are separate unknowns. Newton's
method on the optimality conditions of both (primal-dual, as in interior-point methods: Nocedal and Wright 2006,
chapter 19; tensions carried across iterations stabilise stiff springs in Tournier et al. 2015, "Stable Constrained
Dynamics") reduces to a Hessian with predicted tensions, which allows correspondingly longer steps. The second-order
stretch of such a step is local: a few iterations of L-BFGS remove it. The first prediction starts from smooth
positions at the end of the previous step. If H(t) has no Cholesky factor, the smallest multiple of inertia that yields
one is added: along unstable directions the step is longer, the closer that multiple is to the minimum (More and
Sorensen 1983).

L-BFGS runs first, and ends if its first four iterations increase the residual by more than half: predicted tensions
follow. Its factor of Q is in float32, unless Q is so stiff that directions would have no correct digit: an iteration
takes 5 to 14 % less time (200 to 1100 vertices, one core with AVX-512), and directions need no more digits. Residuals
then have relative errors of 1e-7. The factor is in float64 if a connected component has no pins: directions then
conserve its momentum. Sweeps do not; after them, the component is translated to its equilibrium
(`springbench.solvers.kernels.free_components`). A solve whose initial guess is the current positions starts where the
objective is lowest: there, at the inertial target (motion without forces) or at the inertial prediction (motion without
springs). Near the minimum, segments of five iterations alternate with rounds of four sweeps of vertex block descent
(`springbench.solvers.methods.quasi_newton.sweep_rounds`). More rounds of sweeps follow as long as each decreases the
objective more per cost than the last segment did, or the residual to 0.32 of it. Near means that an iteration of L-BFGS
decreases the objective by at most 5e-5 of the decrease since the initial guess, and by at most 5e-3 of it if no
diagonal entry of Q exceeds 5000 times the inertia: sweeps far from a minimum lead to other, higher minima, the more
often the stiffer the springs are. The sweeps come first if no entry exceeds 500 times the inertia; there are none if
one exceeds the inertia over the square root of the machine epsilon.

One rule decides which of the three methods continues: that with the largest decrease of the objective per cost in its
last steps. A method that was not yet measured is credited with the decrease that L-BFGS leaves, extrapolated from its
last two groups of iterations (`springbench.solvers.kernels.descent_rounds`). The exact Hessian is tried first. If it
has no Cholesky factor at the second attempt, or at the first after L-BFGS has ended, predicted tensions follow. L-BFGS
continues with its history after an attempt that finds no step. The exact method is tried again after a cost that
doubles with each attempt that decreases the objective less than the others did meanwhile. The exact method continues as
long as its Hessian is unmodified, the decrease agrees with the quadratic model, and the squared Newton decrement g'H^-1
g falls faster per cost than the decrease of L-BFGS fell from group to group. An indefinite Hessian gets the smallest
multiple of inertia that has a factor (`springbench.solvers.methods.newton.inertia_shift`), or loses negative stiffness
(`springbench.solvers.methods.newton.hessian_regularisation`), whichever decreased the objective more per factorisation
when last used. Costs are counted, not measured by a clock: in groups of L-BFGS iterations, from the numbers of springs,
entries and operations of the factors and from the factorisations made. So equal solves make equal decisions and have
bitwise equal results, on any machine and under any load. `Solution.solver_phases` explains them; its times are read
from the caller's clock where the method changes, and decide nothing.

If a point that satisfies the tolerance has an indefinite Hessian, the step leaves along a direction of negative
curvature: symmetric initial guesses lead to saddles.

With active contacts the exact method does all iterations. Contact is not part of Q, so L-BFGS would restart at each
newly active vertex, and the contact stiffness is beyond what tensions predict. L-BFGS ignores self-contact: if the
displacement of a round is not collision-free, or ends with active contacts, the round is discarded and the exact method
continues.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isnan
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.descent_method import (
    DescentPoint,
    PreparedDescent,
    ResidualMetric,
    guesses_current_positions,
    has_active_barrier,
    inner_product,
    pick_lowest_positions,
)
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.iteration.phase_clock import get_phase_clock
from springbench.solvers.iteration.saddle_check import SaddleCheck
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.kernels.descent_rounds import (
    GROUP_ITERATIONS,
    REASON_SWITCH,
    ROUND_STATE_DTYPE,
    init_rounds,
    restart_rounds,
)
from springbench.solvers.kernels.iteration_loop import (
    NO_ITERATIONS,
    ONE_ITERATION,
    REASON_ITERATIONS,
    REASON_STALLED,
    RESIDUAL_EACH,
    RESIDUAL_LAST,
    RESIDUAL_NEVER,
    LoopLimits,
    check_residual,
)
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky
from springbench.solvers.linalg.cholesky.symbolic_factorisation import cache_symbolic_analysis
from springbench.solvers.methods.local_global.accelerated_local_global import AcceleratedState
from springbench.solvers.methods.newton.hessian_regularisation import ShiftScheduleRule, factorise_shifted
from springbench.solvers.methods.newton.inertia_shift import MODEL_DECREASE_FRACTION, InertiaShift
from springbench.solvers.methods.newton.negative_curvature import (
    escape_saddle,
    is_positive_definite,
    probe_negative_curvature,
)
from springbench.solvers.methods.newton.newton_direct import NewtonIteration, build_newton_arrays
from springbench.solvers.methods.newton.newton_kernel import NEWTON_PROGRESS_DTYPE, agrees_with_model
from springbench.solvers.methods.newton.predicted_tension import (
    MAX_COMPILED_STEPS,
    RELAXATION_ITERATIONS,
    CompiledNewton,
    PredictedTensionNewton,
    compute_objective_decrease,
)
from springbench.solvers.methods.newton.predicted_tension_kernel import StepBudget
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.methods.quasi_newton.lbfgs_with_sweeps import LbfgsSweepEngine, LbfgsSweepState
from springbench.solvers.methods.quasi_newton.sweep_rounds import ROUND_SWEEPS
from springbench.solvers.methods.quasi_newton.windowed_acceleration import PreparedAccelerated
from springbench.solvers.model.barrier_energy import ignore_barriers, without_barriers
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, System
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import Hessian, StepObjective

_FLOAT32_CONDITION = 0.1 / float(np.finfo(np.float32).eps)
"""Largest condition number of Q, relative to the inertia, at which float32 leaves directions a digit."""

_FIRST_PATIENCE = 10.0
"""Initial multiple of the cost of an attempt, after which the exact method is tried again."""

_MEASURED_STEPS = 3
"""Number of consecutive steps of a Newton method whose decrease per cost is compared: single steps vary widely."""

_MAX_SHIFT = 1e3
"""Largest multiple of the inertia that is added to an exact Hessian; then its negative parts are reduced instead."""

NO_GRADIENT = np.empty((0, 3))
"""Placeholder for the gradient at a point of L-BFGS: the residual there is known, and the gradient is not used."""

_LBFGS_NANOSECONDS, _SWEEP_NANOSECONDS, _NEWTON_NANOSECONDS = (7e2, 26.0, 1.2), (6e2, 10.0), (4e4, 0.023, 5.4)
"""Costs of an L-BFGS iteration (constant, per vertex, per entry of the factor), of a sweep (constant, per spring) and
of a Newton step (constant, per flop, per entry), fitted to 31 scenes of 6 to 16384 vertices on one core with AVX-512;
their ratio alone matters."""

_MAX_EXACT_RATIO = _MAX_SWEEP_RATIO = float(np.finfo(np.float64).eps) ** -0.5
"""Largest ratio of the diagonal of Q to the inertia at which the gradients of L-BFGS are used, and at which there are
sweeps: beyond it the rounding of positions changes the elastic energy by more than the sweeps decrease the objective,
and a residual of 1e-6 is round-off of the kernels of L-BFGS."""

_SWEEP_FIRST_RATIO = 500.0
"""Largest ratio of the diagonal of Q to the inertia at which a solve starts with sweeps: they then divide the objective
by ten in about as many sweeps as a group has iterations."""

_SOFT_RATIO, _SOFT_NEAR_FRACTION, _NEAR_FRACTION = 5e3, 5e-3, 5e-5
"""Largest ratio of the diagonal of Q to the inertia of soft springs, and the decrease of an iteration of L-BFGS, as a
fraction of that since the initial guess, at which sweeps may follow, for soft and for other springs. The larger
fraction saves 10 % of the time on the soft scenes of `configs/accuracy.yaml`; on others solves take 0.7 to 1.3 times as
long, and often end in another minimum."""

_ROUND_END_COST, _COLLISION_CHECK_COST = 0.1, 20.0
"""Costs of the end of a round and of a check for collisions, in iterations of L-BFGS: 0.01 to 0.4 for a call of the
compiled rounds on 28 scenes of 81 to 16384 vertices, and 10 to 100 on folded cloths of 85 to 396 vertices."""


@dataclass(frozen=True)
class HybridNewton:
    """L-BFGS and vertex sweeps first, then Newton's method with predicted tensions, then Newton's method."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "hybrid",
        Citation(
            "Tournier, Maxime and Nesme, Matthieu and Gilles, Benjamin and Faure, François",
            2015,
            "Stable constrained dynamics",
            "10.1145/2766969",
        ),
        is_family_default=True,
        formula="L-BFGS and sweeps, then Newton with predicted tensions",
        cost="1 round of L-BFGS or sweeps, or 1 Newton step",
    )

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory.
        """
        with cache_symbolic_analysis():
            metric, objective = ResidualMetric(system), FixedObjective(system)
            precision = "float64" if _needs_double_precision(metric) else "float32"
            lbfgs = Lbfgs(precision=precision).prepare_with_sweeps(system, metric.free_components)
            method, factor = HybridIteration(objective, metric, lbfgs), objective.hessian_matrix.factor
        facts = metric.stats | {"nnz_hessian_factor": float(factor.nonzeros)}
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries; for L-BFGS, {lbfgs.description}"
        choice += objective.interpreted_energies
        found = PreparedHybrid(objective, metric, method, choice, facts)

        def ignore_contact() -> PreparedHybrid:
            alone = objective.ignore_barriers()
            return replace(found, fixed_objective=alone, method=HybridIteration(alone, metric, lbfgs))

        return skip_idle_contact(found, system, ignore_contact)


def _needs_double_precision(metric: ResidualMetric) -> bool:
    """Return whether directions Q^-1 g need float64.

    They do if float32 leaves no correct digit, or for components whose momentum is conserved. No eigenvalue of Q
    relative to the inertia exceeds twice the largest ratio of their diagonals, as Q is diagonally dominant.
    """
    return len(metric.free_components.vertices) > 0 or _exceeds_ratio(metric, 0.5 * _FLOAT32_CONDITION)


def _exceeds_ratio(metric: ResidualMetric, limit: float) -> bool:
    """Return whether an entry of the diagonal of Q exceeds this multiple of the inertia."""
    inertia = metric.system.inertia_diagonal[metric.system.free_vertices]
    return bool((metric.free_diagonal > limit * inertia).any())


class PreparedHybrid(PreparedDescent):
    """The hybrid after the setup for a system."""

    method: HybridIteration

    @cached_property
    def saddle_check(self) -> SaddleCheck:
        """The check for saddles, whose bound makes factorisations unnecessary."""
        return SaddleCheck(self.fixed_objective)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return (LbfgsFirstState if self.method.starts_with_lbfgs else HybridState)(self, problem, initial_guess)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)], by L-BFGS if its residuals are those of the metric.

        Args:
            problem: step whose objective is minimised.
            p: positions (n, 3) [m].
        """
        lbfgs = self.method.residual_lbfgs
        return lbfgs.residual_at(ignore_barriers(problem), p) if lbfgs else super().residual_at(problem, p)


@dataclass
class SolveControl:
    """What a solve and its loop exchange.

    Attributes:
        limits: limits of the next iterations, in rounds of L-BFGS or Newton steps.
        num_iterations: number of iterations that led to the last point.
        must_escape: whether the last point is a saddle point, to be left.
        is_minimum: whether the last point was reached by an unmodified Newton step that agrees with its model.
        residual: residual at the last point [J^(1/2)], None if it is not known.
        start_decrease: decrease of the objective from the initial guess to where the solve starts [J].
        solver_phases: iterations, cost in Newton steps and time [s] of each method before the current phase; the
            iterations and cost of the current phase are included, its time is not.
        clock: clock of the phases [s].
        phase_name: method of the current phase.
        phase_start: time at which the current phase began [s].
    """

    limits: LoopLimits = ONE_ITERATION
    num_iterations: int = 1
    must_escape: bool = False
    is_minimum: bool = False
    residual: float | None = None
    start_decrease: float = 0.0
    solver_phases: dict[str, tuple[int, float, float]] = field(default_factory=dict)
    clock: Callable[[], float] = field(default_factory=get_phase_clock)
    phase_name: str = ""
    phase_start: float = field(init=False)

    def __post_init__(self) -> None:
        self.phase_start = self.clock()

    def begin_phase(self, name: str) -> None:
        """Begin the phase of a method, and end that of another one.

        The clock is read only where the method changes.

        Args:
            name: name of the method in `solver_phases`.
        """
        if name == self.phase_name:
            return
        if self.phase_name in self.solver_phases:
            now, (count, spent, seconds) = self.clock(), self.solver_phases[self.phase_name]
            self.solver_phases[self.phase_name] = count, spent, seconds + now - self.phase_start
            self.phase_start = now
        self.phase_name = name

    def read_phases(self) -> dict[str, tuple[int, float, float]]:
        """Return `solver_phases` with the time of the current phase until now."""
        return {
            name: (count, spent, seconds + (self.clock() - self.phase_start if name == self.phase_name else 0.0))
            for name, (count, spent, seconds) in self.solver_phases.items()
        }

    def add_phase(self, name: str, num_iterations: int, cost: float) -> None:
        """Record iterations and the cost of a method, and set `num_iterations`.

        Args:
            name: name of the method in `solver_phases`.
            num_iterations: iterations that led to the last point.
            cost: cost of these iterations, in Newton steps.
        """
        count, spent, seconds = self.solver_phases.get(name, (0, 0.0, 0.0))
        self.solver_phases[name] = count + num_iterations, spent + cost, seconds
        self.num_iterations = num_iterations


class HybridState(SolverState):
    """The state of a solve, which does many rounds of L-BFGS at once.

    Attributes:
        positions: current positions (n, 3) [m].
    """

    def __init__(self, prepared: PreparedHybrid, problem: StepProblem, guess: Positions) -> None:
        self._prepared, self._problem, self._control = prepared, problem, SolveControl()
        self._point: DescentPoint | None = None
        self.positions = guess
        self._start_points()

    def _start_points(self) -> None:
        """Start the iteration at the initial guess."""
        self.positions = self._step.apply_exact_pins(self.positions)
        self._points = self._prepared.method.iterate_from(self._step, self.positions, self._control)

    @cached_property
    def _step(self) -> StepObjective:
        return StepObjective(self._prepared.fixed_objective, self._problem)

    def step_state(self) -> bool:
        """Do one iteration; return False if the positions do not change."""
        return self._advance(ONE_ITERATION)

    def _advance(self, limits: LoopLimits) -> bool:
        """Do iterations within the limits; return False if the positions do not change."""
        before, self._control.limits, self._control.residual = self.positions, limits, None
        self._point = next(self._points, self._point)
        if self._point is not None:
            self.positions = self._point.positions
        return self.positions is not before

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the current positions."""
        if self._control.residual is not None:
            return self._control.residual
        return self._prepared.metric.residual(self._current_point().gradient)

    def _current_point(self) -> DescentPoint:
        return self._point or DescentPoint(self.positions, self._step.gradient(self.positions))

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        count, found, ended = 0, np.nan, REASON_ITERATIONS
        while ended == REASON_ITERATIONS and count < limits.max_iterations:
            moved = self._advance(limits._replace(max_iterations=limits.max_iterations - count) if count else limits)
            count += self._control.num_iterations if moved else 0
            if limits.residual_mode == RESIDUAL_EACH:
                found = self.residual()
                if not (self._point and self._point.is_past_saddle):  # the residual is small next to a saddle
                    ended = check_residual(found, limits)
            if ended == REASON_ITERATIONS and not moved:
                ended = REASON_STALLED
        if limits.residual_mode == RESIDUAL_LAST or (limits.residual_mode == RESIDUAL_EACH and count == 0):
            found = self.residual()
        return count, found, ended

    def can_terminate(self) -> bool:
        """Return whether the current positions are a minimum; the next iteration leaves a saddle."""
        control = self._control
        control.must_escape = not (
            control.is_minimum
            or self._prepared.saddle_check.is_bounded_by_springs(self.positions)
            or is_positive_definite(self._step, self.positions)
        )
        return not control.must_escape

    @property
    def solver_phases(self) -> dict[str, tuple[int, float, float]]:
        """Iterations, cost in Newton steps and time [s] of each method so far."""
        return self._control.read_phases()


class LbfgsFirstState(HybridState):
    """The state of a solve by L-BFGS alone, until another method is needed.

    Nothing is prepared for the other methods before that. Most steps of small meshes end with L-BFGS alone, and the
    preparation of the other methods would cost as much as such a step.
    """

    _run: LbfgsSweepState | None = None
    _num_rounds = 0
    _is_lbfgs_alone = True

    def _start_points(self) -> None:
        """Begin the phase of L-BFGS, whose first round starts the solve."""
        self._uses_lbfgs_residuals = self._prepared.method.residual_lbfgs is not None
        self._control.begin_phase("lbfgs")

    def compute_start_residual(self) -> float | None:
        """Start L-BFGS and return the residual [J^(1/2)] at the initial guess, if its residuals are used."""
        return self._prepare_run().start_lowest(self._rounds) if self._uses_lbfgs_residuals else None

    def _prepare_run(self) -> LbfgsSweepState:
        """Prepare L-BFGS, which the first rounds start."""
        method = self._prepared.method
        run = self._run = method.prepare_lbfgs(self._problem, self.positions)
        self._rounds = method.init_rounds()
        return run

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Iterate up to the limits; return count, residual and reason."""
        if self._num_rounds == 0 and limits.max_iterations == 0:
            self.positions = self._step.apply_exact_pins(self.positions)
        return super().run_iterations(limits)

    def _advance(self, limits: LoopLimits) -> bool:
        """Do rounds of L-BFGS as long as it is alone."""
        if not self._is_lbfgs_alone:
            return super()._advance(limits)
        control, run = self._control, self._run or self._prepare_run()
        if control.must_escape:
            self._end_lbfgs_alone(run, np.inf, REASON_ITERATIONS)
            return super()._advance(limits)
        count, residual, ended = run.run_rounds(self._rounds, limits)
        is_known = self._uses_lbfgs_residuals and not isnan(residual)
        control.num_iterations, control.residual = count, residual if is_known else None
        self._num_rounds += count
        self.positions = run.positions
        if ended != REASON_ITERATIONS and self._is_lbfgs_done(residual, ended):
            self._end_lbfgs_alone(run, residual, ended)
        return True

    def _is_lbfgs_done(self, residual: float, ended: int) -> bool:
        """Return whether another method follows after rounds that ended for this reason."""
        return ended in (REASON_STALLED, REASON_SWITCH) or residual <= self._rounds["residual_floor"][0]

    def residual(self) -> float:
        """Return the residual [J^(1/2)] at the current positions."""
        found = self._control.residual
        if found is None and self._run is not None and self._uses_lbfgs_residuals:
            found = self._control.residual = self._run.run_rounds(self._rounds, NO_ITERATIONS)[1]
        return super().residual() if found is None else found

    def _current_point(self) -> DescentPoint:
        if self._run is None:
            return super()._current_point()
        return self._prepared.method.read_point(self._step, self._run)

    def _end_lbfgs_alone(self, run: LbfgsSweepState, residual: float, ended: int) -> None:
        """End the phase of L-BFGS alone, and continue with the choice between the methods."""
        method, control = self._prepared.method, self._control
        control.solver_phases, self._is_lbfgs_alone, self._run = self._count_rounds(0.0), False, None
        self._point = method.read_point(self._step, run)
        self.positions = self._point.positions
        start = run.start_positions
        method_choice = MethodChoice(method, self._step, start, run, control, self._rounds, self._point)
        method_choice.record_rounds(residual, ended)
        self._points = method.continue_from(self._step, self._point, control, method_choice)

    @property
    def solver_phases(self) -> dict[str, tuple[int, float, float]]:
        """Iterations, cost in Newton steps and time [s] of each method so far."""
        if not self._is_lbfgs_alone:
            return super().solver_phases
        return self._count_rounds(self._control.clock() - self._control.phase_start)

    def _count_rounds(self, seconds: float) -> dict[str, tuple[int, float, float]]:
        """Count the iterations and the cost of L-BFGS alone, which took this time [s]."""
        groups = int(self._rounds["num_iterations"][0]) / GROUP_ITERATIONS if self._num_rounds else 0.0
        return {"lbfgs": (self._num_rounds, groups / self._prepared.method.newton_cost, seconds)}


class MeasuredRule(ShiftScheduleRule):
    """The smallest multiple of the inertia, or the shift schedule.

    The rule also measures the steps of the exact method.

    Attributes:
        agrees_with_model: whether the Hessian of the last step was unmodified and its decrease agreed with the model.
        decrement_ratio: ratio of the squared Newton decrements g'H^-1 g after and before a step that agreed.
        is_exact_only: whether only the unmodified Hessian may be factorised.
        has_factor: whether the exact Hessian at the next point has a factor, which is then the last one; None if that
            is not known.
        decrease: decrease of the objective in the last step [J]; None before it, and if there was none.
    """

    def __init__(self, inertia_diagonal: NDArray[np.float64], factor: BlockCholesky) -> None:
        """Create the rule.

        Args:
            inertia_diagonal: diagonal of the inertia (3f,) [N/m].
            factor: factor of the Hessian, which counts factorisations.
        """
        self._inertia_diagonal, self._factor = inertia_diagonal, factor
        self._shift, self._level, self._before = InertiaShift(0.0, _MAX_SHIFT), cast(int | None, None), 0.0
        self._gains = {"shift": np.inf, "schedule": np.inf}  # [J] per factorisation, when last used
        self._name = "shift"
        self.agrees_with_model = self.is_exact_only = False
        self.has_factor, self.decrement_ratio, self.decrease = cast(bool | None, None), 0.0, cast(float | None, None)

    def factorise_hessian(self, hessian: Hessian, at: DescentPoint, diagonal: NDArray[np.float64]) -> int | None:
        """Factorise the exact Hessian or, unless `is_exact_only`, a shifted one.

        Args:
            hessian: exact Hessian at the point.
            at: not used.
            diagonal: diagonal of the shift schedule (3f,) [N/m].

        Returns:
            0 if nothing was added, more for other factors, None for no factor.
        """
        self.agrees_with_model, self.decrease = False, None
        self._name = max(self._gains, key=lambda name: self._gains[name])
        if self.has_factor:
            self._level = 0
        elif self.is_exact_only:
            self._level = 0 if self.has_factor is None and hessian.factorise() else None
        elif self._name == "schedule":
            self._level = factorise_shifted(hessian, diagonal, first_level=int(self.has_factor is False))
        else:
            self._level = self._shift.find_smallest(lambda shift: self._factorise_shifted(hessian, diagonal, shift))
        self.has_factor = None
        return self._level

    def begin_step(self, *, is_exact_only: bool) -> None:
        """Begin a step, before its first factorisation.

        Args:
            is_exact_only: whether only the unmodified Hessian may be factorised.
        """
        self.is_exact_only, self._before = is_exact_only, self._factor.num_factorisations

    @property
    def tries_exact_first(self) -> bool:
        """Whether the exact Hessian is the first to be factorised at the next point."""
        return self.is_exact_only or self._gains["schedule"] > self._gains["shift"] or self._shift.value == 0.0

    def _factorise_shifted(self, hessian: Hessian, diagonal: NDArray[np.float64], shift: float) -> int | None:
        """Factorise with a multiple of the inertia added.

        An infinite multiple stands for the shift schedule.
        """
        if shift == np.inf:
            return factorise_shifted(hessian, diagonal, first_level=1)
        if shift == 0.0 and self.has_factor is False:
            return None
        added = shift * self._inertia_diagonal if shift > 0.0 else 0.0
        return int(shift > 0.0) if hessian.factorise(1.0, added) else None

    def record_step(self, step: StepObjective, hessian: Hessian, at: DescentPoint, to: DescentPoint) -> None:
        """Compare the decrease in a step with its quadratic model, and record it per factorisation.

        Args:
            step: objective of the step.
            hessian: not used.
            at: first point.
            to: point at which the line search ended.
        """
        slope = inner_product(at.gradient, at.positions - to.positions)
        self.decrease = fall = compute_objective_decrease(step, at, to)
        self._record_decrease(fall, slope)
        if self._level:
            self._gains[self._name] = fall / (self._factor.num_factorisations - self._before)
        self.agrees_with_model = self._level == 0 and agrees_with_model(fall, slope)
        if self.agrees_with_model and slope > 0.0:
            self.decrement_ratio = inner_product(to.gradient, hessian.solve(to.gradient)) / slope

    def record_compiled_steps(self, slope: float, agrees: bool, decrement_ratio: float, decrease: float) -> None:
        """Record the last of several steps with the exact Hessian.

        Args:
            slope: derivative along its displacement [J], positive.
            agrees: whether the decrease agreed with the model.
            decrement_ratio: ratio of the squared Newton decrements.
            decrease: decrease of the objective [J].
        """
        self._name = max(self._gains, key=lambda name: self._gains[name])
        self._record_decrease(decrease, slope)
        self.agrees_with_model, self.decrement_ratio = agrees, decrement_ratio

    def _record_decrease(self, decrease: float, slope: float) -> None:
        """Record whether the quadratic model was accurate in a step."""
        if self._name == "shift":
            self._shift.can_reduce = decrease >= MODEL_DECREASE_FRACTION * slope or self._shift.value == np.inf


class HybridIteration:
    """The iteration for one system.

    An iteration is a round of L-BFGS, or a step of one of the Newton methods.

    Attributes:
        metric: norm of residuals.
        newton: the exact method.
        factor: factor of the Hessian.
        residual_lbfgs: L-BFGS, if its residuals are used, which are those of the metric in the precision of its
            factor; else None.
        is_very_stiff: whether the gradients of L-BFGS have too much round-off (`_MAX_EXACT_RATIO`).
        starts_with_lbfgs: whether a solve starts with compiled rounds of L-BFGS, which choose where to start.
        newton_cost: cost of a Newton step, in groups of L-BFGS iterations.
        sweep_cost: cost of a round of sweeps, in L-BFGS iterations; 0 if there are none.
    """

    can_identify_saddles: ClassVar[bool] = True

    def __init__(self, objective: FixedObjective, metric: ResidualMetric, lbfgs: PreparedAccelerated) -> None:
        self.metric, self._lbfgs, self._objective = metric, lbfgs, objective
        self.newton = NewtonIteration(metric, has_local_roundoff=True)
        self.system_diagonal: NDArray[np.float64] = np.repeat(metric.free_diagonal, 3)
        inertia = objective.system.inertia_diagonal[objective.system.free_vertices]
        self.inertia_diagonal: NDArray[np.float64] = np.repeat(inertia, 3)
        self.factor = factor = objective.hessian_matrix.factor
        self._system_has_barriers = without_barriers(objective.system) is not objective.system
        self.is_very_stiff = _exceeds_ratio(metric, _MAX_EXACT_RATIO)
        has_contact = objective.has_barriers or objective.system is not without_vertex_contact(objective.system)
        self.residual_lbfgs = None if self.is_very_stiff or has_contact else lbfgs
        is_projective = objective.projective_indices.issuperset(objective.element_energy_indices)
        engine = lbfgs.acceleration_engine
        self._sweep_engine = engine if isinstance(engine, LbfgsSweepEngine) else None
        self.starts_with_lbfgs = is_projective and self._sweep_engine is not None and not has_contact
        springs, entries = len(objective.springs.stiffness), lbfgs.stats.get("nnz_factor", 0.0)
        constant, per_vertex, per_entry = _LBFGS_NANOSECONDS
        lbfgs_cost = constant + per_vertex * objective.system.num_vertices + per_entry * entries
        constant, per_flop, per_entry = _NEWTON_NANOSECONDS
        newton_cost = constant + per_flop * factor.flops + per_entry * factor.nonzeros
        self.newton_cost = newton_cost / (GROUP_ITERATIONS * lbfgs_cost)
        constant, per_spring = _SWEEP_NANOSECONDS
        sweep_cost = ROUND_SWEEPS * (constant + per_spring * springs)
        has_sweeps = self._sweep_engine is not None and not _exceeds_ratio(metric, _MAX_SWEEP_RATIO)
        self.sweep_cost = 1 + round(sweep_cost / lbfgs_cost) if has_sweeps else 0
        near_fraction = _NEAR_FRACTION if _exceeds_ratio(metric, _SOFT_RATIO) else _SOFT_NEAR_FRACTION
        check_cost = _COLLISION_CHECK_COST if objective.has_barriers else _ROUND_END_COST
        starts_sweeping = has_sweeps and not _exceeds_ratio(metric, _SWEEP_FIRST_RATIO)
        rounds = init_rounds(
            self.newton_cost, check_cost, self.sweep_cost, near_fraction, starts_sweeping=starts_sweeping
        )
        self._initial_rounds = rounds.tobytes()

    @property
    def compiled_newton(self) -> CompiledNewton | None:
        """Compiled steps of Newton's methods; None if they are not supported, and with several threads."""
        return self._compiled_newton if self.factor.num_threads == 1 else None

    @cached_property
    def _compiled_newton(self) -> CompiledNewton | None:
        arrays = build_newton_arrays(self.metric, self._objective)
        return None if arrays is None else CompiledNewton.from_arrays(arrays)

    def init_rounds(self, earlier_decrease: float = 0.0) -> NDArray[Any]:
        """Return the state of the rounds of a solve.

        Args:
            earlier_decrease: decrease of the objective from the initial guess to the start [J].
        """
        rounds = np.frombuffer(bytearray(self._initial_rounds), ROUND_STATE_DTYPE)  # `copy` copies field by field
        if earlier_decrease > 0.0:
            rounds["earlier_decrease"] = earlier_decrease
        return rounds

    def round_off(self, p: Positions) -> float:
        """Return the residual [J^(1/2)] that rounded positions p (n, 3) [m] leave."""
        return self.metric.energy_roundoff(p) ** 0.5

    def iterate_points(self, step: StepObjective, start: DescentPoint) -> Iterator[DescentPoint]:
        """Yield the points after `start`.

        Args:
            step: objective of the step.
            start: first point, of which only the positions are used.
        """
        return self.iterate_from(step, start.positions, SolveControl())

    def iterate_from(self, step: StepObjective, p: Positions, control: SolveControl) -> Iterator[DescentPoint]:
        """Yield the points after the positions p; restart after an escape from a saddle.

        Args:
            step: objective of the step.
            p: initial guess (n, 3) [m]; if it is the current positions, the inertial target or the inertial prediction
                replaces them if its objective is lower.
            control: limits of the next iterations, read for each point; counts and costs are recorded there.
        """
        if guesses_current_positions(step.problem):
            points = step.inertial_target(), step.inertial_prediction()
            p, control.start_decrease = pick_lowest_positions(step, p, *points)
        yield from self.continue_from(step, DescentPoint(p, NO_GRADIENT), control)

    def continue_from(
        self, step: StepObjective, start: DescentPoint, control: SolveControl, method_choice: MethodChoice | None = None
    ) -> Iterator[DescentPoint]:
        """Yield the points after a point; restart after an escape from a saddle.

        Args:
            step: objective of the step.
            start: point from which the iteration continues, of which only the positions are used.
            control: as in `iterate_from`.
            method_choice: choice between the methods that continues from there; a new one is started if omitted.
        """
        p, point = start.positions, start if method_choice else None
        while point is None or not point.is_stalled:
            if not (step.has_contact_elements or has_active_barrier(step, p)):
                method_choice = method_choice or MethodChoice(
                    self, step, p, self.start_lbfgs(step, p), control, self.init_rounds(control.start_decrease)
                )
                points, method_choice = method_choice.iterate_points(), None
                for following in points:
                    if not _is_collision_free(step, p, following.positions):
                        break
                    p, point = following.positions, following
                    yield point
                    if point.is_past_saddle:
                        break
                if point and (point.is_past_saddle or point.is_stalled):
                    continue
            control.begin_phase("newton")
            before = self.factor.num_factorisations
            for following in self.newton.iterate_points(step, point or DescentPoint(p, step.gradient(p))):
                moved, done = following.positions is not p, self.factor.num_factorisations
                control.add_phase("newton", int(moved), done - before)
                p, point, before = following.positions, following, done
                yield point
                if point.is_past_saddle:
                    break

    def start_lbfgs(self, step: StepObjective, p: Positions) -> AcceleratedState:
        """Start L-BFGS, without surface contact.

        Args:
            step: objective of the step, whose barrier energies are ignored.
            p: initial guess (n, 3) [m].
        """
        return self._lbfgs.init_state(self._without_barriers(step.problem), p)

    def prepare_lbfgs(self, problem: StepProblem, guess: Positions) -> LbfgsSweepState:
        """Prepare L-BFGS, if `starts_with_lbfgs`; it chooses where it starts.

        Args:
            problem: step whose objective is minimised.
            guess: initial guess (n, 3) [m].
        """
        assert self._sweep_engine is not None
        return LbfgsSweepState(self._sweep_engine, self._without_barriers(problem), guess)

    def _without_barriers(self, problem: StepProblem) -> StepProblem:
        return ignore_barriers(problem) if self._system_has_barriers else problem

    def can_terminate(self, step: StepObjective, at: DescentPoint) -> bool:
        """Return whether a stationary point is a minimum, as far as the method can determine.

        Args:
            step: objective of the step.
            at: stationary point, whose exact Hessian is factorised.
        """
        return self.newton.can_terminate(step, at)

    def iteration_phases(self, step: StepObjective, at: DescentPoint) -> dict[str, Callable[[], object]]:
        """Return the phases of Newton's method, and a round of L-BFGS, as callables.

        Args:
            step: objective of the step.
            at: point at which the phases are evaluated.
        """

        def run_lbfgs() -> DescentPoint:
            return self.relax_point(step, self.start_lbfgs(step, at.positions))

        return self.newton.iteration_phases(step, at) | {"lbfgs": run_lbfgs}

    def relax_point(self, step: StepObjective, run: AcceleratedState) -> DescentPoint:
        """Return the point after a few iterations of L-BFGS.

        Args:
            step: objective of the step.
            run: state of L-BFGS at the start of a solve.
        """
        run.run_iterations(LoopLimits(RELAXATION_ITERATIONS, 0.0, 0.0, RESIDUAL_NEVER))
        return self.read_point(step, run)

    def read_point(self, step: StepObjective, run: AcceleratedState) -> DescentPoint:
        """Return the current point of L-BFGS.

        Its gradient is that of L-BFGS or, if `is_very_stiff`, of the objective.

        Args:
            step: objective of the step.
            run: state of L-BFGS.
        """
        positions = run.positions.copy()
        return DescentPoint(positions, step.gradient(positions) if self.is_very_stiff else run.gradient())


class MethodChoice:
    """The choice between the methods in one solve, without active contacts."""

    def __init__(
        self,
        method: HybridIteration,
        step: StepObjective,
        start: Positions,
        run: AcceleratedState,
        control: SolveControl,
        rounds: NDArray[Any],
        at: DescentPoint | None = None,
    ) -> None:
        """Start at positions (n, 3) [m], or continue at a point `at`.

        Rounds of L-BFGS have led from the positions to that point.

        Args:
            method: iteration for the system.
            step: objective of the step.
            start: positions at which the solve starts (n, 3) [m].
            run: state of L-BFGS.
            control: limits of the next iterations; counts and costs are recorded there.
            rounds: state of the rounds of L-BFGS.
            at: point from which the iteration continues; the start if omitted.
        """
        self._method, self._step, self._start, self._control = method, step, start, control
        self._run: AcceleratedState | None = run
        self._idle_run: AcceleratedState | None = None
        self._point, self._rounds = at or DescentPoint(start, NO_GRADIENT), rounds
        self._start_decrease = float(rounds["earlier_decrease"][0])
        self._num_lbfgs_iterations, self._rival_gain = 0, 0.0  # last values read from and written to `rounds`
        self._measured_rule: MeasuredRule | None = None
        self._steepest = 0.0
        rounds["residual_floor"] = self._floor = method.round_off(start)
        self._predicting: PredictedTensionNewton | None = None
        self._gains = {"lbfgs": np.inf, "predicted tensions": 0.0, "newton": 0.0}  # [J] per cost of a group
        self._name = ""
        self._was_indefinite = False
        self._recent_steps: deque[tuple[float, float]] = deque(maxlen=_MEASURED_STEPS)  # [J], cost
        self._is_trial_due, self._patience, self._spent, self._fallen = False, _FIRST_PATIENCE, 0.0, 0.0
        self._trial_cost = _FIRST_PATIENCE * method.newton_cost  # spent by the others until the exact method is tried

    def iterate_points(self) -> Iterator[DescentPoint]:
        """Yield points of the method with the largest predicted gain, without end."""
        while True:
            point = self._escape() if self._control.must_escape else None
            if point is None:
                name = self._choose_method()
                if name != self._name:
                    self._name = name
                    self._recent_steps.clear()
                self._control.begin_phase(name)
                if name != "newton" and self._measured_rule is not None:
                    self._measured_rule.agrees_with_model = False  # it compared an earlier point
                if name == "lbfgs":
                    point = self._run_lbfgs()
                else:
                    if (run := self._run) is not None:  # its gradient has the round-off of its kernel
                        positions = self._point.positions
                        self._point = DescentPoint(positions, self._step.gradient(positions))
                        self._idle_run, self._run = run, None
                    point = self._take_exact_steps() if name == "newton" else self._take_predicted_step()
                    if point is self._point and run is not None and self._idle_run is run:  # L-BFGS continues
                        self._run, self._idle_run = run, None
            if point is not self._point:
                self._point, self._control.is_minimum = point, self._agrees_with_model
                yield point

    @property
    def _rule(self) -> MeasuredRule:
        """The regularisation of the exact method; a solve by L-BFGS alone needs none."""
        if self._measured_rule is None:
            self._measured_rule = MeasuredRule(self._method.inertia_diagonal, self._method.factor)
        return self._measured_rule

    @property
    def _agrees_with_model(self) -> bool:
        """Whether the last step of the exact method agreed with its quadratic model."""
        return self._measured_rule is not None and self._measured_rule.agrees_with_model

    @property
    def _converges_faster(self) -> bool:
        """Whether the last exact step agreed with its model and converged faster than L-BFGS did.

        Errors are compared per cost. The error is the squared Newton decrement, and for L-BFGS the decrease of a group.
        """
        return self._agrees_with_model and self._rule.decrement_ratio <= self._compute_max_decrement_ratio()

    def _compute_max_decrement_ratio(self) -> float:
        """Return the largest ratio of decrements at which Newton's method continues.

        Up to this ratio, it converges faster than L-BFGS did.
        """
        other = float(self._rounds["gain_ratio"][0])
        return other**self._method.newton_cost if 0.0 < other < 1.0 else np.inf

    def _choose_method(self) -> str:
        if self._converges_faster or self._is_trial_due or not any(self._gains.values()):
            return "newton"
        if self._gains["lbfgs"] == np.inf:
            return "lbfgs"
        return max(self._gains, key=lambda name: self._gains[name])

    def _run_lbfgs(self) -> DescentPoint:
        """Do rounds of L-BFGS up to the limits, or until another method is preferable."""
        rounds, step, limits = self._rounds, self._step, self._control.limits
        if self._run is None:
            self._run = self._method.start_lbfgs(step, self._point.positions)
            start = DescentPoint(self._start, NO_GRADIENT)
            restart_rounds(rounds, self._start_decrease + compute_objective_decrease(step, start, self._point))
        if step.barrier_energies:  # each round is checked for collisions
            limits = limits._replace(max_iterations=1)
        rival_gain = max(self._gains["predicted tensions"], self._gains["newton"])
        if rival_gain != self._rival_gain:
            rounds["rival_gain"] = self._rival_gain = rival_gain
        count, residual, ended = self._run.run_rounds(rounds, limits)
        done = int(rounds["num_iterations"][0]) - self._num_lbfgs_iterations
        self._control.add_phase("lbfgs", count, done / GROUP_ITERATIONS / self._method.newton_cost)
        if self._method.residual_lbfgs and not isnan(residual):
            point, self._control.residual = DescentPoint(self._run.positions.copy(), NO_GRADIENT), residual
        else:
            point = self._method.read_point(step, self._run)
        self.record_rounds(residual, ended)
        return point

    def record_rounds(self, residual: float, ended: int) -> None:
        """Record the cost of rounds of L-BFGS and what follows from their end.

        Args:
            residual: last residual [J^(1/2)].
            ended: termination reason.
        """
        rounds = self._rounds
        before, self._num_lbfgs_iterations = self._num_lbfgs_iterations, int(rounds["num_iterations"][0])
        self._spent += (self._num_lbfgs_iterations - before) / GROUP_ITERATIONS
        if ended == REASON_SWITCH and rounds["is_unsuited"]:
            self._predicting = PredictedTensionNewton(self._method, self._step, self._origin())
            self._gains |= {"lbfgs": 0.0, "predicted tensions": np.inf}
            rounds["is_unsuited"], rounds["initial_residual"] = 0, np.inf
        elif ended == REASON_SWITCH:
            gain = float(rounds["gain"][0])
            self._gains["lbfgs"] = max(gain, 0.0)
            self._is_trial_due = gain >= self._rival_gain
        elif ended == REASON_STALLED or residual <= self._floor:
            self._gains["lbfgs"], self._is_trial_due = 0.0, True

    def _take_exact_steps(self) -> DescentPoint:
        """Return the point after steps of the exact method.

        They are compiled if they are supported, and as long as the exact Hessian has a factor. If it has none, the
        current point is returned. Predicted tensions follow from the second time on, or if L-BFGS has ended. The first
        time, L-BFGS has often not yet reached a convex region, and the next attempt comes sooner.
        """
        method, rule, before = self._method, self._rule, self._method.factor.num_factorisations
        rule.begin_step(is_exact_only=self._predicting is None and any(self._gains.values()))
        if method.compiled_newton is not None and rule.tries_exact_first:
            point = self._run_compiled_steps(method.compiled_newton)
            if point is not self._point:
                return point
        point, self._steepest = method.newton.next_point(self._step, self._point, self._steepest, rule)
        if point.is_stalled and rule.is_exact_only:
            if self._was_indefinite or self._gains["lbfgs"] == 0.0:
                self._gains["predicted tensions"] = np.inf
            else:
                self._was_indefinite, self._patience = True, 0.5 * self._patience
            point, fall = self._point, 0.0
        elif rule.decrease is None:
            fall = compute_objective_decrease(self._step, self._point, point)
        else:
            fall = rule.decrease
        self._record_step("newton", point, fall, method.factor.num_factorisations - before)
        return point

    def _run_compiled_steps(self, compiled: CompiledNewton) -> DescentPoint:
        """Return the point after steps with the exact Hessian that converge fast enough.

        The current point is returned if there are none; its Hessian, if it has a factor, is then factorised.
        """
        control, step, rule = self._control, self._step, self._rule
        p, gradient = self._point.positions.copy(), self._point.gradient.copy()
        decreases, progress = np.empty(MAX_COMPILED_STEPS), np.zeros(1, NEWTON_PROGRESS_DTYPE)
        progress["steepest_slope"] = self._steepest
        fixed = compiled.arrays, step.step_data, step.exact_pins
        count, residual, _ = compiled.run_measured_steps.call(
            *fixed, control.limits, self._compute_max_decrement_ratio(), p, gradient, decreases, progress
        )
        _, number, failed, self._steepest, _, _, slope, agrees, decrement_ratio = progress.item()
        self._method.factor.count_factorisations(number, failed)
        if count == 0:
            rule.has_factor = failed < 0
            return self._point
        falls: list[float] = decreases[:count].tolist()
        rule.record_compiled_steps(slope, bool(agrees), decrement_ratio, falls[-1])
        point = DescentPoint(p, gradient)
        self._record_steps("newton", count, falls, [1.0] * count)
        control.num_iterations, control.residual = count, None if isnan(residual) else residual
        return point

    def _take_predicted_step(self) -> DescentPoint:
        """Return the point after a step with predicted tensions, or several compiled ones."""
        step, point, before = self._step, self._point, self._method.factor.num_factorisations
        if self._predicting is None:
            self._predicting = PredictedTensionNewton(self._method, step, self._origin())
            following, fall, is_past_saddle = self._predicting.compute_first_step(point)
            if is_past_saddle:
                self._gains["lbfgs"] = np.inf
        else:
            if self._predicting.relaxation is None:
                self._predicting.relaxation, self._idle_run = self._idle_run, None
            if (compiled := self._run_compiled_predicted_steps(self._predicting)) is not None:
                return compiled
            following, fall, self._is_trial_due = self._predicting.compute_next_step(point)
        self._record_step("predicted tensions", following, fall, self._method.factor.num_factorisations - before)
        return following

    def _run_compiled_predicted_steps(self, predicting: PredictedTensionNewton) -> DescentPoint | None:
        """Return the point after compiled steps with predicted tensions; None if they are not supported."""
        method, control, recent = self._method, self._control, np.zeros((2, _MEASURED_STEPS))
        if self._recent_steps:
            recent[:, -len(self._recent_steps) :] = np.transpose(self._recent_steps)
        min_gain = max(self._gains["lbfgs"], self._gains["newton"])
        budget = StepBudget(min_gain, method.newton_cost, method.factor.failure_costs, self._spent, self._trial_cost)
        found = predicting.run_compiled_steps(self._point, control.limits, budget, recent)
        if found is None:
            return None
        method.factor.count_factorisations(sum(found.costs))
        self._is_trial_due = found.is_trial_due
        self._record_steps("predicted tensions", found.num_moved, found.decreases, found.costs)
        control.num_iterations, control.residual = found.num_moved, found.residual
        return found.point

    def _origin(self) -> DescentPoint:
        """Return the point at which the solve started."""
        return DescentPoint(self._start, self._step.gradient(self._start))

    def _record_step(self, name: str, to: DescentPoint, decrease: float, num_factorisations: float) -> None:
        """Record a Newton step to a point, as `_record_steps` does."""
        self._record_steps(name, int(to.positions is not self._point.positions), [decrease], [num_factorisations])

    def _record_steps(
        self, name: str, num_moved: int, decreases: Sequence[float], num_factorisations: Sequence[float]
    ) -> None:
        """Record the decreases per cost of Newton steps, of which some changed the positions.

        They also determine when the exact method is tried next.
        """
        count, spent, recent = len(decreases), sum(num_factorisations), self._recent_steps
        self._control.add_phase(name, num_moved, spent)
        for fall, number in zip(decreases, num_factorisations, strict=True):
            if fall == 0.0:
                recent.clear()
            recent.append((fall, self._method.newton_cost * number))
        total_fall, total_cost = map(sum, zip(*recent, strict=True))
        if decreases[-1] > 0.0 or name == "newton" or self._is_trial_due:
            self._gains[name] = total_fall / total_cost if total_cost > 0.0 else 0.0
        if name == "newton":
            others = self._fallen / self._spent if self._spent > 0.0 and count == 1 else 0.0
            is_better = self._converges_faster or self._gains["newton"] > others
            before = self._patience if count == 1 else _FIRST_PATIENCE
            self._patience = _FIRST_PATIENCE if is_better else 2.0 * before
            self._is_trial_due, self._spent, self._fallen = False, 0.0, 0.0
            self._trial_cost = self._patience * (recent[-1][1] or self._method.newton_cost)
            self._rounds["trial_iteration"] = self._num_lbfgs_iterations + GROUP_ITERATIONS * self._trial_cost
        else:
            self._spent, self._fallen = self._spent + self._method.newton_cost * spent, self._fallen + sum(decreases)
            self._is_trial_due |= self._spent >= self._trial_cost

    def _escape(self) -> DescentPoint | None:
        """Return a lower point next to the current saddle point, or None."""
        self._control.must_escape = False
        step, diagonal = self._step, self._method.system_diagonal
        at = self._method.read_point(step, self._run) if self._run is not None else self._point
        hessian = step.hessian(at.positions)
        if not hessian.factorise(0.0):
            return None
        self._control.begin_phase("escape")
        before = self._method.factor.num_factorisations
        found = probe_negative_curvature(step, at, hessian, diagonal) or escape_saddle(step, at, hessian, diagonal)
        self._control.add_phase("escape", 1, self._method.factor.num_factorisations - before)
        return found and found._replace(is_past_saddle=True)


def _is_collision_free(step: StepObjective, before: Positions, after: Positions) -> bool:
    """Return whether the displacement between positions (n, 3) is collision-free and ends without active contacts."""
    if not step.barrier_energies:
        return True
    return step.max_step_size(before, after - before) == 1.0 and not has_active_barrier(step, after)
