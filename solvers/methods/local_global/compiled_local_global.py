"""Compiled local-global iterations: a step runs without Python from start to end.

Factors in float64 solve for positions, Q p = A'K d + y. Less precise factors solve for corrections,
p <- p - Q^-1 grad g(p), with the gradient in float64. Both converge to the same limit, to all digits of float64; only
the intermediate iterates differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log10
from typing import ClassVar

import numpy as np
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.solver_info import LIU_2013, LOCAL_GLOBAL_FAMILY, SolverInfo
from springbench.solvers.kernels import spring_local_step as kernels
from springbench.solvers.kernels.padding_coordinate import PADDING_COORDINATE
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.linalg.solver_selection import LinearSolverName, Precision, build_linear_solver
from springbench.solvers.methods.local_global.fused_local_global import (
    MAX_POSITION_LOSS,
    PreparedCompiledLocalGlobal,
    compile_iterations,
)
from springbench.solvers.methods.local_global.prefactored import LocalStep, prepare_local_global, require_projective
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, PreparedSolver, System


@dataclass(frozen=True)
class CompiledLocalGlobal:
    """Compiled local-global with a linear solver that is selected by size, or given.

    Args:
        linear_solver: solver of Q p = b.
        precision: floating-point type of its stored entries.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    min_direct_digits: ClassVar[float] = -log10(MAX_POSITION_LOSS)
    """Digits of a spring's length that solves for positions have at least; with fewer, corrections are solved for."""
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        LOCAL_GLOBAL_FAMILY,
        LIU_2013,
        is_family_default=True,
        formula="Q p⁺ = AᵀK d(p) + y, compiled supernodal Cholesky",
        cost="1 solve, 1 pass",
    )

    linear_solver: LinearSolverName = "auto"
    precision: Precision = "float64"

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy is neither projective nor contact.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        if without_vertex_contact(system) is not system:
            from springbench.solvers.methods.local_global.half_space_contact import prepare_with_half_spaces

            return prepare_with_half_spaces(self, system)
        if without_barriers(system) is not system:
            from springbench.solvers.methods.local_global.barrier_contact import prepare_with_barriers

            return prepare_with_barriers(self, system)
        energies = require_projective(system, "numba")
        springs = [energy for energy in energies if isinstance(energy, Springs)]
        alone = [Springs.from_parts(springs)] if len(springs) == len(energies) else []
        base = prepare_local_global(
            system,
            alone or energies,
            lambda Q: build_linear_solver(Q, self.linear_solver, self.precision),
            is_low_precision=self.precision != "float64",
        )
        found = compile_iterations(base)
        if isinstance(found, PreparedCompiledLocalGlobal):
            return found
        local = {"local_step": _compile_local_step(alone[0], system.num_vertices)} if alone else {}
        return replace(base, description=f"{base.description}; {found}", **local)


def _compile_local_step(springs: Springs, n: int) -> LocalStep:
    """Compile the local step for a linear solver that is called from Python."""
    packets, _ = kernels.SpringPackets.from_springs(springs, np.arange(n), np.zeros(n, np.int64), 1, n, n + 1)
    x, b = (allocate_aligned(4 * (n + 2)) for _ in range(2))
    x[4 * (n + 1)] = PADDING_COORDINATE
    zero = packets.build_right_hand_side(np.zeros(n + 2))

    def project(p: Positions, y: Positions, out: Positions) -> None:
        kernels.run_local_step(packets, p, y, x, b, zero, out)

    return project
