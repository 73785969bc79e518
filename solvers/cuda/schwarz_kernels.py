"""Kernels of the additive Schwarz preconditioner.

They assemble and invert subdomains, and multiply by the inverses.

A subdomain is inverted where it is assembled, in shared memory, in float64 and in place. It is symmetric, and only one
half is stored, packed by rows. Sweeping each pivot of a positive definite A yields -A^-1 (Goodnight 1979, "A tutorial
on the SWEEP operator"):

    a_ij <- a_ij - a_ik a_kj / a_kk,   a_ik <- a_ik / a_kk,   a_kk <- -1 / a_kk
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from springbench.solvers.cuda import device_sums
from springbench.solvers.cuda.cuda_target import cuda
from springbench.solvers.cuda.function_sharing import share_with_device
from springbench.solvers.kernels import spring_law
from springbench.solvers.model.energies import element_energies

RealType = type[np.float32] | type[np.float64]

_unit_direction = share_with_device(spring_law.unit_direction)
_transverse_stiffness = share_with_device(spring_law.transverse_stiffness)
_axial_hessian = share_with_device(element_energies.axial_hessian)


def packed_length(num_nodes: int) -> int:
    """Return the length of the packed half of a subdomain's matrix."""
    return 3 * num_nodes * (3 * num_nodes + 1) // 2


@cuda.jit
def write_edge_blocks(edges, p, stiff):
    """Write the block b of each edge of the finest level.

    Args:
        edges: edges on the device.
        p: positions in rows (n, 3) [m].
        stiff: output, xx, xy, xz, yy, yz and zz of each symmetric block (6, m) [N/m].
    """
    e = cuda.grid(1)
    while e < edges.ends.shape[0]:
        i, j, k, rest = edges.ends[e, 0], edges.ends[e, 1], edges.edge_stiffness[e], edges.edge_rest_length[e]
        v0, v1, v2 = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        if rest == rest:
            n0, n1, n2, length = _unit_direction(v0, v1, v2, edges.edge_direction, e)
            lateral = _transverse_stiffness(k, rest, k * (length - rest), length)
        else:  # a dashpot's length at rest is nan, and its direction is its axis
            n0, n1, n2 = edges.edge_direction[e, 0], edges.edge_direction[e, 1], edges.edge_direction[e, 2]
            lateral = 0.0
        if rest > 0.0:  # edges of quadratic forms have no rest length, and may have a negative stiffness
            lateral = max(0.0, lateral)
        xx, xy, xz, yy, yz, zz = _axial_hessian(k, lateral, n0, n1, n2)
        stiff[0, e], stiff[1, e], stiff[2, e], stiff[3, e], stiff[4, e], stiff[5, e] = xx, xy, xz, yy, yz, zz
        e += cuda.gridsize(1)


@cuda.jit
def sum_fine_edge_blocks(level, count, finer, stiff):
    """Sum the blocks of finer edges for each edge of a level.

    Args:
        level: the level on the device, with its lists of finer edges.
        count: number of edges of the level.
        finer: blocks of the edges of the next finer level (6, m) [N/m].
        stiff: output, blocks of the level's edges (6, count) [N/m].
    """
    e = cuda.grid(1)
    while e < count:
        for c in range(6):
            total = 0.0
            for k in range(level.fine_edge_starts[e], level.fine_edge_starts[e + 1]):
                total += finer[c, level.fine_edges[k]]
            stiff[c, e] = total
        e += cuda.gridsize(1)


class SchwarzKernels(NamedTuple):
    """Kernels for one precision and one size of subdomains."""

    invert_subdomains: Any
    restrict_residual: Any
    apply_inverses: Any
    sum_inner_product: Any


@cache
def build_schwarz_kernels(real: RealType, patch: int) -> SchwarzKernels:
    """Build the kernels of the preconditioner for one precision.

    Args:
        real: floating-point type of inverses and residuals.
        patch: number of nodes of a subdomain.
    """
    rows, half = 3 * patch, packed_length(patch)

    @cuda.jit
    def invert(level, stiff, nodes, inverses):
        """Write the inverses of a level's subdomains, packed by rows.

        Blocks of threads loop over the subdomains.
        """
        a = cuda.shared.array(half, np.float64)
        column = cuda.shared.array(rows, np.float64)  # the simulator identifies shared arrays by their line
        b = cuda.blockIdx.x
        while b < inverses.shape[0]:
            begin = patch * b
            count = min(patch, nodes - begin)
            size, t = 3 * count, cuda.threadIdx.x
            while t < size * (size + 1) // 2:
                a[t] = 0.0
                t += cuda.blockDim.x
            cuda.syncthreads()
            t = cuda.threadIdx.x
            while t < count:
                i = begin + t
                xx = yy = zz = level.anchor_stiffness[i]
                xy = xz = yz = 0.0
                one, two, three = (
                    3 * t * (3 * t + 1) // 2,
                    (3 * t + 1) * (3 * t + 2) // 2,
                    (3 * t + 2) * (3 * t + 3) // 2,
                )
                e, end = level.warp_starts[i >> 5] + (i & 31), level.warp_starts[(i >> 5) + 1]
                while e < end:
                    j, k = level.neighbour_rows[e], level.edge_indices[e]
                    if j == i:
                        break
                    k = ~k if k < 0 else k
                    s0, s1, s2, s3, s4, s5 = (
                        stiff[0, k],
                        stiff[1, k],
                        stiff[2, k],
                        stiff[3, k],
                        stiff[4, k],
                        stiff[5, k],
                    )
                    xx, xy, xz, yy, yz, zz = xx + s0, xy + s1, xz + s2, yy + s3, yz + s4, zz + s5
                    if begin <= j and j < i:
                        at = 3 * (j - begin)
                        a[one + at], a[one + at + 1], a[one + at + 2] = (
                            a[one + at] - s0,
                            a[one + at + 1] - s1,
                            a[one + at + 2] - s2,
                        )
                        a[two + at], a[two + at + 1], a[two + at + 2] = (
                            a[two + at] - s1,
                            a[two + at + 1] - s3,
                            a[two + at + 2] - s4,
                        )
                        a[three + at], a[three + at + 1], a[three + at + 2] = (
                            a[three + at] - s2,
                            a[three + at + 1] - s4,
                            a[three + at + 2] - s5,
                        )
                    e += 32
                at = 3 * t
                a[one + at] = xx
                a[two + at], a[two + at + 1] = xy, yy
                a[three + at], a[three + at + 1], a[three + at + 2] = xz, yz, zz
                t += cuda.blockDim.x
            cuda.syncthreads()
            for k in range(size):
                t = cuda.threadIdx.x
                while t < size:
                    column[t] = a[t * (t + 1) // 2 + k] if t >= k else a[k * (k + 1) // 2 + t]
                    t += cuda.blockDim.x
                cuda.syncthreads()
                inverse, t = 1.0 / column[k], cuda.threadIdx.x
                while t < size:
                    at, scaled = t * (t + 1) // 2, column[t] * inverse
                    for c in range(t + 1):
                        if t == k:
                            a[at + c] = -inverse if c == k else column[c] * inverse
                        elif c == k:
                            a[at + c] = scaled
                        else:
                            a[at + c] -= scaled * column[c]
                    t += cuda.blockDim.x
                cuda.syncthreads()
            t = cuda.threadIdx.x
            while t < size * (size + 1) // 2:
                inverses[b, t] = real(-a[t])
                t += cuda.blockDim.x
            cuda.syncthreads()
            b += cuda.gridDim.x

    @cuda.jit
    def gather(r, coarse, now):
        """Restrict the residual by sums over the parts of a level's nodes (N, 3).

        Do nothing if now[0] is not 0.
        """
        if now[0] != 0.0:
            return
        i = cuda.grid(1)
        while i < coarse.shape[0]:
            for c in range(3):
                total = real(0.0)
                for k in range(patch * i, min(patch * i + patch, r.shape[0])):
                    total += r[k, c]
                coarse[i, c] = total
            i += cuda.gridsize(1)

    @cuda.jit
    def multiply(inverses, r, coarse, add, z, now):
        """Write B^-1 r of a level's subdomains to z (N, 3).

        With `add`, also add the correction of the next level.
        """
        if now[0] != 0.0:
            return
        a = cuda.shared.array(half, real)
        x = cuda.shared.array(rows, real)
        b = cuda.blockIdx.x
        while b < inverses.shape[0]:
            begin = patch * b
            size, t = 3 * min(patch, r.shape[0] - begin), cuda.threadIdx.x
            while t < size * (size + 1) // 2:
                a[t] = inverses[b, t]
                t += cuda.blockDim.x
            t = cuda.threadIdx.x
            while t < size:
                x[t] = r[begin + t // 3, t % 3]
                t += cuda.blockDim.x
            cuda.syncthreads()
            t = cuda.threadIdx.x
            while t < size:
                total, at = real(0.0), t * (t + 1) // 2
                for c in range(t + 1):
                    total += a[at + c] * x[c]
                at += t
                for c in range(t + 1, size):
                    at += c
                    total += a[at] * x[c]
                z[begin + t // 3, t % 3] = total + coarse[b, t % 3] if add else total
                t += cuda.blockDim.x
            cuda.syncthreads()
            b += cuda.gridDim.x

    @cuda.jit
    def dot(r, z, which, partials, now):
        """Do the first stage of the sum r'z."""
        if now[0] != 0.0:
            return
        total, i = 0.0, cuda.grid(1)
        while i < z.shape[0]:
            for c in range(3):
                total += np.float64(r[i, c]) * np.float64(z[i, c])
            i += cuda.gridsize(1)
        device_sums.store_partial_sum(total, which, partials)

    return SchwarzKernels(invert, gather, multiply, dot)
