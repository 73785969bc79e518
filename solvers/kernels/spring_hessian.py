"""The Hessian of springs, assembled into 3 x 3 blocks, and its products with vectors.

    H_e = k nn' + t/l (I - nn'),   t = k (l - r),   n the direction of a spring, l its length, t its tension

A compressed spring (t < 0) has a negative transverse part. It is scaled by `negative_fraction`: 1 gives the exact
Hessian, 0 makes it positive semidefinite spring by spring (Teran et al. 2005). The tensions are a separate argument,
for methods that predict them (`springbench.solvers.methods.newton.hybrid_newton`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.kernel_compilation import ZERO, jit_inner, jit_inner_parallel, jit_kernel
from springbench.solvers.kernels.objective_kernels import spring_direction
from springbench.solvers.kernels.quadratic_form_kernels import add_product, add_to_diagonal
from springbench.solvers.kernels.spring_law import transverse_stiffness
from springbench.solvers.model.energies.element_energies import add_products, add_symmetric_block, axial_hessian
from springbench.solvers.model.step_problem import System


class BlockIndices(NamedTuple):
    """Block indices of vertices and springs in a matrix over the free vertices.

    Attributes:
        free_vertices: free vertices (f,).
        diagonal_block: diagonal block of each vertex (n,), -1 for a vertex that is not free.
        off_diagonal: blocks of each spring from its first end to its second and back (m, 2), -1 if an end is not free.
    """

    free_vertices: NDArray[np.int64]
    diagonal_block: NDArray[np.int64]
    off_diagonal: NDArray[np.int64]

    @classmethod
    def from_graph(cls, system: System, edges: NDArray[np.int64], graph: csr_array) -> BlockIndices:
        """Return the indices for a matrix over the free vertices.

        Args:
            system: the system, for its free vertices.
            edges: ends of each spring (m, 2).
            graph: block pattern of the matrix (f, f), with sorted columns and a full diagonal.
        """
        n, f = system.num_vertices, len(system.free_vertices)
        key = np.repeat(np.arange(f), np.diff(graph.indptr)) * f + graph.indices
        number = np.full(n, -1)
        number[system.free_vertices] = np.arange(f)
        diagonal = np.full(n, -1)
        diagonal[system.free_vertices] = np.searchsorted(key, np.arange(f) * (f + 1))
        i, j = number[edges].T
        inside = (i >= 0) & (j >= 0) & (i != j)
        across = np.full((len(edges), 2), -1)
        for side, (a, b) in enumerate([(i, j), (j, i)]):
            across[inside, side] = np.searchsorted(key, a[inside] * f + b[inside])
        return cls(system.free_vertices, diagonal, across)


@jit_kernel
def locate_blocks(number, starts, columns, transposed, vertices, out):
    """Write the block of each vertex pair within rows of vertices.

    Args:
        number: index of each vertex among the free ones, -1 for none, (n + 1,); the last entry is that of vertex -1.
        starts, columns: row pointers (f + 1,) and sorted columns of the matrix, whose pattern is symmetric.
        transposed: index of the block (j, i) of each block (i, j).
        vertices: rows of vertices (m, k), -1 for none.
        out: output (m, k^2), -1 if one vertex of the pair is not free.

    Returns:
        Whether the matrix has all the blocks; if not, the output is incomplete.
    """
    many = vertices.shape[1]
    for e in range(len(vertices)):
        for a in range(many):
            i = number[vertices[e, a]]
            for b in range(a + 1):
                j = number[vertices[e, b]]
                if i < 0 or j < 0:
                    out[e, many * a + b] = out[e, many * b + a] = -1
                    continue
                low, high = starts[i], starts[i + 1] - 1
                while low < high:
                    middle = (low + high) // 2
                    if columns[middle] < j:
                        low = middle + 1
                    else:
                        high = middle
                if columns[low] != j:
                    return False
                out[e, many * a + b], out[e, many * b + a] = low, transposed[low]
    return True


@jit_kernel
def list_vertex_pairs(number, vertices, starts, higher, last_lower, pairs):
    """Write the distinct pairs of free vertices within rows of vertices, in ascending order.

    Pairs are grouped by their lower index, so that only the few different ones of a group are sorted.

    Args:
        number: that of `locate_blocks`.
        vertices: vertices (m, k), -1 for none.
        starts: scratch (f + 1,) for f free vertices.
        higher: scratch of m k (k - 1)/2 indices.
        last_lower: scratch (f,).
        pairs: output, lower and higher free index of each pair, (m k (k - 1)/2, 2).

    Returns:
        Number of pairs.
    """
    starts[:], last_lower[:] = 0, -1
    for is_counting in (True, False):
        for e in range(len(vertices)):
            for a in range(vertices.shape[1]):
                i = number[vertices[e, a]]
                for b in range(a):
                    j = number[vertices[e, b]]
                    if i >= 0 and j >= 0 and i != j:
                        lower = min(i, j)
                        if is_counting:
                            starts[lower + 1] += 1
                        else:
                            higher[starts[lower]] = max(i, j)
                            starts[lower] += 1
        if is_counting:
            for i in range(len(last_lower)):
                starts[i + 1] += starts[i]
    count, begin = 0, 0
    for lower in range(len(last_lower)):  # each start is now the end of its group
        first = count
        for k in range(begin, starts[lower]):
            j = higher[k]
            if last_lower[j] == lower:
                continue
            last_lower[j], at = lower, count
            while at > first and pairs[at - 1, 1] > j:
                pairs[at, 0], pairs[at, 1] = lower, pairs[at - 1, 1]
                at -= 1
            pairs[at, 0], pairs[at, 1] = lower, j
            count += 1
        begin = starts[lower]
    return count


@jit_kernel
def linearise_tensions(terms, p, d, out):
    """Write the tensions of the springs, linearised for a displacement.

    Args:
        terms: objective terms.
        p: positions (n, 3) [m].
        d: displacement (n, 3) [m].
        out: output (m,) [N].
    """
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        n0, n1, n2, length = spring_direction(terms, e, p)
        stretch = n0 * (d[i, 0] - d[j, 0]) + n1 * (d[i, 1] - d[j, 1]) + n2 * (d[i, 2] - d[j, 2])
        out[e] = terms.stiffness[e] * (length - terms.rest_length[e] + stretch)


@jit_kernel
def write_constant_blocks(terms, places, values):
    """Write the stiffness of inertia and penalty pins to the blocks of a matrix.

    Args:
        terms: objective terms.
        places: block indices.
        values: output (b, 3, 3) [N/m], overwritten.
    """
    _write_constant_blocks(terms, places, values, (ZERO, len(places.diagonal_block), ZERO, len(values)))


@jit_inner
def _write_constant_blocks(terms, places, values, rows):
    first_vertex, end_vertex, first_block, end_block = rows
    values[first_block:end_block] = 0.0
    for v in places.free_vertices:
        if first_vertex <= v < end_vertex:
            add_to_diagonal(values, places.diagonal_block[v], terms.inertia_diagonal[v])
    for q in range(len(terms.pinned_vertices)):
        v = terms.pinned_vertices[q]
        if first_vertex <= v < end_vertex:
            add_to_diagonal(values, places.diagonal_block[v], terms.pin_weight[q])


@jit_kernel
def assemble_hessian(terms, places, constant, p, tension, negative_fraction, values):
    """Write the Hessian [N/m] of springs, inertia and penalty pins to matrix blocks.

    Args:
        terms: objective terms.
        places: block indices.
        constant: blocks of inertia, pins and other terms independent of p; None if there are no other terms.
        p: positions (n, 3) [m].
        tension: tension of each spring (m,) [N]; empty for the tensions at p.
        negative_fraction: factor of the springs' negative transverse parts.
        values: output (b, 3, 3) [N/m].
    """
    rows = ZERO, len(p), ZERO, len(values)
    _assemble_rows(terms, places, constant, p, tension, negative_fraction, values, rows)


@jit_kernel
def assemble_hessian_in_threads(terms, places, constant, p, tension, negative_fraction, values, bounds):
    """Write what `assemble_hessian` does, in several threads.

    Args:
        terms, places, constant, p, tension, negative_fraction, values: those of `assemble_hessian`.
        bounds: first vertex and first block of the rows of each thread, and the ends of the last one (t + 1, 2).
    """
    _assemble_in_threads(terms, places, constant, p, tension, negative_fraction, values, bounds)


@jit_inner_parallel
def _assemble_in_threads(terms, places, constant, p, tension, negative_fraction, values, bounds):
    for part in prange(len(bounds) - 1):
        rows = bounds[part, 0], bounds[part + 1, 0], bounds[part, 1], bounds[part + 1, 1]
        _assemble_rows(terms, places, constant, p, tension, negative_fraction, values, rows)


@jit_inner
def _assemble_rows(terms, places, constant, p, tension, negative_fraction, values, rows):
    """Write a range of rows, given by its vertices and blocks, first and end."""
    first_vertex, end_vertex, first_block, end_block = rows
    if constant is None:
        _write_constant_blocks(terms, places, values, rows)
    else:
        for block in range(first_block, end_block):
            for row in range(3):
                for column in range(3):
                    values[block, row, column] = constant[block, row, column]
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        has_first, has_second = first_vertex <= i < end_vertex, first_vertex <= j < end_vertex
        if i == j or not (has_first or has_second):
            continue
        n0, n1, n2, length = spring_direction(terms, e, p)
        force = tension[e] if len(tension) else terms.stiffness[e] * (length - terms.rest_length[e])
        lateral = transverse_stiffness(terms.stiffness[e], terms.rest_length[e], force, length)
        lateral = lateral * negative_fraction if lateral < 0.0 < terms.rest_length[e] else lateral
        xx, xy, xz, yy, yz, zz = axial_hessian(terms.stiffness[e], lateral, n0, n1, n2)
        if has_first:
            if places.diagonal_block[i] >= 0:
                add_symmetric_block(values, places.diagonal_block[i], 1.0, xx, xy, xz, yy, yz, zz)
            if places.off_diagonal[e, 0] >= 0:
                add_symmetric_block(values, places.off_diagonal[e, 0], -1.0, xx, xy, xz, yy, yz, zz)
        if has_second:
            if places.diagonal_block[j] >= 0:
                add_symmetric_block(values, places.diagonal_block[j], 1.0, xx, xy, xz, yy, yz, zz)
            if places.off_diagonal[e, 1] >= 0:
                add_symmetric_block(values, places.off_diagonal[e, 1], -1.0, xx, xy, xz, yy, yz, zz)


@jit_kernel
def linearise_springs(terms, p, out):
    """Write the linearised springs.

    Args:
        terms: objective terms.
        p: positions (n, 3) [m].
        out: output (m, 4), sqrt(k - lateral) n [(N/m)^(1/2)] and the transverse stiffness `lateral` [N/m].
    """
    for e in range(len(terms.stiffness)):
        n0, n1, n2, length = spring_direction(terms, e, p)
        k = terms.stiffness[e]
        lateral = transverse_stiffness(k, terms.rest_length[e], k * (length - terms.rest_length[e]), length)
        root = np.sqrt(k - lateral)
        out[e, 0], out[e, 1], out[e, 2], out[e, 3] = root * n0, root * n1, root * n2, lateral


@jit_kernel
def multiply_hessian(terms, linear, form, joined, curvature, x, out):
    """Write the product [N] of the exact Hessian with x [m], (n, 3), to `out`.

    Args:
        terms: objective terms.
        linear: output of `linearise_springs`.
        form, joined, curvature: quadratic form, elements and their Hessians, or None.
        x: (n, 3) [m].
        out: output (n, 3) [N].
    """
    _multiply_springs(terms, linear, x, out)
    add_product(form, x, out)
    add_products(joined, curvature, x, out)


@jit_inner
def _multiply_springs(terms, linear, x, out):
    for v in range(len(x)):
        for c in range(3):
            out[v, c] = terms.inertia_diagonal[v] * x[v, c]
    for q in range(len(terms.pinned_vertices)):
        v = terms.pinned_vertices[q]
        for c in range(3):
            out[v, c] += terms.pin_weight[q] * x[v, c]
    for e in range(len(terms.stiffness)):
        i, j = terms.edges[e, 0], terms.edges[e, 1]
        s0, s1, s2 = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        stretch = linear[e, 0] * s0 + linear[e, 1] * s1 + linear[e, 2] * s2
        f0 = linear[e, 3] * s0 + stretch * linear[e, 0]
        f1 = linear[e, 3] * s1 + stretch * linear[e, 1]
        f2 = linear[e, 3] * s2 + stretch * linear[e, 2]
        out[i, 0] += f0
        out[i, 1] += f1
        out[i, 2] += f2
        out[j, 0] -= f0
        out[j, 1] -= f1
        out[j, 2] -= f2
