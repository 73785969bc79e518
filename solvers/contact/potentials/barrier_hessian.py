"""Hessian of the barrier potential in closed form.

With z = sum_i c_i x_i, the directions w_a in which c changes with each free local coordinate
(`contact.geometry.distance`), and D = |z|^2/2,

    D'' = c c' (x) I - B G^-1 B',     B_ia = c_i z_a + w_ia z,     z_a = sum_i w_ia x_i,     G_ab = z_a z_b

so that f(d)'' = f'' g g' + f'/d (c c' (x) (I - n n') - B G^-1 B'). f' is negative, so that only the first term in the
bracket has negative curvature. `negative_fraction` is the fraction of the negative curvature that is included. With 1
the blocks are exact; with 0 they are positive semidefinite and never less than the exact ones. A collision of k
vertices has a block of 3 k rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.collisions import EDGE_EDGE, POINT_EDGE, POINT_TRIANGLE, Collisions
from springbench.solvers.contact.potentials.barrier import (
    barrier_derivatives,
    clamped_distance,
    compute_distance_and_gap,
)
from springbench.solvers.contact.potentials.edge_edge_mollifier import (
    add_edge_rotation_hessian,
    compute_edge_cross_product,
    compute_mollifier_hessian_weights,
    edge_edge_mollifier,
)
from springbench.solvers.contact.potentials.friction import TangentialCollisions
from springbench.solvers.contact.potentials.hessian_blocks import (
    BLOCK_ENTRIES,
    PackedBlocks,
    ReusableBuffer,
    add_block_at,
    row_offset,
)
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.simd.float64x8 import load_packet, store_packet

FloatArray = NDArray[np.float64]

_SCRATCH_STRIDE, _SCRATCH_PADDING = 16, 8
"""Length of a scratch row, two vectors; number of entries written beyond the end of a block."""

_G, _DC, _FIRST_TANGENT, _SECOND_TANGENT = range(4)
"""Rows of the scratch array, by content."""


def build_hessian_blocks(
    collisions: Collisions,
    tangential_collisions: TangentialCollisions,
    p: FloatArray,
    n: int,
    negative_fraction: float,
    buffer: ReusableBuffer,
) -> PackedBlocks:
    """Build the Hessian blocks of collisions and of friction.

    Args:
        collisions: active collisions.
        tangential_collisions: friction.
        p: positions (N, 3) [m] of all vertices.
        n: number of vertices that move.
        negative_fraction: fraction of the negative curvature to include.
        buffer: memory of the blocks.

    Returns:
        Blocks [N/m].
    """
    width = np.minimum(collisions.kind, 4)
    starts = np.concatenate([[0], np.cumsum(9 * width * (width + 1) // 2)])
    packed = buffer.acquire_array(int(starts[-1]) + _SCRATCH_PADDING)
    write_barrier_hessian(collisions, p, negative_fraction, starts, np.zeros((4, _SCRATCH_STRIDE)), packed)
    blocks = PackedBlocks(collisions.vertices, starts, packed)
    if len(tangential_collisions.vertices):
        blocks = blocks.append_blocks(tangential_collisions.hessian_blocks(p))
    return blocks._replace(vertices=collect_block_vertices(collisions, tangential_collisions, n))


def collect_block_vertices(
    collisions: Collisions, tangential_collisions: TangentialCollisions, n: int
) -> NDArray[np.int64]:
    """Return the block vertices (a, 4) of collisions and friction.

    Missing vertices, and those beyond the first n, are -1.

    Args:
        collisions: active collisions, which come first.
        tangential_collisions: friction.
        n: number of vertices that move.
    """
    met = np.where(np.arange(4) < collisions.kind[:, None], collisions.vertices, -1)
    return mask_static_vertices(met, tangential_collisions, n)


def mask_static_vertices(
    vertices: NDArray[np.int64], tangential_collisions: TangentialCollisions, n: int
) -> NDArray[np.int64]:
    """Return vertices followed by those of friction; -1 for those that do not move.

    Args:
        vertices: vertices of blocks (a, 4), -1 for none.
        tangential_collisions: friction of g collisions.
        n: number of vertices that move, which are the first ones.

    Returns:
        Vertices (a + g, 4).
    """
    both = np.concatenate([vertices, tangential_collisions.vertices])
    return np.where(both < n, both, -1)


def add_barrier_hessian(
    collisions: Collisions,
    tangential_collisions: TangentialCollisions,
    p: FloatArray,
    negative_fraction: float,
    block_indices: NDArray[np.int64],
    values: FloatArray,
) -> None:
    """Add the Hessian [N/m] of collisions and friction to existing 3x3 blocks.

    Args:
        collisions: active collisions.
        tangential_collisions: friction.
        p: positions (N, 3) [m] of all vertices.
        negative_fraction: fraction of the negative curvature to include.
        block_indices: target block of each vertex pair, (a, 16); -1 for none.
        values: blocks (b, 3, 3) [N/m], updated.
    """
    many = len(collisions.vertices)
    scatter_barrier_hessian(
        collisions,
        p,
        negative_fraction,
        block_indices[:many],
        np.zeros((4, _SCRATCH_STRIDE)),
        np.empty(BLOCK_ENTRIES + _SCRATCH_PADDING),
        values,
    )
    if len(tangential_collisions.vertices):
        tangential_collisions.hessian_blocks(p).add_blocks(block_indices[many:], values)


@jit_kernel
def write_barrier_hessian(collisions, p, negative_fraction, starts, scratch, out):
    """Write the Hessian block of each collision.

    Args:
        collisions: active collisions.
        p: positions (n, 3) [m].
        negative_fraction: fraction of the negative curvature to include.
        starts: first entry of each block, and the end of the last one, (a + 1,).
        scratch: (4, 16), zero initially.
        out: packed blocks [N/m], with room for eight entries beyond the last block.
    """
    for k in range(len(collisions.vertices)):
        _write_hessian_block(collisions, k, p, negative_fraction, scratch, out[starts[k] :])


@jit_kernel
def scatter_barrier_hessian(collisions, p, negative_fraction, block_indices, scratch, block, values):
    """Add the Hessian block of each collision at p (n, 3) to `values`.

    Args:
        collisions: active collisions.
        p: positions (n, 3) [m].
        negative_fraction: fraction of the negative curvature to include.
        block_indices: target block of each vertex pair, (a, 16); -1 for none.
        scratch: (4, 16), zero initially.
        block: scratch (98,).
        values: blocks (b, 3, 3) [N/m], updated.
    """
    for k in range(len(collisions.vertices)):
        many = min(collisions.kind[k], 4)
        _write_hessian_block(collisions, k, p, negative_fraction, scratch, block)
        add_block_at(block[: 9 * many * (many + 1) // 2], block_indices[k], values)


class HessianWeights(NamedTuple):
    """Weights of the terms of a Hessian block.

    With m = grad |u x v|^2 of edges and the G-orthogonal columns b1, b2 of B, the block is

    normal g g' + mollifier_cross (g m' + m g') + mollifier_outer m m' - first_tangent b1 b1' - second_tangent b2 b2'
    + isotropic c c' (x) I, and edge_rotation, that of the rotation of edges (`contact.potentials.edge_edge_mollifier`).
    """

    normal: float
    mollifier_cross: float
    mollifier_outer: float
    first_tangent: float
    second_tangent: float
    isotropic: float
    edge_rotation: float


@jit_inner
def compute_hessian_weights(collisions, k, p, negative_fraction, scratch):
    """Return the Hessian weights of a collision.

    Args:
        collisions: active collisions.
        k: index of the collision.
        p: positions (n, 3) [m].
        negative_fraction: fraction of the negative curvature to include.
        scratch: output of four rows of 12 numbers or more, the vectors g, m, b1 and b2.
    """
    x, kind = collisions.vertices[k], collisions.kind[k]
    many = min(kind, 4)
    z0, z1, z2 = collisions.distance_vector[k, 0], collisions.distance_vector[k, 1], collisions.distance_vector[k, 2]
    d, gap = compute_distance_and_gap(collisions, k)
    d = max(d, 1e-300)
    c, g, dc, first, second = (
        collisions.coefficients[k],
        scratch[_G],
        scratch[_DC],
        scratch[_FIRST_TANGENT],
        scratch[_SECOND_TANGENT],
    )
    b, b1, b2 = barrier_derivatives(clamped_distance(gap))
    r, m, m1, m2 = collisions.distance_scale[k] * collisions.dhat, 1.0, 0.0, 0.0
    f, f1, f2 = collisions.stiffness[k] * r * r * b, collisions.stiffness[k] * r * b1, collisions.stiffness[k] * b2
    if collisions.mollifier_threshold[k] > 0.0:
        m, m1, m2 = edge_edge_mollifier(compute_edge_cross_product(p, x).c, collisions.mollifier_threshold[k])
    across = f1 / d
    tangent_1, tangent_2 = _orthogonalise_columns(p, x, kind, c, z0, z1, z2, first, second)
    n0, n1, n2 = z0 / d, z1 / d, z2 / d
    for i in range(many):
        g[3 * i], g[3 * i + 1], g[3 * i + 2] = c[i] * n0, c[i] * n1, c[i] * n2
    along, side = m * (f2 - negative_fraction * across), negative_fraction * m * across
    tangent_1, tangent_2 = m * across * tangent_1, m * across * tangent_2
    mixed, outer = 0.0, 0.0
    if m1 != 0.0:
        mixed, outer, share = compute_mollifier_hessian_weights(
            compute_edge_cross_product(p, x), (m, m1, m2), (f, f1, f2), negative_fraction, dc
        )
        along += share
    else:
        dc[:] = 0.0
    if tangent_1 == 0.0:
        first[:] = 0.0
    if tangent_2 == 0.0:
        second[:] = 0.0
    return HessianWeights(along, mixed, outer, tangent_1, tangent_2, side, 2.0 * f * m1)


@jit_inner
def compute_row_weights(terms, scratch, r):
    """Return the factors of g, m, b1 and b2 in a row of the block.

    Args:
        terms: Hessian weights of the collision.
        scratch: vectors g, m, b1 and b2 in its rows, by `compute_hessian_weights`.
        r: row of the block, 3 i + a for coordinate a of vertex i.
    """
    g, dc = scratch[_G, r], scratch[_DC, r]
    tangent_1, tangent_2 = (
        terms.first_tangent * scratch[_FIRST_TANGENT, r],
        terms.second_tangent * scratch[_SECOND_TANGENT, r],
    )
    return (
        terms.normal * g + terms.mollifier_cross * dc,
        terms.mollifier_cross * g + terms.mollifier_outer * dc,
        tangent_1,
        tangent_2,
    )


@jit_inner
def combine_row_terms(weights, g, dc, first, second):
    """Return one entry of a row, or a packet of eight consecutive ones.

    The isotropic term and the rotation of edges are excluded.

    Args:
        weights: factors of g, m, b1 and b2 in the row, by `compute_row_weights`.
        g, dc, first, second: entries of g, m, b1 and b2 in the columns, a float or a packet each.
    """
    along, mixed, tangent_1, tangent_2 = weights
    return (along * g + mixed * dc) - (tangent_1 * first + tangent_2 * second)


@jit_inner
def _write_hessian_block(collisions, k, p, negative_fraction, scratch, H):
    found, c, many = (
        compute_hessian_weights(collisions, k, p, negative_fraction, scratch),
        collisions.coefficients[k],
        min(collisions.kind[k], 4),
    )
    g_low, dc_low = load_packet(scratch, _G * _SCRATCH_STRIDE), load_packet(scratch, _DC * _SCRATCH_STRIDE)
    g_high, dc_high = load_packet(scratch, _G * _SCRATCH_STRIDE + 8), load_packet(scratch, _DC * _SCRATCH_STRIDE + 8)
    first_low, second_low = (
        load_packet(scratch, _FIRST_TANGENT * _SCRATCH_STRIDE),
        load_packet(scratch, _SECOND_TANGENT * _SCRATCH_STRIDE),
    )
    first_high, second_high = (
        load_packet(scratch, _FIRST_TANGENT * _SCRATCH_STRIDE + 8),
        load_packet(scratch, _SECOND_TANGENT * _SCRATCH_STRIDE + 8),
    )
    for i in range(many):
        for a in range(3):
            at, r = row_offset(i, a), 3 * i + a
            # Entries written beyond the row's end are overwritten by the rows that follow.
            weights = compute_row_weights(found, scratch, r)
            store_packet(combine_row_terms(weights, g_low, dc_low, first_low, second_low), H, at)
            if i > 1:
                store_packet(combine_row_terms(weights, g_high, dc_high, first_high, second_high), H, at + 8)
            if found.isotropic != 0.0:
                for j in range(i + 1):
                    H[at + 3 * j + a] += found.isotropic * c[i] * c[j]
    if found.edge_rotation != 0.0:
        add_edge_rotation_hessian(
            compute_edge_cross_product(p, collisions.vertices[k]), found.edge_rotation, negative_fraction, H
        )


@jit_inner
def _orthogonalise_columns(p, x, kind, c, z0, z1, z2, first, second):
    """Write the columns of B, orthogonalised by G; return their weights in B G^-1 B'."""
    around = kind in (POINT_EDGE, POINT_TRIANGLE)
    if around:
        one, two = (1, 2), (1, 3)
    else:
        one, two = (1, 0), (2, 3)
    firstly = around or (kind == EDGE_EDGE and c[0] != 0.0 and c[1] != 0.0)
    secondly = kind == POINT_TRIANGLE or (kind == EDGE_EDGE and c[2] != 0.0 and c[3] != 0.0)
    if not firstly:
        if not secondly:
            return 0.0, 0.0
        one, secondly = two, False
    a0, a1, a2 = _write_sliding_column(p, x, one, c, z0, z1, z2, first)
    size = a0 * a0 + a1 * a1 + a2 * a2
    if not secondly:
        return 1.0 / size, 0.0
    b0, b1, b2 = _write_sliding_column(p, x, two, c, z0, z1, z2, second)
    mixed = (a0 * b0 + a1 * b1 + a2 * b2) / size
    n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    for i in range(12):
        second[i] -= mixed * first[i]
    return 1.0 / size, size / (n0 * n0 + n1 * n1 + n2 * n2)


@jit_inner
def _write_sliding_column(p, x, ends, c, z0, z1, z2, out):
    """Write a column of B (12,), and return z_a.

    The column is that of c moving from the second of two ends to the first.
    """
    i, j = ends
    a0, a1, a2 = p[x[i], 0] - p[x[j], 0], p[x[i], 1] - p[x[j], 1], p[x[i], 2] - p[x[j], 2]
    for k in range(4):
        out[3 * k], out[3 * k + 1], out[3 * k + 2] = c[k] * a0, c[k] * a1, c[k] * a2
    for end, w in ((i, 1.0), (j, -1.0)):
        out[3 * end] += w * z0
        out[3 * end + 1] += w * z1
        out[3 * end + 2] += w * z2
    return a0, a1, a2
