"""Plain C++ baseline: local-global iterations with Eigen, as in a course assignment (`eigen_local_global.hpp`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from springbench.solvers.iteration.solver_info import LIU_2013, LOCAL_GLOBAL_FAMILY, SolverInfo
from springbench.solvers.methods.local_global import cpp_backend
from springbench.solvers.methods.local_global.prefactored import PreparedLocalGlobal, require_only_springs
from springbench.solvers.model.step_problem import System

EIGEN_REQUIREMENTS = "Eigen 3.4 (Debian: libeigen3-dev) and C++17"


@dataclass(frozen=True)
class EigenLocalGlobal:
    """Local-global in C++ for springs, with Eigen's sparse matrices and SimplicialLLT."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        LOCAL_GLOBAL_FAMILY,
        LIU_2013,
        formula="Q p⁺ = AᵀK d(p) + y, Eigen in C++",
        cost="1 solve, 1 pass",
    )

    def prepare(self, system: System) -> PreparedLocalGlobal:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and if no C++ compiler is available.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        springs = require_only_springs(system, "eigen")
        compiled = cpp_backend.CppBackend(
            cpp_backend.load_library(cpp_backend.HEADER_FOLDER / "eigen_local_global.cpp", EIGEN_REQUIREMENTS),
            system,
            springs,
        )
        return cpp_backend.prepare_cpp_backend(PreparedLocalGlobal, system, springs, compiled, "Eigen's SimplicialLLT")
