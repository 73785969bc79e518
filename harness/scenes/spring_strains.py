"""Strains of springs and of vertices.

The strain of a spring is length / rest length - 1. That of a vertex is the incident strain of largest magnitude, with
its sign.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import cached_njit
from springbench.solvers.model.step_problem import Positions

RealArray = NDArray[np.float64]


def compute_strains(
    p: Positions, springs: NDArray[np.int64], rest_lengths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the strains of springs and of vertices.

    Args:
        p: positions (n, 3) [m].
        springs: vertex pairs (m, 2).
        rest_lengths: rest lengths (m,) [m].

    Returns:
        Strains of the springs (m,), and for each vertex (n,) the one of largest magnitude among its springs.
    """
    of_spring, of_vertex = np.empty(len(rest_lengths)), np.zeros(len(p))
    _strains_kernel(p.copy(), springs, rest_lengths, of_spring, of_vertex)
    return of_spring, of_vertex


# Positions are passed as writable copies: a read-only array is another type to Numba and causes another compilation.
# The kernels release the interpreter lock, so that a concurrent solver need not wait.
@cached_njit(error_model="numpy", nogil=True)
def _strains_kernel(
    p: Positions,
    springs: NDArray[np.int64],
    rest_lengths: RealArray,
    of_spring: RealArray,
    of_vertex: RealArray,
) -> None:
    for e in range(len(springs)):
        i, j = springs[e, 0], springs[e, 1]
        x, y, z = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        r = rest_lengths[e]
        strain = math.sqrt(x * x + y * y + z * z) / r - 1 if r > 0 else 0.0
        of_spring[e] = strain
        for v in (i, j):
            if abs(strain) > abs(of_vertex[v]) or math.isnan(strain):
                of_vertex[v] = strain
