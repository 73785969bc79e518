"""The norm of residuals |Q^-1 g|_Q [J^(1/2)] over the unpinned vertices, of a gradient g [N]."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.objective_kernels import compute_inner_product
from springbench.solvers.kernels.quadratic_form_kernels import multiply_matrix
from springbench.solvers.linalg.cholesky.triangular_solve import SupernodalFactor, solve_supernodal


class NormMatrix(NamedTuple):
    """The matrix Q of the norm, and the pins that it leaves out.

    Attributes:
        pinned_vertices: vertices of all pins (q,), if any is a penalty pin; else empty, as Q^-1 g vanishes at exact
            pins.
        pointers, columns, values: Q [N/m] in compressed rows.
        product: scratch (n, 3), empty if there are no pinned vertices.
    """

    pinned_vertices: NDArray[np.int64]
    pointers: NDArray[Any]
    columns: NDArray[Any]
    values: NDArray[np.float64]
    product: NDArray[np.float64]


@jit_kernel
def compute_correction_norm(matrix, correction, gradient):
    """Return |e|_Q over the unpinned vertices, of e = Q^-1 g.

    Args:
        matrix: Q and the pins.
        correction: e (n, 3) [m]; set to zero at the pins.
        gradient: g (n, 3) [N].
    """
    if len(matrix.pinned_vertices) == 0:  # |e|_Q^2 = e'g
        square = compute_inner_product(correction, gradient)
    else:
        for v in matrix.pinned_vertices:
            for c in range(3):
                correction[v, c] = 0.0
        multiply_matrix(matrix.pointers, matrix.columns, matrix.values, correction, matrix.product)
        square = compute_inner_product(correction, matrix.product)
    return 0.0 if square < 0.0 else np.sqrt(square)  # NaN for NaN


class ResidualNorm(NamedTuple):
    """The norm with a factor of Q.

    Attributes:
        matrix: Q and the pins.
        factor: factor of Q, embedded into vectors of all vertices.
        correction: scratch (n, 3), zero at exactly pinned vertices.
    """

    matrix: NormMatrix
    factor: SupernodalFactor
    correction: NDArray[np.float64]


@jit_inner
def compute_residual_norm(norm, gradient):
    """Return the norm of a residual.

    Args:
        norm: the norm.
        gradient: gradient (n, 3) [N].
    """
    solve_supernodal(norm.factor, gradient, norm.correction, None)
    return compute_correction_norm(norm.matrix, norm.correction, gradient)


@jit_inner
def compute_norm_of_correction(norm, correction, gradient):
    """Return the norm of a residual, of a known correction Q^-1 g.

    Args:
        norm: the norm.
        correction: correction (n, 3) [m], not modified.
        gradient: gradient g (n, 3) [N].
    """
    for v in range(len(correction)):
        for c in range(3):
            norm.correction[v, c] = correction[v, c]
    return compute_correction_norm(norm.matrix, norm.correction, gradient)
