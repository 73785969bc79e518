"""The compiled step of each vertex in JGS2, with its patch (`springbench.solvers.methods.vertex_block.jgs2`).

d_i = -R_i S^-1 sum over a of W_a' g_a,   S = sum over a, b of W_a' H_ab W_b,   W_a = R_a response_ia
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel


class VertexPatches(NamedTuple):
    """The patch of each free vertex and its response.

    Attributes:
        patch_starts: start of each patch (f + 1,).
        patch_vertices: vertices of the patches, ascending, with the vertex itself (e,).
        response: displacements per displacement of the vertex (e, 3, 3), dimensionless.
    """

    patch_starts: NDArray[np.int64]
    patch_vertices: NDArray[np.int64]
    response: NDArray[np.float64]


class PatchScratch(NamedTuple):
    """The scratch memory of `compute_directions`.

    Attributes:
        local_index: index of each vertex within the patch (f,), initially -1.
        rotated_response: W of the largest patch (k, 3, 3).
        product, block: blocks (3, 3).
        patch_gradient: W'g of the patch (3,).
    """

    local_index: NDArray[np.int64]
    rotated_response: NDArray[np.float64]
    product: NDArray[np.float64]
    block: NDArray[np.float64]
    patch_gradient: NDArray[np.float64]

    @classmethod
    def from_patches(cls, patches: VertexPatches) -> PatchScratch:
        """Allocate the scratch of patches."""
        most = int(np.diff(patches.patch_starts).max(initial=1))
        return cls(
            np.full(len(patches.patch_starts) - 1, -1),
            np.zeros((most, 3, 3)),
            np.zeros((3, 3)),
            np.zeros((3, 3)),
            np.zeros(3),
        )


@jit_kernel
def compute_directions(patches, rotations, pointers, columns, blocks, gradient, scratch, out):
    """Write the step d of each free vertex (f, 3) [m] to `out`.

    Args:
        patches: the patches.
        rotations: rotation of each vertex (f, 3, 3).
        pointers, columns, blocks: H by rows, with all columns.
        gradient: (f, 3) [N].
        scratch: scratch memory.
        out: output (f, 3) [m].
    """
    start, near, response = patches
    place, turned, product, block, pull = scratch
    for i in range(len(start) - 1):
        first, count = start[i], start[i + 1] - start[i]
        for k in range(count):
            a = near[first + k]
            place[a] = k
            for r in range(3):
                for c in range(3):
                    turned[k, r, c] = (
                        rotations[a, r, 0] * response[first + k, 0, c]
                        + rotations[a, r, 1] * response[first + k, 1, c]
                        + rotations[a, r, 2] * response[first + k, 2, c]
                    )
        for r in range(3):
            pull[r] = 0.0
            for c in range(3):
                block[r, c] = 0.0
        for k in range(count):
            a = near[first + k]
            _multiply_patch(turned, place, a, pointers, columns, blocks, product)
            for r in range(3):
                for c in range(3):
                    pull[c] += turned[k, r, c] * gradient[a, r]
                    for s in range(3):
                        block[s, c] += turned[k, r, s] * product[r, c]
        for k in range(count):
            place[near[first + k]] = -1
        _solve_block(block, pull)
        for r in range(3):
            out[i, r] = -(rotations[i, r, 0] * pull[0] + rotations[i, r, 1] * pull[1] + rotations[i, r, 2] * pull[2])


@jit_inner
def _multiply_patch(turned, place, a, pointers, columns, blocks, product):
    """Write vertex a's half of the symmetric sum over a patch to `product`.

    It is H_aa W_a / 2 plus the sum of H_ab W_b over b > a.
    """
    for r in range(3):
        for c in range(3):
            product[r, c] = 0.0
    for e in range(pointers[a], pointers[a + 1]):
        b = columns[e]
        k = place[b]
        if b < a or k < 0:
            continue
        part = 0.5 if b == a else 1.0
        for r in range(3):
            h0, h1, h2 = part * blocks[e, r, 0], part * blocks[e, r, 1], part * blocks[e, r, 2]
            for c in range(3):
                product[r, c] += h0 * turned[k, 0, c] + h1 * turned[k, 1, c] + h2 * turned[k, 2, c]


@jit_inner
def _solve_block(half, x):
    """Overwrite x with (half + half')^-1 x.

    If that matrix is not positive definite, x is divided by its trace instead.
    """
    a, b, c = 2.0 * half[0, 0], half[0, 1] + half[1, 0], half[0, 2] + half[2, 0]
    d, e, f = 2.0 * half[1, 1], half[1, 2] + half[2, 1], 2.0 * half[2, 2]
    trace = a + d + f
    least = 1e-14 * trace
    if a > least:
        l10, l20 = b / a, c / a
        second, mixed = d - l10 * b, e - l10 * c
        if second > least:
            l21 = mixed / second
            third = f - l20 * c - l21 * mixed
            if third > least:
                y1 = x[1] - l10 * x[0]
                x[2] = (x[2] - l20 * x[0] - l21 * y1) / third
                x[1] = y1 / second - l21 * x[2]
                x[0] = x[0] / a - l10 * x[1] - l20 * x[2]
                return
    by = 1.0 / trace if trace > 0.0 else 0.0
    for r in range(3):
        x[r] *= by
