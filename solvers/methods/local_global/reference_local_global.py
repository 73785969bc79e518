"""Local-global iterations with one prefactored matrix (Liu et al. 2013, section 4).

    y = M target/dt^2 + f + w C'C p_pin                 once a step
    local step   d_e = r_e (A p)_e / |(A p)_e|          each iteration
    global step  Q p = A'K d + y

An iteration from p to LG(p) is a preconditioned gradient step of length one, Q^-1 grad g(p) = p - LG(p). It never
raises the energy, because A'KA - Hessian is positive semidefinite. Exact pins are eliminated: their rows are removed
from Q, and their columns contribute to the right-hand side.

Backends differ only in the implementation of the two steps: `DenseLocalGlobal` uses NumPy matrices, `SparseLocalGlobal`
SciPy matrices, and `springbench.solvers.methods.local_global.compiled_local_global` compiled code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.iteration.solver_info import LIU_2013, LOCAL_GLOBAL_FAMILY, SolverInfo
from springbench.solvers.linalg import memory
from springbench.solvers.linalg.direct_solvers import DenseCholesky, SparseLU
from springbench.solvers.methods.local_global.prefactored import (
    PreparedLocalGlobal,
    collect_factor_stats,
    prepare_local_global,
    require_only_springs,
    require_projective,
)
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.energies.spring_energy import ZERO_LENGTH
from springbench.solvers.model.step_problem import Positions, PreparedSolver, System, Unsupported

_LARGE_MATRIX_ENTRIES = 2**19
"""Entries of a matrix that exceeds the cache of any core."""


def _multiply_dense(matrix: NDArray[np.float64], x: Positions) -> Positions:
    """Multiply a dense matrix by x (k, 3).

    A large product is computed as (x' matrix')' with the same sums in half of the time: BLAS copies one of the two
    factors before the product, and this order avoids a copy of the whole matrix.
    """
    if matrix.size < _LARGE_MATRIX_ENTRIES:
        return matrix @ x
    return np.ascontiguousarray((np.ascontiguousarray(x.T) @ matrix.T).T)


@dataclass(frozen=True)
class DenseLocalGlobal:
    """Local-global with NumPy matrices and a dense Cholesky factor.

    For small meshes, and for comparison with the paper line by line.
    """

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        LOCAL_GLOBAL_FAMILY,
        LIU_2013,
        formula="Q p⁺ = AᵀK d(p) + y, dense Cholesky",
        cost="1 dense solve, 1 pass",
    )

    def prepare(self, system: System) -> PreparedLocalGlobal:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and if the matrices do not fit in memory.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        springs, n = require_only_springs(system, "dense"), system.num_vertices
        needs, room = 24.0 * n * (len(springs.edges) + n), memory.compute_memory_limit()  # three matrices of each shape
        if needs > room:
            raise Unsupported(
                f"dense: its matrices of {n:,} vertices and {len(springs.edges):,} springs take "
                f"{memory.format_bytes(needs)} of memory, where {memory.format_bytes(room)} may be taken; "
                "take sparse or numba, or a coarser mesh"
            )
        _, vertices, weight = system.penalty_pins
        A = system_matrix_assembly.signed_incidence_matrix_dense(springs.edges, n)
        M = system_matrix_assembly.mass_matrix_dense(system.mass)
        C = system_matrix_assembly.selection_matrix_dense(vertices, n)
        Q = system_matrix_assembly.system_matrix_dense(
            A, springs.stiffness, system.inertia_factor * M, system.time_step, C, weight
        )
        system_matrix_assembly.require_determined_positions(system, csr_array(Q))
        AtK = np.ascontiguousarray(A.T * springs.stiffness)
        r, rest_direction = springs.rest_length[:, None], springs.rest_direction

        def project(p: Positions, y: Positions, out: Positions) -> None:
            v = _multiply_dense(A, p)
            length = np.sqrt(np.einsum("ij,ij->i", v, v))[:, None]
            d = r * np.where(length <= ZERO_LENGTH, rest_direction, v / np.maximum(length, ZERO_LENGTH))
            np.add(_multiply_dense(AtK, d), y, out=out)

        free = system.free_vertices
        exact = system.pins.vertices[system.pins.exact_mask]
        factor = DenseCholesky(Q[np.ix_(free, free)])
        return PreparedLocalGlobal(
            system,
            project,
            factor,
            csr_array(Q[np.ix_(free, exact)]),
            lambda e: system_matrix_assembly.energy_norm(Q, e),
            float(np.diag(Q)[system.unpinned_mask].sum()),
            collect_factor_stats(int(np.count_nonzero(Q)), factor),
            "dense Cholesky",
        )


@dataclass(frozen=True)
class SparseLocalGlobal:
    """Local-global with SciPy sparse matrices and one sparse factorisation, for all projective energies."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        LOCAL_GLOBAL_FAMILY,
        LIU_2013,
        formula="Q p⁺ = AᵀK d(p) + y, SuperLU",
        cost="1 solve, 1 pass",
    )

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy is not projective.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        if without_vertex_contact(system) is not system:
            from springbench.solvers.methods.local_global.half_space_contact import prepare_with_half_spaces

            return prepare_with_half_spaces(self, system)
        if without_barriers(system) is not system:
            from springbench.solvers.methods.local_global.barrier_contact import prepare_with_barriers

            return prepare_with_barriers(self, system)
        return prepare_local_global(system, require_projective(system, "sparse"), lambda Q: (SparseLU(Q), "SuperLU"))
