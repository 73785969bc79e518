"""A row names the path that its iterations took: compiled as a whole, or through Python, and why."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
from scipy.sparse import csr_array
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.quasi_newton.anderson import Anderson
from springbench.solvers.methods.quasi_newton.chebyshev import Chebyshev
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, Solver, System

from tests.scene_builders import build_cloth, build_first_problem


@dataclass(frozen=True)
class Foreign:
    """Springs by another name, which no kernel supports."""

    springs: Springs

    def value(self, p: Positions) -> float:
        return self.springs.value(p)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        self.springs.add_gradient(p, out)

    def hessian(self, p: Positions) -> csr_array:
        return self.springs.hessian(p)

    def stiffness_matrix(self, n: int) -> csr_array:
        return self.springs.stiffness_matrix(n)

    def add_projection(self, p: Positions, out: Positions) -> None:
        self.springs.add_projection(p, out)


SYSTEM = build_first_problem(build_cloth(6)).system


def foreign(system: System) -> System:
    (springs,) = (energy for energy in system.energies if isinstance(energy, Springs))
    return replace(system, energies=(Foreign(springs),))


METHODS: tuple[Solver, ...] = (CompiledLocalGlobal(), Anderson(), Chebyshev(), Lbfgs())


@pytest.mark.parametrize("solver", METHODS, ids=repr)
def test_an_energy_that_the_kernels_do_not_support_is_stated_in_the_description(solver: Solver):
    known, unknown = (solver.prepare(system).description for system in (SYSTEM, foreign(SYSTEM)))
    assert "iterations compiled" in known
    assert "through Python" not in known
    assert "iterations through Python: the kernels do not support Foreign" in unknown
    assert "compiled" not in unknown


@pytest.mark.parametrize("solver", [CompiledLocalGlobal(linear_solver="cg"), Lbfgs(linear_solver="cg")], ids=repr)
def test_a_linear_solver_called_from_python_is_stated_in_the_description(solver: Solver):
    assert "iterations through Python: this linear solver" in solver.prepare(SYSTEM).description
