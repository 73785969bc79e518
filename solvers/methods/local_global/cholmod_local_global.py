"""Optimised C++ baseline: local-global iterations (`cholmod_local_global.cpp`) with CHOLMOD's ordering and factor.

The second C++ baseline of the compiled solvers; the first is the plain program of `eigen_local_global`.
"""

from __future__ import annotations

from ctypes import c_int64
from dataclasses import dataclass
from typing import ClassVar

from springbench.solvers.iteration.solver_info import LIU_2013, LOCAL_GLOBAL_FAMILY, SolverInfo
from springbench.solvers.methods.local_global import cpp_backend
from springbench.solvers.methods.local_global.prefactored import (
    LocalGlobalState,
    PreparedLocalGlobal,
    require_only_springs,
)
from springbench.solvers.model.step_problem import Positions, StepProblem, System

CHOLMOD_REQUIREMENTS = "CHOLMOD (Debian: libsuitesparse-dev) and C++17"


@dataclass(frozen=True)
class CholmodLocalGlobal:
    """Local-global in C++ for springs: one loop over springs, and solves with CHOLMOD's simplicial factor."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        LOCAL_GLOBAL_FAMILY,
        LIU_2013,
        formula="Q p⁺ = AᵀK d(p) + y, CHOLMOD in C++",
        cost="1 solve, 1 pass",
    )

    def prepare(self, system: System) -> PreparedCholmod:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and if no C++ compiler is available.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        springs = require_only_springs(system, "cholmod")
        library = cpp_backend.load_library(
            cpp_backend.HEADER_FOLDER / "cholmod_local_global.cpp", CHOLMOD_REQUIREMENTS, ["-lcholmod"]
        )
        compiled = cpp_backend.CppBackend(library, system, springs)
        return cpp_backend.prepare_cpp_backend(
            PreparedCholmod, system, springs, compiled, "CHOLMOD's simplicial factor"
        )


class PreparedCholmod(PreparedLocalGlobal):
    """CHOLMOD local-global, prepared; iterations without residual checks stay in C++."""

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> _CholmodState:
        """Start a solve from an initial guess.

        Args:
            problem: step whose objective is minimised.
            initial_guess: positions (n, 3) [m], not modified.
        """
        return _CholmodState(self, problem, initial_guess)


class _CholmodState(LocalGlobalState):
    def run_unchecked(self, num_iterations: int) -> int:
        """Do all iterations but the last one in C++; return their number."""
        if num_iterations < 2:
            return super().run_unchecked(num_iterations)
        compiled = self.base.factor
        assert isinstance(compiled, cpp_backend.CppBackend)
        given = map(cpp_backend.array_address, (self.positions, self.right_hand_side))
        compiled.library.iterate(compiled.handle, c_int64(num_iterations - 1), *given)
        return num_iterations - 1 + super().run_unchecked(1)
