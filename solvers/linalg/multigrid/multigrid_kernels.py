"""Kernels of multigrid and conjugate gradients, for vectors of four numbers per vertex.

Each row is summed separately. Sums over all rows are taken in blocks of a fixed size, whose partial sums are added in
order, so that the result is bitwise independent of the number of threads. Vectors are (n, 4), three coordinates and a
zero, so that one load gives the operand of a matrix entry.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from springbench.solvers.jit.kernel_compilation import cached_njit
from springbench.solvers.simd.sparse_rows import sparse_row_product

ROWS_PER_BLOCK = 512
"""Rows that a thread processes at a time."""


@cached_njit(parallel=True)
def multiply_sparse(pointers, columns, values, x, out):
    """Compute out = A x.

    Args:
        pointers, columns, values: A in compressed rows.
        x: factor, four numbers per column of A.
        out: product, four numbers per row of A; column 3 is not written.
    """
    rows = len(out)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
            s = sparse_row_product(values, columns, pointers[i], pointers[i + 1], x)
            out[i, 0], out[i, 1], out[i, 2] = s[0], s[1], s[2]


@cached_njit(parallel=True)
def add_sparse_product(pointers, columns, values, x, out):
    """Compute out += A x.

    Args:
        pointers, columns, values: A in compressed rows.
        x: factor, four numbers per column of A.
        out: sum, four numbers per row of A; column 3 is not written.
    """
    rows = len(out)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
            s = sparse_row_product(values, columns, pointers[i], pointers[i + 1], x)
            for c in range(3):
                out[i, c] += s[c]


@cached_njit(parallel=True)
def compute_linear_residual(pointers, columns, values, b, x, out):
    """Compute out = b - A x.

    Args:
        pointers, columns, values: A in compressed rows.
        b: right-hand sides (n, 4).
        x: approximate solution (n, 4).
        out: residual (n, 4); column 3 is not written.
    """
    rows = len(out)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
            s = sparse_row_product(values, columns, pointers[i], pointers[i + 1], x)
            for c in range(3):
                out[i, c] = b[i, c] - s[c]


@cached_njit(parallel=True)
def chebyshev_first_step(inverse_diagonal, scale, b, step, x):
    """Do the first Chebyshev step from x = 0.

        step = x = scale D^-1 b

    Args:
        inverse_diagonal: D^-1, inverse of the diagonal of A (n,).
        scale: weight of the preconditioned residual.
        b: right-hand sides (n, 4).
        step: change of x (n, 4), overwritten.
        x: iterate (n, 4), overwritten.
    """
    rows = len(x)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
            for c in range(3):
                value = scale * inverse_diagonal[i] * b[i, c]
                step[i, c] = value
                x[i, c] = value


@cached_njit(parallel=True)
def chebyshev_step(pointers, columns, values, inverse_diagonal, momentum, scale, b, step, x, out):
    """Do a Chebyshev step.

        step <- momentum step + scale D^-1 (b - A x),   out = x + step

    Args:
        pointers, columns, values: A in compressed rows.
        inverse_diagonal: D^-1, inverse of the diagonal of A (n,).
        momentum: weight of the previous step.
        scale: weight of the preconditioned residual.
        b: right-hand sides (n, 4).
        step: previous change of x (n, 4), overwritten with the new one.
        x: iterate (n, 4).
        out: next iterate (n, 4), not `x` itself.
    """
    rows = len(out)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
            s = sparse_row_product(values, columns, pointers[i], pointers[i + 1], x)
            weight = scale * inverse_diagonal[i]
            for c in range(3):
                value = momentum * step[i, c] + weight * (b[i, c] - s[c])
                step[i, c] = value
                out[i, c] = x[i, c] + value


@cached_njit(parallel=True)
def multiply_sparse_and_dot(pointers, columns, values, p, out, partial_sums):
    """Compute out = A p, and p'out of each block of rows.

    Args:
        pointers, columns, values: A in compressed rows.
        p: search directions (n, 4).
        out: product (n, 4); column 3 is not written.
        partial_sums: a row per block of ROWS_PER_BLOCK rows; columns 0 to 2 get p'out of each column of p.
    """
    rows = len(out)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        t0, t1, t2 = 0.0, 0.0, 0.0
        for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
            s = sparse_row_product(values, columns, pointers[i], pointers[i + 1], p)
            out[i, 0], out[i, 1], out[i, 2] = s[0], s[1], s[2]
            t0 += s[0] * p[i, 0]
            t1 += s[1] * p[i, 1]
            t2 += s[2] * p[i, 2]
        partial_sums[block, 0], partial_sums[block, 1], partial_sums[block, 2] = t0, t1, t2


@cached_njit(parallel=True)
def update_iterate_and_residual(alpha, p, image, x, r, rounded, partial_sums):
    """Update x += alpha p and r -= alpha image.

    Args:
        alpha: step sizes (3,).
        p, image: search direction and A p, (n, 4).
        x, r: iterate and residual, (n, 4), updated.
        rounded: r in float32, (n, 4), overwritten.
        partial_sums: columns 0 to 2 get the largest |x| of each block.
    """
    rows = len(x)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        for c in range(3):
            partial_sums[block, c] = 0.0
        for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
            for c in range(3):
                x[i, c] += alpha[c] * p[i, c]
                r[i, c] -= alpha[c] * image[i, c]
                rounded[i, c] = r[i, c]
                partial_sums[block, c] = max(partial_sums[block, c], abs(x[i, c]))


@cached_njit(parallel=True)
def dot_and_max(r, z, partial_sums):
    """Compute r'z and the largest |z| of each block of rows, for each column.

    Args:
        r: residuals (n, 4).
        z: preconditioned residuals (n, 4).
        partial_sums: a row per block of ROWS_PER_BLOCK rows; columns 0 to 2 get r'z, columns 3 to 5 the largest |z|.
    """
    rows = len(r)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        for c in range(3):
            dot, large = 0.0, 0.0
            for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
                dot += r[i, c] * z[i, c]
                large = max(large, abs(z[i, c]))
            partial_sums[block, c], partial_sums[block, 3 + c] = dot, large


@cached_njit(parallel=True)
def update_direction(beta, z, p):
    """Compute p = z + beta p.

    Args:
        beta: weight of the previous direction in each column (3,).
        z: preconditioned residuals (n, 4).
        p: search directions (n, 4), updated.
    """
    rows = len(p)
    for block in prange((rows + ROWS_PER_BLOCK - 1) // ROWS_PER_BLOCK):
        for i in range(block * ROWS_PER_BLOCK, min(rows, (block + 1) * ROWS_PER_BLOCK)):
            for c in range(3):
                p[i, c] = z[i, c] + beta[c] * p[i, c]


@cached_njit()
def build_aggregates(pointers, columns, values, strength, dominance):
    """Build the aggregates of a graph (Vanek, Mandel and Brezina 1996).

    Args:
        pointers, columns, values: matrix in compressed rows.
        strength: an entry is a strong connection from this fraction of the largest one in its row.
        dominance: a vertex whose diagonal exceeds this times the sum of its other entries is in no aggregate, since
            smoothing alone determines it.

    Returns:
        The aggregate of each vertex, -1 for none, and their number.
    """
    n = len(pointers) - 1
    largest = np.zeros(n)
    of = np.full(n, -1, np.int32)
    free = np.ones(n, np.bool_)
    for i in range(n):
        total, own = 0.0, 0.0
        for e in range(pointers[i], pointers[i + 1]):
            size = abs(values[e])
            if columns[e] == i:
                own = size
            else:
                total += size
                largest[i] = max(largest[i], size)
        free[i] = own <= dominance * total
    count = 0
    for i in range(n):  # first pass: a vertex and its strong neighbours, if none of them is aggregated
        if not free[i]:
            continue
        alone = of[i] < 0
        for e in range(pointers[i], pointers[i + 1]):
            j = columns[e]
            strong = abs(values[e]) >= strength * max(largest[i], largest[j])
            if not alone:
                break
            if j != i and strong and of[j] >= 0:
                alone = False
        if not alone:
            continue
        of[i] = count
        for e in range(pointers[i], pointers[i + 1]):
            j = columns[e]
            if free[j] and abs(values[e]) >= strength * max(largest[i], largest[j]):
                of[j] = count
        count += 1
    first = of.copy()
    for i in range(n):  # second pass: a remaining vertex joins the aggregate of its strongest neighbour
        if free[i] and of[i] < 0:
            best = 0.0
            for e in range(pointers[i], pointers[i + 1]):
                j = columns[e]
                if j != i and first[j] >= 0 and abs(values[e]) > best and abs(values[e]) >= strength * largest[i]:
                    best, of[i] = abs(values[e]), first[j]
    for i in range(n):  # third pass: the others form aggregates with their remaining strong neighbours
        if free[i] and of[i] < 0:
            of[i] = count
            for e in range(pointers[i], pointers[i + 1]):
                j = columns[e]
                if free[j] and of[j] < 0 and abs(values[e]) >= strength * largest[i]:
                    of[j] = count
            count += 1
    return of, count


@cached_njit()
def filter_weak_entries(pointers, columns, values, strength):
    """Return the entries of A (nnz,), with weak off-diagonal ones lumped into the diagonal.

    Args:
        pointers, columns, values: matrix in compressed rows.
        strength: entries below this fraction of the largest one in their row are weak.
    """
    out = values.copy()
    for i in range(len(pointers) - 1):
        largest, lumped, own = 0.0, 0.0, -1
        for e in range(pointers[i], pointers[i + 1]):
            if columns[e] == i:
                own = e
            else:
                largest = max(largest, abs(values[e]))
        for e in range(pointers[i], pointers[i + 1]):
            if e != own and abs(values[e]) < strength * largest:
                lumped += values[e]
                out[e] = 0.0
        out[own] += lumped
    return out


@cached_njit()
def sweep_gauss_seidel(pointers, columns, values, x, num_sweeps):
    """Perform Gauss-Seidel sweeps for A x = 0 on x (n, q) in place.

    Args:
        pointers, columns, values: matrix in compressed rows.
        x: initial vectors (n, q), overwritten with the result.
        num_sweeps: number of sweeps.
    """
    n, count = x.shape
    for _ in range(num_sweeps):
        for i in range(n):
            own, x[i] = 1.0, 0.0
            for e in range(pointers[i], pointers[i + 1]):
                j = columns[e]
                if j == i:
                    own = values[e]
                    continue
                for c in range(count):
                    x[i, c] -= values[e] * x[j, c]
            for c in range(count):
                x[i, c] /= own
