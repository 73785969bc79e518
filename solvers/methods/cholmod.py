"""Local-global iterations as a careful C++ program has them (`cholmod.cpp`), with CHOLMOD's ordering and factor.

What the compiled solvers are measured with besides the plain program of `eigen`: the second yardstick.
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
    """One loop over the springs, and a solve by the columns of CHOLMOD's simplicial factor, for springs."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013)

    def prepare(self, system: System) -> PreparedCholmod:
        """Raises Unsupported for energies other than springs and where nothing can be compiled, NotPositiveDefinite."""
        springs = only_springs(system, "cholmod")
        library = native.library(native.HEADERS / "cholmod.cpp", NEEDS, ["-lcholmod"])
        compiled = native.Native(library, system, springs)
        return native.prepared(PreparedCholmod, system, springs, compiled, "CHOLMOD's simplicial factor")


class PreparedCholmod(PreparedLocalGlobal):
    """Iterations of which nobody asks for the residual stay in C++."""

    def begin(self, problem: StepProblem, guess: Positions) -> _Iterations:
        """See Iterative."""
        return _Iterations(self, problem, guess)


class _Iterations(Iterations):
    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating."""
        if limits.wanted == EACH or limits.iterations < 2:
            return super().iterate(limits)
        compiled = self.base.factor
        assert isinstance(compiled, native.Native)
        given = map(native.address, (self.positions, self.constant))
        compiled.library.iterate(compiled.made, c_int64(limits.iterations - 1), *given)
        count, residual, _ = super().iterate(limits._replace(iterations=1))
        return limits.iterations - 1 + count, residual, ITERATIONS
