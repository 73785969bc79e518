"""Matrices of spring networks for the tests of linear solvers: Q = A'KA + diag(anchors) [N/m]."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from springbench.solvers.model.system_matrix_assembly import diagonal_matrix, drop_zeros, signed_incidence_matrix_sparse

SPRING_STIFFNESS, TIME_STEP = 1e5, 1 / 30


def network_matrix(springs, stiffness, vertex_stiffness) -> csr_array:
    """A'KA + diag(anchors) of springs (m, 2), their stiffness (m,) or one for all, and anchors (n,)."""
    ends = np.asarray(springs, np.int64).reshape(-1, 2)
    A = signed_incidence_matrix_sparse(ends, len(vertex_stiffness))
    k = np.broadcast_to(np.asarray(stiffness, float), len(ends))
    return drop_zeros(A.T @ diagonal_matrix(k) @ A + diagonal_matrix(np.asarray(vertex_stiffness, float)))


def grid_springs(*shape: int) -> np.ndarray:
    """The springs (m, 2) of a grid: from each vertex to all that differ by at most one in each index."""
    index = np.arange(np.prod(shape)).reshape(shape)
    ends = []
    for step in np.ndindex(*(3,) * len(shape)):
        offset = tuple(k - 1 for k in step)
        if offset > (0,) * len(shape):
            a, b = (index[tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(w, shape, strict=True))]
                    for w in (offset, tuple(-s for s in offset)))  # fmt: skip
            ends.append(np.stack([a.ravel(), b.ravel()], axis=1))
    return np.concatenate(ends)


def grid_matrix(*shape: int, stiffness=SPRING_STIFFNESS) -> csr_array:
    """A grid of mass 1 in all at dt = 1/30, two corners pinned by 1e10: a sheet of two numbers, a solid of three."""
    n = int(np.prod(shape))
    diagonal = np.full(n, 1.0 / n / TIME_STEP**2)
    diagonal[[0, shape[-1] - 1]] += 1e10
    return network_matrix(grid_springs(*shape), stiffness, diagonal)


def random_right_hand_sides(n: int, seed: int = 0) -> np.ndarray:
    """Three random ones, (n, 3)."""
    return np.random.default_rng(seed).normal(size=(n, 3))


def backward_error(Q, x, b) -> float:
    """The least relative change of each entry of Q and b that x solves exactly (Oettli and Prager 1964).

    Between stiffnesses that lie decades apart a norm would see the stiff vertices alone; this sees each by itself.
    """
    return float(np.max(np.abs(b - Q @ x) / (abs(Q) @ np.abs(x) + np.abs(b))))
