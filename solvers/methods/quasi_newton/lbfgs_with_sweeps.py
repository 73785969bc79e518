"""L-BFGS in rounds that alternate with sweeps of vertex block descent.

The kernels are those of `springbench.solvers.methods.quasi_newton.sweep_rounds`.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.kernels.free_components import FreeComponents
from springbench.solvers.kernels.iteration_loop import NO_ITERATIONS, LoopLimits
from springbench.solvers.methods.local_global.accelerated_local_global import AccelerationScheme
from springbench.solvers.methods.local_global.fused_local_global import PreparedCompiledLocalGlobal
from springbench.solvers.methods.quasi_newton.sweep_rounds import (
    CONTINUES,
    NOT_STARTED,
    STARTS,
    STARTS_MEASURED,
    StepArrays,
    SweepStep,
    run_sweep_rounds,
)
from springbench.solvers.methods.quasi_newton.windowed_acceleration import (
    AccelerationMemory,
    CompiledAccelerationState,
    CompiledEngine,
)
from springbench.solvers.methods.vertex_block import vbd
from springbench.solvers.model.step_problem import Positions, StepProblem


class LbfgsSweepEngine(CompiledEngine):
    """Compiled iteration whose rounds alternate with sweeps."""

    def __init__(
        self, scheme: AccelerationScheme, compiled: PreparedCompiledLocalGlobal, free_components: FreeComponents
    ) -> None:
        """Prepare the iteration and the sweeps of a system.

        Args:
            scheme: coefficients of the acceleration.
            compiled: local-global method of the system, whose energies are compiled.
            free_components: components of the system whose translation only inertia resists.
        """
        super().__init__(scheme, compiled)
        self._free_components = free_components
        system = compiled.base.system
        parts = vbd.decompose_system(system, "hybrid")
        self.sweeps = vbd.PreparedVertexBlockDescent.from_blocks(system, *parts, 0.0, compiled)
        self.round_kernel, self.unpinned_trace = TypedKernel(run_sweep_rounds), compiled.base.unpinned_trace

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> LbfgsSweepState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return LbfgsSweepState(self, problem, initial_guess).start_at_guess()

    def _allocate_memory(self) -> AccelerationMemory:
        made = self.sweeps
        return *super()._allocate_memory(), SweepStep(made.vertex_rows, made.allocate_memory(), self._free_components)


class LbfgsSweepState(CompiledAccelerationState):
    """State of a compiled solve whose rounds alternate with sweeps.

    Attributes:
        start_positions: positions (n, 3) [m] at which the first rounds started the solve.
    """

    def __init__(self, engine: LbfgsSweepEngine, problem: StepProblem, guess: Positions) -> None:
        """Prepare a solve, which its first rounds start.

        Its start is chosen by `accelerated_step.start_lowest_solve`.

        Args:
            engine: iteration of the system.
            problem: step whose objective is minimised.
            guess: initial guess (n, 3) [m], not modified.
        """
        super().__init__(engine, problem, guess)
        _, _, sweeps = self._memory
        if engine.spring_form.has_edges:
            sweeps = sweeps._replace(sweep_memory=engine.sweeps.update_packets(sweeps.sweep_memory, problem))
        self.start_positions = np.empty(guess.shape)
        is_current = guess is problem.current_positions
        current = self._step_arrays[-1] if is_current else as_kernel_array(problem.current_positions)
        given = *self._step_arrays, self._external_force, current
        arrays = StepArrays(*given, self.start_positions, self.positions)
        self._round_arguments = *self._state, sweeps, arrays
        self._round_kernel, self._trace, self._start_kind = engine.round_kernel, engine.unpinned_trace, STARTS

    def start_at_guess(self) -> Self:
        """Start the solve at the initial guess; return the state."""
        self._round_arguments[2].sweep_memory.sweep_scratch.omega[0] = NOT_STARTED
        self._start_kind = CONTINUES
        return super().start_at_guess()

    def start_lowest(self, rounds: NDArray[Any]) -> float:
        """Start the solve at the point with the lowest objective, without rounds.

        Args:
            rounds: state of the rounds (1,), updated.

        Returns:
            The residual at the guess [J^(1/2)].
        """
        return self._start_solve(rounds, STARTS_MEASURED)

    def _start_solve(self, rounds: NDArray[Any], start: int) -> float:
        """Start the solve without rounds; return the residual at the guess [J^(1/2)] or NaN."""
        self._start_kind = CONTINUES
        residual = self._round_kernel.call(*self._round_arguments, start, self._trace, rounds, NO_ITERATIONS)[3]
        self._add_energy_scales(self.start_positions)
        return residual

    def run_rounds(self, rounds: NDArray[Any], limits: LoopLimits) -> tuple[int, float, int]:
        """Run rounds of iterations within the limits, compiled; the first ones start the solve.

        Args:
            rounds: state of the rounds (1,), updated.
            limits: limits, in rounds.
        """
        if self._start_kind != CONTINUES and self._engine.has_energy_scales:
            self._start_solve(rounds, STARTS)
        start, self._start_kind = self._start_kind, CONTINUES
        return self._round_kernel.call(*self._round_arguments, start, self._trace, rounds, limits)[:3]
