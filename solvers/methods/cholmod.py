"""Optimised C++ baseline: local-global iterations (`cholmod.cpp`) with CHOLMOD's ordering and factor.

The second C++ baseline of the compiled solvers; the first is the plain program of `eigen_local_global`.
"""

from __future__ import annotations

from ctypes import c_int64
from dataclasses import dataclass
from typing import ClassVar

from solvers.about import LIU_2013, LOCAL_GLOBAL, About
from solvers.core import native
from solvers.core.prefactored import Iterations, PreparedLocalGlobal, only_springs
from solvers.kernels.loop import EACH, ITERATIONS, Limits
from solvers.problem import Positions, StepProblem, System

NEEDS = "CHOLMOD (Debian: libsuitesparse-dev) and C++17"


@dataclass(frozen=True)
class CholmodLocalGlobal:
    """Local-global in C++ for springs: one loop over springs, and solves with CHOLMOD's simplicial factor."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013)

    def prepare(self, system: System) -> PreparedCholmod:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and if no C++ compiler is available.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        springs = only_springs(system, "cholmod")
        library = native.library(native.HEADERS / "cholmod.cpp", NEEDS, ["-lcholmod"])
        compiled = native.Native(library, system, springs)
        return native.prepared(PreparedCholmod, system, springs, compiled, "CHOLMOD's simplicial factor")


class PreparedCholmod(PreparedLocalGlobal):
    """CHOLMOD local-global, prepared; iterations without residual checks stay in C++."""

    def begin(self, problem: StepProblem, guess: Positions) -> _Iterations:
        """Start a solve from an initial guess (n, 3) [m]."""
        return _Iterations(self, problem, guess)


class _Iterations(Iterations):
    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Run iterations within the limits; return their number, the residual and the reason of the end."""
        if limits.wanted == EACH or limits.iterations < 2:
            return super().iterate(limits)
        compiled = self.base.factor
        assert isinstance(compiled, native.Native)
        given = map(native.address, (self.positions, self.constant))
        compiled.library.iterate(compiled.made, c_int64(limits.iterations - 1), *given)
        count, residual, _ = super().iterate(limits._replace(iterations=1))
        return limits.iterations - 1 + count, residual, ITERATIONS
