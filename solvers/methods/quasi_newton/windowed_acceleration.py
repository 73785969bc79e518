"""Accelerated first-order methods with one prefactored matrix: Anderson, Chebyshev and L-BFGS.

They share the iteration (`springbench.solvers.kernels.accelerated_descent`) and differ in the coefficients of a
direction. A step is fully compiled if the energies are springs, quadratic forms, strain limits and dashpots, and the
factor's panels are supported by the kernels. Otherwise the kernels alternate with the energies' own values and
gradients, and with the factor's own solve.

No iteration raises the objective, except by round-off. A trial that would is shortened, or replaced by the plain
correction, a local-global iteration, which descends by majorisation. If that does not descend either, within round-off,
the solve terminates as "stalled" and its iterate stays unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.idle_contact import skip_idle_contact
from springbench.solvers.iteration.iterative_solver import CompiledState, IterativeSolver, compute_max_coordinate
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.kernels import step_setup
from springbench.solvers.kernels.accelerated_descent import AccelerationWindow
from springbench.solvers.kernels.acceleration_coefficients import require_history_size
from springbench.solvers.kernels.iteration_loop import LoopLimits
from springbench.solvers.kernels.padding_coordinate import PADDING_COORDINATE
from springbench.solvers.kernels.spring_objective import ObjectiveWeights
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.linalg.solver_selection import LinearSolverName, Precision, build_linear_solver
from springbench.solvers.methods.local_global.accelerated_local_global import (
    AcceleratedState,
    AccelerationEngine,
    AccelerationScheme,
    InterpretedState,
    allocate_window,
)
from springbench.solvers.methods.local_global.fused_local_global import (
    PreparedCompiledLocalGlobal,
    compile_iterations,
)
from springbench.solvers.methods.local_global.prefactored import (
    PreparedLocalGlobal,
    prepare_local_global,
    require_projective,
)
from springbench.solvers.methods.quasi_newton import accelerated_step
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.step_problem import Positions, PreparedSolver, ProjectiveEnergy, StepProblem, System
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective


def prepare_accelerated(
    system: System, scheme: AccelerationScheme, linear: LinearSolverName, precision: Precision
) -> PreparedSolver:
    """Factorise Q and compile the iteration.

    Args:
        system: the system.
        scheme: coefficients of the acceleration.
        linear: solver of Q x = b.
        precision: floating-point type of its stored entries.

    Raises:
        Unsupported: for energies that the method does not support.
        NotPositiveDefinite: if the system leaves some positions undetermined.
    """
    alone = prepare_without_barriers(system, scheme, linear, precision)
    if without_barriers(system) is system:
        return alone
    base = alone.local_global
    base = replace(base, description=f"{base.description}; where pairs touch, iterations are interpreted")
    engine = _build_interpreted_engine(scheme, FixedObjective(system), base)
    return skip_idle_contact(PreparedAccelerated(base, engine), system, lambda: alone)


def prepare_without_barriers(
    system: System,
    scheme: AccelerationScheme,
    linear: LinearSolverName,
    precision: Precision,
    build_engine: Callable[[AccelerationScheme, PreparedCompiledLocalGlobal], CompiledEngine] | None = None,
) -> PreparedAccelerated:
    """Prepare the method that ignores the system's barrier energies, as `prepare_accelerated` does.

    Args:
        system: system, possibly with barriers and vertex contact.
        scheme: coefficients of the acceleration.
        linear: solver of Q x = b.
        precision: floating-point type of its stored entries.
        build_engine: builds the engine of compiled energies, `CompiledEngine` if omitted.

    Raises:
        Unsupported: for energies that the method does not support.
        NotPositiveDefinite: if the system leaves some positions undetermined.
    """
    bare = without_barriers(without_vertex_contact(system))
    energies = (
        require_projective(bare, scheme.name)
        if scheme.needs_projective
        else [energy for energy in bare.energies if isinstance(energy, ProjectiveEnergy)]
    )
    base = prepare_local_global(bare, energies, lambda Q: build_linear_solver(Q, linear, precision))
    found = compile_iterations(base, use_corrections=True)
    if not isinstance(found, PreparedCompiledLocalGlobal):
        base = replace(base, description=f"{base.description}; {found}")
        return PreparedAccelerated(
            base, _build_interpreted_engine(scheme, FixedObjective(system).ignore_barriers(), base)
        )
    engine = (build_engine or CompiledEngine)(scheme, found)
    if without_vertex_contact(system) is system:
        return PreparedAccelerated(found.base, engine)
    objective = FixedObjective(system).ignore_barriers()
    return PreparedAccelerated(found.base, _add_vertex_contact(scheme, objective, found.base, engine))


def _build_interpreted_engine(
    scheme: AccelerationScheme, objective: FixedObjective, base: PreparedLocalGlobal
) -> AccelerationEngine:
    """Build the interpreted iteration of an objective."""
    engine = _InterpretedEngine(scheme, objective, base)
    if without_vertex_contact(objective.system) is objective.system:
        return engine
    return _add_vertex_contact(scheme, objective, base, engine)


def _add_vertex_contact(
    scheme: AccelerationScheme, objective: FixedObjective, base: PreparedLocalGlobal, engine: AccelerationEngine
) -> AccelerationEngine:
    from springbench.solvers.methods.quasi_newton.quasi_newton_contact import ContactEngine

    return ContactEngine(scheme, objective, base, engine)


@dataclass(frozen=True)
class WindowedAcceleration:
    """Base class of methods with a history of recent iterations.

    Args:
        history_size: number of stored differences.
        linear_solver: solver of Q x = b.
        precision: floating-point type of its stored entries.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True

    history_size: int = 5
    linear_solver: LinearSolverName = "auto"
    precision: Precision = "float64"

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        require_history_size(self.history_size)


@dataclass(frozen=True, eq=False)
class PreparedAccelerated(IterativeSolver):
    """An accelerated method, prepared: `local_global` has the prefactored Q, `acceleration_engine` iterates."""

    local_global: PreparedLocalGlobal
    acceleration_engine: AccelerationEngine

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.local_global.stats

    @property
    def description(self) -> str:
        """Description of the linear solver."""
        return self.local_global.description

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> AcceleratedState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return self.acceleration_engine.init_state(problem, initial_guess)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return compute_max_coordinate(problem) * self.local_global.unpinned_trace**0.5


class CompiledEngine:
    """Compiled iteration for springs and similar energies, with a factor that is split into blocks."""

    def __init__(self, scheme: AccelerationScheme, compiled: PreparedCompiledLocalGlobal) -> None:
        self._acceleration_scheme = scheme
        self.spring_form, self._form = compiled.spring_form, compiled.norm_packets
        plan, packets, self._rows = compiled.iteration_plan, compiled.spring_packets, compiled.vertex_rows
        pins = compiled.base.system.pins
        self._block_entries = 4 * int(plan.block_table[:, 1].max())
        self._plan, self._spring_packets, self._padding_row = plan, packets, compiled.padding_row
        self._shares = ObjectiveWeights.from_packets(
            packets, plan.anchor_stiffness, self._rows.row_of_vertex[pins.vertices[pins.exact_mask]]
        )
        self.has_energy_scales = bool(self.spring_form.form_builders) or self.spring_form.has_edges
        self.free_memory: list[AccelerationMemory] = []
        self.start_solve, self.run_solve, self.read_positions = (
            TypedKernel(accelerated_step.start_solve),
            TypedKernel(accelerated_step.run_solve),
            TypedKernel(step_setup.read_positions),
        )

    def _allocate_memory(self) -> AccelerationMemory:
        whole = 4 * len(self._plan.anchor_stiffness)
        window = allocate_window(self._acceleration_scheme, self._block_entries, whole, self._plan.inverse_blocks.dtype)
        window.trial_position[4 * self._padding_row] = PADDING_COORDINATE
        x = allocate_aligned(whole, self._plan.inverse_blocks.dtype)
        vectors = (
            self._spring_packets.build_right_hand_side(self._plan.anchor_stiffness),
            x,
            allocate_aligned(whole),
            np.zeros(3),
        )
        packets = self._spring_packets.with_own_dashpots()
        return accelerated_step.AcceleratedStep(
            self._plan, packets, self._form, self._shares, self._rows, *vectors
        ), window

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> AcceleratedState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return CompiledAccelerationState(self, problem, initial_guess).start_at_guess()

    def take_memory(self) -> AccelerationMemory:
        """Return the work arrays of a solve that has ended, or allocate them."""
        return self.free_memory.pop() if self.free_memory else self._allocate_memory()


AccelerationMemory = tuple[accelerated_step.AcceleratedStep, AccelerationWindow, *tuple[Any, ...]]
"""Work arrays of a solve; an engine may add others."""


class CompiledAccelerationState(CompiledState, AcceleratedState):
    """State of a compiled solve, whose work arrays return to the engine."""

    def __init__(self, engine: CompiledEngine, problem: StepProblem, guess: Positions) -> None:
        """Prepare a solve.

        Args:
            engine: iteration of the system.
            problem: step whose objective is minimised.
            guess: initial guess (n, 3) [m].
        """
        self._engine, self._memory, parts = engine, engine.take_memory(), engine.spring_form
        step, window = self._memory[:2]
        if parts.has_edges:
            step = step._replace(spring_packets=parts.update_edges(step.spring_packets, problem))
        self._state = step, window
        self._external_force = external = as_kernel_array(problem.external_force)
        force = parts.compute_force(problem) if parts.form_builders else external
        self._step_arrays = (
            as_kernel_array(problem.inertial_target),
            force,
            as_kernel_array(problem.pin_targets),
            as_kernel_array(guess),
        )
        self.positions = np.empty(guess.shape)

    def start_at_guess(self) -> Self:
        """Start the solve at the initial guess; return the state."""
        self.start_residual = self._engine.start_solve.call(*self._state, *self._step_arrays)
        if self._engine.has_energy_scales:
            self._add_energy_scales(self._step_arrays[-1])
        return self

    def restart_at(self, p: Positions) -> Self:
        """Start the solve of the same step again at positions p (n, 3) [m]; return the state."""
        self._step_arrays = *self._step_arrays[:-1], as_kernel_array(p)
        return self.start_at_guess()

    @property
    def kernel_data(self) -> tuple[Any, Any, Any, Any, Any, Any] | None:
        """Arguments of `accelerated_step.iterate_from` before the number of iterations.

        It is None with strain limits or dashpots, whose scales of cancellation are not computed there.
        """
        parts, (target, force, pin_targets, _) = self._engine.spring_form, self._step_arrays
        return None if parts.has_edges else (*self._state, parts.negative_pairs, target, force, pin_targets)

    def _add_energy_scales(self, p: Positions) -> None:
        """Add the scales of cancellation in forms and edges at the start p (n, 3) [m]."""
        parts, values = self._engine.spring_form, self._state[0].objective_values
        if parts.form_builders:
            values[2] = parts.negative_energy(p)
        if parts.has_edges:
            values[1] += parts.edge_energy_scale(p)

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Run iterations within the limits; return count, residual and reason."""
        return self._engine.run_solve.call(*self._state, limits, self.positions)

    @property
    def objective_decrease(self) -> float:
        """Decrease of the objective so far [J], unless round-off hides it."""
        return float(self._state[-1].window_state["objective_decrease"][0])

    def gradient(self) -> Positions:
        """Return the gradient of the objective (n, 3) [N] at the current point."""
        step, window = self._state
        out = np.empty_like(self.positions)
        self._engine.read_positions.call(step.vertex_rows, window.descent, out)
        return np.negative(out, out=out)

    def __del__(self) -> None:
        self._engine.free_memory.append(self._memory)


class _InterpretedEngine:
    """Interpreted iteration for all energies and all factors."""

    def __init__(self, scheme: AccelerationScheme, objective: FixedObjective, base: PreparedLocalGlobal) -> None:
        self._acceleration_scheme, self._local_global, self._fixed_objective = scheme, base, objective

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> AcceleratedState:
        """Start a solve from an initial guess (n, 3) [m]."""
        return InterpretedState(
            self._local_global, self._acceleration_scheme, StepObjective(self._fixed_objective, problem), initial_guess
        )
