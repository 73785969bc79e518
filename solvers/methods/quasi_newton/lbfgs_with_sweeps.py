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
from springbench.solvers.methods.quasi_newton.windowed_acceleration import CompiledAccelerationState, CompiledEngine
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
        return LbfgsSweepState(
            self, self._free_states, self._take_memory(), self._solve_kernels, self._spring_form, problem, guess, start
        )


class LbfgsSweepState(CompiledAccelerationState):
    """State of a compiled solve whose rounds alternate with sweeps."""

    _sweep_step: SweepStep | None = None

    def __init__(self, engine: LbfgsSweepEngine, *given: Any) -> None:
        """Start a solve.

        Args:
            engine: iteration of the system.
            given: arguments of `CompiledAccelerationState`.
        """
        super().__init__(*given)
        self._engine = engine

    def run_rounds(self, rounds: NDArray[Any], limits: LoopLimits) -> tuple[int, float, int]:
        """Run rounds of iterations within the limits, compiled.

        Args:
            rounds: state of the rounds (1,), updated.
            limits: limits, in rounds.
        """
        self._sweep_step = sweep_step = self._sweep_step or self._start_sweeps()
        return self._engine.round_kernel.call(*self._state, sweep_step, rounds, limits, self.positions)

    def _start_sweeps(self) -> SweepStep:
        """Return the data of the sweeps in this solve."""
        made = self._engine.sweeps
        memory = made.take_memory()
        memory.sweep_scratch.omega[0] = NOT_STARTED
        blocks = made.update_packets(self._problem)
        return SweepStep(blocks, made.vertex_rows, made.spectral_radius, memory, *self._step_arrays)

    def __del__(self) -> None:
        super().__del__()
        if self._sweep_step is not None:
            self._engine.sweeps.free_memory.append(self._sweep_step.sweep_memory)
