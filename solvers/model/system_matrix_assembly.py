"""The matrices of the local-global method, dense and sparse (Liu et al. 2013, section 4.1).

    A  signed incidence (m x n): +1 at i, -1 at j of spring (i, j)
    M  masses (n x n), diagonal            C  selection of the pinned vertices (q x n)
    Q = A'KA + M/dt^2 + C'WC               K, W: diagonal stiffnesses and pin weights

The sparse matrices are built from triplets once, store no explicit zeros and are never converted from dense ones.
A self-loop (i = j) has no extension, so its row of A is empty.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import reduce
from math import sqrt

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray
from springbench.solvers.model.step_problem import (
    Energy,
    NotPositiveDefinite,
    ProjectiveEnergy,
    StepStart,
    System,
    is_lagged,
)

FloatArray = NDArray[np.float64]


def signed_incidence_matrix_dense(springs: NDArray[np.int64], n: int) -> FloatArray:
    """Return the dense A of springs.

    Args:
        springs: vertex pairs (m, 2).
        n: number of vertices.

    Returns:
        A (m, n).

    Example:
        >>> import numpy as np
        >>> springbench.signed_incidence_matrix_dense(np.array([[0, 1]]), 2).tolist()
        [[1.0, -1.0]]
    """
    A = np.zeros((len(springs), n))
    rows, (i, j) = np.arange(len(springs)), springs.T
    A[rows, i] += 1.0
    A[rows, j] -= 1.0
    return A


def signed_incidence_matrix_sparse(springs: NDArray[np.int64], n: int) -> scipy.sparse.csr_array:
    """Return the sparse A of springs, with 2 entries per row.

    Args:
        springs: vertex pairs (m, 2).
        n: number of vertices.

    Returns:
        A (m, n), with an empty row for a self-loop.

    Example:
        >>> import numpy as np
        >>> springbench.signed_incidence_matrix_sparse(np.array([[0, 1]]), 2).toarray().tolist()
        [[1.0, -1.0]]
    """
    i, j = springs.T
    rows = np.flatnonzero(i != j)
    values = np.concatenate([np.ones(len(rows)), -np.ones(len(rows))])
    entries = np.concatenate([rows, rows]), np.concatenate([i[rows], j[rows]])
    return scipy.sparse.csr_array(scipy.sparse.coo_array((values, entries), shape=(len(springs), n)))


def mass_matrix_dense(mass: ArrayLike) -> FloatArray:
    """Return the dense M of masses (n,) [kg], shape (n, n).

    Example:
        >>> springbench.mass_matrix_dense([1.0, 2.0]).tolist()
        [[1.0, 0.0], [0.0, 2.0]]
    """
    return np.diag(np.asarray(mass, float))


def mass_matrix_sparse(mass: ArrayLike) -> scipy.sparse.csr_array:
    """Return the sparse M of masses (n,) [kg], shape (n, n).

    It has one entry for each vertex that has mass.

    Example:
        >>> springbench.mass_matrix_sparse([1.0, 2.0]).toarray().tolist()
        [[1.0, 0.0], [0.0, 2.0]]
    """
    return diagonal_matrix(np.asarray(mass, float))


def selection_matrix_dense(pinned: NDArray[np.int64], n: int) -> FloatArray:
    """Return the dense C of pinned vertices.

    Args:
        pinned: pinned vertices (q,), in the order of the rows.
        n: number of vertices.

    Returns:
        C (q, n).

    Example:
        >>> import numpy as np
        >>> springbench.selection_matrix_dense(np.array([1]), 2).tolist()
        [[0.0, 1.0]]
    """
    C = np.zeros((len(pinned), n))
    C[np.arange(len(pinned)), pinned] = 1.0
    return C


def selection_matrix_sparse(pinned: NDArray[np.int64], n: int) -> scipy.sparse.csr_array:
    """Return the sparse C of pinned vertices, with one entry per row.

    Args:
        pinned: pinned vertices (q,), in the order of the rows.
        n: number of vertices.

    Returns:
        C (q, n).

    Example:
        >>> import numpy as np
        >>> springbench.selection_matrix_sparse(np.array([1]), 2).toarray().tolist()
        [[0.0, 1.0]]
    """
    q = len(pinned)
    return scipy.sparse.csr_array(scipy.sparse.coo_array((np.ones(q), (np.arange(q), pinned)), shape=(q, n)))


def rest_lengths(rest: FloatArray, springs: NDArray[np.int64]) -> FloatArray:
    """Return the length r of each spring at the rest positions.

    Args:
        rest: rest positions (n, 3) [m].
        springs: vertex pairs (m, 2).

    Returns:
        Lengths (m,) [m].

    Example:
        >>> import numpy as np
        >>> springbench.rest_lengths(np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]), np.array([[0, 1]])).tolist()
        [5.0]
    """
    i, j = springs.T
    return np.linalg.norm(rest[i] - rest[j], axis=1)


def system_matrix_dense(
    A: FloatArray, stiffness: ArrayLike, M: FloatArray, time_step: float, C: FloatArray, weight: ArrayLike
) -> FloatArray:
    """Return the dense Q [N/m], shape (n, n).

    Args:
        A: signed incidence matrix (m, n).
        stiffness: (m,) [N/m], or one number.
        M: mass matrix (n, n) [kg].
        time_step: dt [s].
        C: selection matrix of the pins (q, n).
        weight: pin weights (q,) [N/m], or one number.

    Example:
        >>> import numpy as np
        >>> A = springbench.signed_incidence_matrix_dense(np.array([[0, 1]]), 2)
        >>> M, C = springbench.mass_matrix_dense([1.0, 1.0]), springbench.selection_matrix_dense(np.array([0]), 2)
        >>> springbench.system_matrix_dense(A, 3.0, M, 0.5, C, 10.0).tolist()
        [[17.0, -3.0], [-3.0, 7.0]]
    """
    k, w = (np.reshape(np.asarray(x, float), (-1, 1)) for x in (stiffness, weight))
    return A.T @ (k * A) + M / time_step**2 + C.T @ (w * C)


def system_matrix_sparse(
    A: scipy.sparse.csr_array,
    stiffness: ArrayLike,
    M: scipy.sparse.csr_array,
    time_step: float,
    C: scipy.sparse.csr_array,
    weight: ArrayLike,
) -> scipy.sparse.csr_array:
    """Return the sparse Q [N/m], shape (n, n), without explicit zeros.

    It has one entry per vertex and two per spring.

    Args:
        A: signed incidence matrix (m, n).
        stiffness: (m,) [N/m], or one number.
        M: mass matrix (n, n) [kg].
        time_step: dt [s].
        C: selection matrix of the pins (q, n).
        weight: pin weights (q,) [N/m], or one number.

    Example:
        >>> import numpy as np
        >>> A = springbench.signed_incidence_matrix_sparse(np.array([[0, 1]]), 2)
        >>> M, C = springbench.mass_matrix_sparse([1.0, 1.0]), springbench.selection_matrix_sparse(np.array([0]), 2)
        >>> springbench.system_matrix_sparse(A, 3.0, M, 0.5, C, 10.0).toarray().tolist()
        [[17.0, -3.0], [-3.0, 7.0]]
    """
    K = diagonal_matrix(np.broadcast_to(np.asarray(stiffness, float), len(A.indptr) - 1))
    W = diagonal_matrix(np.broadcast_to(np.asarray(weight, float), len(C.indptr) - 1))
    return drop_zeros(A.T @ K @ A + M / time_step**2 + C.T @ W @ C)


def assemble_system_matrix(system: System, energies: Iterable[ProjectiveEnergy]) -> scipy.sparse.csr_array:
    """Return Q of a system, shape (n, n): stiffness of the energies, inertia and penalty pins.

    Exact pins do not contribute to Q; the caller selects the rows of `system.free_vertices`.

    Args:
        system: the system.
        energies: its projective energies.

    Raises:
        NotPositiveDefinite: the positions of some vertices are not determined.

    Example:
        >>> import numpy as np
        >>> system = springbench.System(mass=np.array([1.0, 2.0]), time_step=0.5)
        >>> springbench.assemble_system_matrix(system, energies=[]).toarray().tolist()
        [[4.0, 0.0], [0.0, 8.0]]
    """
    Q = add_stiffness_shares(system, energies)
    require_determined_positions(system, Q)
    return Q


def add_stiffness_shares(system: System, energies: Iterable[ProjectiveEnergy]) -> scipy.sparse.csr_array:
    """Return Q as `assemble_system_matrix` does, also where it does not determine all positions.

    Args:
        system: the system.
        energies: its projective energies.
    """
    diagonal = compute_anchor_diagonal(system)
    return drop_zeros(
        reduce(lambda total, share: total + share, stiffness_shares(system, energies), diagonal_matrix(diagonal))
    )


def compute_anchor_diagonal(system: System) -> FloatArray:
    """Return the diagonal of inertia and penalty pins (n,) [N/m], which no displacement of all vertices avoids."""
    _, vertices, weight = system.penalty_pins
    return system.inertia_diagonal + np.bincount(vertices, weight, minlength=system.num_vertices)


def stiffness_shares(system: System, energies: Iterable[ProjectiveEnergy]) -> Iterator[scipy.sparse.csr_array]:
    """Yield each energy's contribution A'KA [N/m] to Q, (n, n).

    That of a lagged energy depends on the velocity_rate of the steps only.

    Args:
        system: provides the number of vertices and the velocity_rate.
        energies: its projective energies, in the order of the contributions.
    """
    nowhere = np.zeros((system.num_vertices, 3))
    start = StepStart(nowhere, nowhere, 0.0, nowhere, system.velocity_rate, 0.0)
    for energy in energies:
        begun: Energy = energy.begin_step(start) if is_lagged(energy) else energy
        if isinstance(begun, ProjectiveEnergy):
            yield begun.stiffness_matrix(system.num_vertices)


def require_determined_positions(system: System, Q: scipy.sparse.csr_array) -> None:
    """Check that a mass or a pin determines the position of every vertex.

    Every connected component of the graph of Q needs one.

    Args:
        system: its masses and pins.
        Q: matrix (n, n), of which only the pattern is used.

    Raises:
        NotPositiveDefinite: some positions are not determined; the error names the first vertices concerned.
    """
    from scipy.sparse.csgraph import connected_components  # also imports scipy.linalg, so only where needed

    _, component = connected_components(Q, directed=False)
    anchor = system.mass.copy()
    anchor[system.pins.vertices] = 1.0
    loose = np.flatnonzero(np.bincount(component, anchor)[component] <= 0.0)
    if len(loose):
        first = loose[:5].tolist()
        named = ", ".join(map(str, first)) + (", ..." if len(loose) > 5 else "")
        raise NotPositiveDefinite(
            f"nothing determines the positions of some vertices, {len(loose)} in all ({named}): they have no mass, and "
            "no spring leads from them to a mass or a pin; give them mass, pin them, or take them out of the mesh",
            first,
        )


def energy_norm(Q: FloatArray | scipy.sparse.csr_array, e: FloatArray) -> float:
    """Return the energy norm |e|_Q = sqrt(tr(e'Qe)) [J^(1/2)] of a displacement.

    Args:
        Q: positive semidefinite matrix (n, n) [N/m].
        e: displacement (n, 3) [m].
    """
    # If stiffness exceeds inertia by all digits of float64, round-off can make a sum of zero negative.
    # max(NaN, 0.0) is NaN, while max(0.0, NaN) would be 0.
    return sqrt(max(float(np.einsum("ij,ij->", e, Q @ e)), 0.0))


def diagonal_matrix(values: FloatArray) -> scipy.sparse.csr_array:
    """Return a diagonal matrix [any unit], shape (n, n), without entries for zeros."""
    n = len(values)
    return drop_zeros(scipy.sparse.csr_array(scipy.sparse.dia_array((values[None, :], np.array([0])), shape=(n, n))))


def compute_row_starts(rows: NDArray[np.int64], num_rows: int) -> NDArray[np.int64]:
    """Return the start of each row among entries sorted by row, as in CSR form.

    Args:
        rows: row of each entry (k,), in any order.
        num_rows: number of rows, n; at least the largest row + 1.

    Returns:
        Starts (n + 1,); the last one is k.
    """
    return np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=num_rows))])


def drop_zeros(matrix: scipy.sparse.csr_array | scipy.sparse.csc_array) -> scipy.sparse.csr_array:
    """Return the matrix with duplicates summed, columns sorted and explicit zeros dropped."""
    matrix = scipy.sparse.csr_array(matrix)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return matrix
