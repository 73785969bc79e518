"""Kernels of multigrid and conjugate gradients, for sparse rows and vectors of four numbers per vertex.

Each row is summed separately. Sums over all rows are taken in blocks of a fixed size, whose partial sums are added in
order, so that the result is bitwise independent of the number of threads. Vectors are (n, 4), three coordinates and a
zero, so that one load gives the operand of a matrix entry.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from solvers.compiling import kept
from solvers.vectors.rows import gather

BLOCK = 512
"""Rows that a thread processes at a time."""


@kept(parallel=True)
def multiply(pointers, columns, values, x, out):
    """Compute out = A x; A in compressed rows, x and out (n, 4)."""
    rows = len(out)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            s = gather(values, columns, pointers[i], pointers[i + 1], x)
            out[i, 0], out[i, 1], out[i, 2] = s[0], s[1], s[2]


@kept(parallel=True)
def add_product(pointers, columns, values, x, out):
    """Compute out += A x; A in compressed rows, x and out (n, 4)."""
    rows = len(out)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            s = gather(values, columns, pointers[i], pointers[i + 1], x)
            for c in range(3):
                out[i, c] += s[c]


@kept(parallel=True)
def residual(pointers, columns, values, b, x, out):
    """Compute out = b - A x; A in compressed rows, vectors (n, 4)."""
    rows = len(out)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            s = gather(values, columns, pointers[i], pointers[i + 1], x)
            for c in range(3):
                out[i, c] = b[i, c] - s[c]


@kept(parallel=True)
def smooth_first(inverse_diagonal, scale, b, step, x):
    """Compute step = x = scale D^-1 b, the first Chebyshev step from x = 0."""
    rows = len(x)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            for c in range(3):
                value = scale * inverse_diagonal[i] * b[i, c]
                step[i, c] = value
                x[i, c] = value


@kept(parallel=True)
def smooth(pointers, columns, values, inverse_diagonal, keep, scale, b, step, x, out):
    """Compute step = momentum step + scale D^-1 (b - A x) and out = x + step."""
    rows = len(out)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            s = gather(values, columns, pointers[i], pointers[i + 1], x)
            weight = scale * inverse_diagonal[i]
            for c in range(3):
                value = keep * step[i, c] + weight * (b[i, c] - s[c])
                step[i, c] = value
                out[i, c] = x[i, c] + value


@kept(parallel=True)
def multiply_and_dot(pointers, columns, values, p, out, parts):
    """Compute out = A p, and parts[:, :3] = p'out of each block of rows."""
    rows = len(out)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        t0, t1, t2 = 0.0, 0.0, 0.0
        for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            s = gather(values, columns, pointers[i], pointers[i + 1], p)
            out[i, 0], out[i, 1], out[i, 2] = s[0], s[1], s[2]
            t0 += s[0] * p[i, 0]
            t1 += s[1] * p[i, 1]
            t2 += s[2] * p[i, 2]
        parts[block, 0], parts[block, 1], parts[block, 2] = t0, t1, t2


@kept(parallel=True)
def advance(alpha, p, image, x, r, rounded, parts):
    """Update x += alpha p and r -= alpha image.

    Args:
        alpha: step sizes (3,).
        p, image: search direction and A p, (n, 4).
        x, r: iterate and residual, (n, 4), updated.
        rounded: r in float32, (n, 4), overwritten.
        parts: columns 0 to 2 get the largest |x| of each block.
    """
    rows = len(x)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        for c in range(3):
            parts[block, c] = 0.0
        for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            for c in range(3):
                x[i, c] += alpha[c] * p[i, c]
                r[i, c] -= alpha[c] * image[i, c]
                rounded[i, c] = r[i, c]
                parts[block, c] = max(parts[block, c], abs(x[i, c]))


@kept(parallel=True)
def compare(r, z, parts):
    """Write r'z of each block of rows, and its largest |z|, to parts[:, :6], by column."""
    rows = len(r)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        for c in range(3):
            dot, large = 0.0, 0.0
            for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
                dot += r[i, c] * z[i, c]
                large = max(large, abs(z[i, c]))
            parts[block, c], parts[block, 3 + c] = dot, large


@kept(parallel=True)
def turn(beta, z, p):
    """Compute p = z + beta p."""
    rows = len(p)
    for block in prange((rows + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(rows, (block + 1) * BLOCK)):
            for c in range(3):
                p[i, c] = z[i, c] + beta[c] * p[i, c]


@kept()
def aggregate(pointers, columns, values, strength, dominance):
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
    for i in range(n):  # a vertex with all its strong neighbours, where none of them is taken
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
    for i in range(n):  # what is left joins its strongest neighbour's,
        if free[i] and of[i] < 0:
            best = 0.0
            for e in range(pointers[i], pointers[i + 1]):
                j = columns[e]
                if j != i and first[j] >= 0 and abs(values[e]) > best and abs(values[e]) >= strength * largest[i]:
                    best, of[i] = abs(values[e]), first[j]
    for i in range(n):  # or gathers what is left around it
        if free[i] and of[i] < 0:
            of[i] = count
            for e in range(pointers[i], pointers[i + 1]):
                j = columns[e]
                if free[j] and of[j] < 0 and abs(values[e]) >= strength * largest[i]:
                    of[j] = count
            count += 1
    return of, count


@kept()
def filtered(pointers, columns, values, strength):
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


@kept()
def gauss_seidel(pointers, columns, values, x, sweeps):
    """Perform Gauss-Seidel sweeps for A x = 0 on x (n, q) in place.

    Args:
        pointers, columns, values: matrix in compressed rows.
        x: initial vectors (n, q), overwritten with the result.
        sweeps: number of sweeps.
    """
    n, count = x.shape
    for _ in range(sweeps):
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
