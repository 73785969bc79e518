"""L-BFGS in rounds that alternate with sweeps of vertex block descent.

The kernels are those of `springbench.solvers.methods.quasi_newton.sweep_rounds`.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.kernels.iteration_loop import LoopLimits
from springbench.solvers.methods.local_global.accelerated_local_global import AccelerationScheme
from springbench.solvers.methods.local_global.fused_local_global import PreparedCompiledLocalGlobal
from springbench.solvers.methods.quasi_newton.sweep_rounds import NOT_STARTED, SweepStep, run_sweep_rounds
from springbench.solvers.methods.quasi_newton.windowed_acceleration import (
    AccelerationMemory,
    CompiledAccelerationState,
    CompiledEngine,
)
from springbench.solvers.methods.vertex_block import vbd
from springbench.solvers.model.step_problem import Positions, StepProblem


class LbfgsSweepEngine(CompiledEngine):
    """Compiled iteration whose rounds alternate with sweeps."""

    def __init__(self, scheme: AccelerationScheme, compiled: PreparedCompiledLocalGlobal) -> None:
        """Prepare the iteration and the sweeps of a system.

        Args:
            scheme: coefficients of the acceleration.
            compiled: local-global method of the system, whose energies are compiled.
        """
        super().__init__(scheme, compiled)
        system, radius = compiled.base.system, vbd.VertexBlockDescent().spectral_radius
        parts = vbd.decompose_system(system, "hybrid")
        self.sweeps = vbd.PreparedVertexBlockDescent.from_blocks(system, *parts, radius, compiled)
        self.round_kernel = TypedKernel(run_sweep_rounds)

    def _init_state(self, problem: StepProblem, guess: Positions, start: int) -> LbfgsSweepState:
        return LbfgsSweepState(self, problem, guess, start)

    def _allocate_memory(self) -> AccelerationMemory:
        made = self.sweeps
        return *super()._allocate_memory(), SweepStep(made.vertex_rows, made.spectral_radius, made.allocate_memory())


class LbfgsSweepState(CompiledAccelerationState):
    """State of a compiled solve whose rounds alternate with sweeps."""

    def __init__(self, engine: LbfgsSweepEngine, problem: StepProblem, guess: Positions, start: int) -> None:
        """Start a solve.

        Args:
            engine: iteration of the system.
            problem: step whose objective is minimised.
            guess: initial guess (n, 3) [m].
            start: START_AT_GUESS, START_LOWER or START_LOWER_MEASURED.
        """
        super().__init__(engine, problem, guess, start)
        _, _, sweeps = self._memory
        sweeps.sweep_memory.sweep_scratch.omega[0] = NOT_STARTED
        if (memory := engine.sweeps.update_packets(sweeps.sweep_memory, problem)) is not sweeps.sweep_memory:
            sweeps = sweeps._replace(sweep_memory=memory)
        self._round_kernel, self._sweeps = engine.round_kernel, sweeps

    def run_rounds(self, rounds: NDArray[Any], limits: LoopLimits) -> tuple[int, float, int]:
        """Run rounds of iterations within the limits, compiled.

        Args:
            rounds: state of the rounds (1,), updated.
            limits: limits, in rounds.
        """
        return self._round_kernel.call(*self._state, self._sweeps, self._step_arrays, rounds, limits, self.positions)
