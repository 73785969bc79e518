"""Plain C++ baseline: local-global iterations with Eigen, as in a course assignment (`eigen.hpp`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from solvers.about import LIU_2013, LOCAL_GLOBAL, About
from solvers.core import native
from solvers.core.prefactored import PreparedLocalGlobal, only_springs
from solvers.problem import System

NEEDS = "Eigen 3.4 (Debian: libeigen3-dev) and C++17"


@dataclass(frozen=True)
class EigenLocalGlobal:
    """Local-global in C++ for springs, with Eigen's sparse matrices and SimplicialLLT."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013)

    def prepare(self, system: System) -> PreparedLocalGlobal:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and if no C++ compiler is available.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        springs = only_springs(system, "eigen")
        compiled = native.Native(native.library(native.HEADERS / "eigen.cpp", NEEDS), system, springs)
        return native.prepared(PreparedLocalGlobal, system, springs, compiled, "Eigen's SimplicialLLT")
