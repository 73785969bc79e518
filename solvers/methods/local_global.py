"""Local-global iterations with one prefactored matrix (Liu et al. 2013, section 4).

    y = M target/dt^2 + f + w C'C p_pin                 once a step
    local step   d_e = r_e (A p)_e / |(A p)_e|          each iteration
    global step  Q p = A'K d + y

An iteration from p to LG(p) is a preconditioned gradient step of length one, Q^-1 grad g(p) = p - LG(p). It never
raises the energy, because A'KA - Hessian is positive semidefinite. Exact pins are eliminated: their rows are removed
from Q, and their columns contribute to the right-hand side.

Backends differ only in the implementation of the two steps: `DenseLocalGlobal` uses NumPy matrices,
`SparseLocalGlobal` SciPy matrices, and `solvers.methods.local_global_compiled` compiled code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from solvers import matrices, memory
from solvers.about import LIU_2013, LOCAL_GLOBAL, About
from solvers.contact.touching import without_contact
from solvers.core.bounds import without_bounded
from solvers.core.prefactored import PreparedLocalGlobal, facts, only_springs, prepared, projective
from solvers.energies.springs import TINY
from solvers.linear.factors import DenseCholesky, SparseLU
from solvers.problem import Positions, Prepared, System, Unsupported

_LARGE = 2**19
"""Entries of a matrix that exceeds the cache of any core."""


def _times(matrix: NDArray[np.float64], x: Positions) -> Positions:
    """Multiply a dense matrix by x (k, 3).

    A large product is computed as (x' matrix')' with the same sums in half of the time: BLAS copies one of the two
    factors before the product, and this order avoids a copy of the whole matrix.
    """
    if matrix.size < _LARGE:
        return matrix @ x
    return np.ascontiguousarray((np.ascontiguousarray(x.T) @ matrix.T).T)


@dataclass(frozen=True)
class DenseLocalGlobal:
    """Local-global with NumPy matrices and a dense Cholesky factor.

    For small meshes, and for comparison with the paper line by line.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013)

    def prepare(self, system: System) -> PreparedLocalGlobal:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and if the matrices do not fit in memory.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        springs, n = only_springs(system, "dense"), system.vertices
        needs, room = 24.0 * n * (len(springs.edges) + n), memory.of_machine()  # three matrices of each shape
        if needs > room:
            raise Unsupported(
                f"dense: its matrices of {n:,} vertices and {len(springs.edges):,} springs take "
                f"{memory.in_words(needs)} of memory, where {memory.in_words(room)} may be taken; "
                "take sparse or numba, or a coarser mesh"
            )
        _, vertices, weight = system.penalty
        A = matrices.signed_incidence_matrix_dense(springs.edges, n)
        M = matrices.mass_matrix_dense(system.mass)
        C = matrices.selection_matrix_dense(vertices, n)
        Q = matrices.system_matrix_dense(A, springs.stiffness, system.factor * M, system.time_step, C, weight)
        matrices.require_determined(system, csr_array(Q))
        AtK = np.ascontiguousarray(A.T * springs.stiffness)
        r, rest_direction = springs.rest_length[:, None], springs.rest_direction

        def project(p: Positions, y: Positions, out: Positions) -> None:
            v = _times(A, p)
            length = np.sqrt(np.einsum("ij,ij->i", v, v))[:, None]
            d = r * np.where(length <= TINY, rest_direction, v / np.maximum(length, TINY))
            np.add(_times(AtK, d), y, out=out)

        free = system.free
        exact = system.pins.vertices[system.pins.exact]
        factor = DenseCholesky(Q[np.ix_(free, free)])
        return PreparedLocalGlobal(
            system,
            project,
            factor,
            csr_array(Q[np.ix_(free, exact)]),
            lambda e: matrices.energy_norm(Q, e),
            float(np.diag(Q)[system.unpinned].sum()),
            facts(int(np.count_nonzero(Q)), factor),
            "dense Cholesky",
        )


@dataclass(frozen=True)
class SparseLocalGlobal:
    """Local-global with SciPy sparse matrices and one sparse factorisation, for all projective energies."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013)

    def prepare(self, system: System) -> Prepared:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy is not projective.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        if without_contact(system) is not system:
            from solvers.contact.local_global import local_global  # for those who need it

            return local_global(self, system)
        if without_bounded(system) is not system:
            from solvers.contact.pairs_local_global import local_global

            return local_global(self, system)
        return prepared(system, projective(system, "sparse"), lambda Q: (SparseLU(Q), "SuperLU"))
