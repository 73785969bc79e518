"""Kernels that rule out negative curvature of the Hessian H, or search for it.

    x'Hx >= sum_v (h_v - 2 sum_{e at v} c_e) |x_v|^2,   c_e = k_e max(0, r_e/l_e - 1),   h_v: inertia and pins

A spring contributes at least -c_e |x_i - x_j|^2, which is at least -2 c_e (|x_i|^2 + |x_j|^2), or -c_e |x_i|^2 if the
other end is fixed. Constant forms contribute at least 0. An element whose second derivatives have the smallest
eigenvalue s < 0 contributes at least s times its number of vertices times sum_a c_a^2 |x_a|^2. Where all brackets are
positive, H is positive definite.

Elsewhere conjugate gradients for H y = b, with a fixed pseudorandom b, meet a direction x with x'Hx < 0 as soon as
their Krylov space contains one (Nocedal and Wright 2006, algorithm 7.1). The preconditioner is the inverse of the 3 x 3
diagonal blocks without the negative parts of springs. Across a sheet or a line these blocks are small, so that buckling
appears in the first few products.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.kernels.hessian_packets import fill_linear_springs, multiply_packets
from springbench.solvers.kernels.quadratic_form_kernels import add_product
from springbench.solvers.kernels.spring_hessian import linearise_springs
from springbench.solvers.linalg.krylov import NEGATIVE_CURVATURE, compile_cg_loop
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.model.energies.element_energies import add_products

CURVATURE_ROUNDOFF = 16.0 * np.finfo(np.float64).eps
"""Curvature relative to the absolute terms of its sum below which it is round-off."""

EXHAUSTED_RATIO = 1e-20
"""Decrease of r'z at which the Krylov space is exhausted: a solution to ten digits."""

_BLOCK_SHIFT = 1e-6
"""Shift of a block relative to the sum of its absolute entries: springs may resist in one direction only."""


class CurvatureScratch(NamedTuple):
    """Scratch of a search over n vertices, overwritten.

    Attributes:
        inverse_blocks: packed 3 x 3 blocks of the preconditioner (n, 6) [m/N], zero for fixed vertices.
        absolute_stiffness: sum of the absolute terms of the diagonal (n,) [N/m].
        start: right-hand side b (n, 3), not overwritten.
        residual: (n, 3).
        direction, product: (n + 2, 4), zero in the last two rows and the last column; the direction is the one found,
            the product also contains z.
    """

    inverse_blocks: NDArray[np.float64]
    absolute_stiffness: NDArray[np.float64]
    start: NDArray[np.float64]
    residual: NDArray[np.float64]
    direction: NDArray[np.float64]
    product: NDArray[np.float64]

    @classmethod
    def from_size(cls, num_vertices: int) -> CurvatureScratch:
        """Allocate scratch; the right-hand side is the same in each call and has no symmetry."""
        start = np.random.default_rng(0).normal(size=(num_vertices, 3))
        direction, product = (allocate_aligned(4 * (num_vertices + 2)).reshape(-1, 4) for _ in range(2))
        blocks, sizes = np.empty((num_vertices, 6)), np.empty(num_vertices)
        return cls(blocks, sizes, start, np.empty_like(start), direction, product)


@jit_kernel
def bound_by_springs(terms, p, anchor_stiffness, linear, negative):
    """Return whether the bound shows that springs, forms, inertia and pins have no negative curvature.

    Args:
        terms: objective terms.
        p: positions (n, 3) [m].
        anchor_stiffness: stiffness of inertia and pins (n,) [N/m], infinite at fixed vertices.
        linear: output (m, 4), the springs as `linearise_springs` writes them.
        negative: scratch (n,).
    """
    linearise_springs(terms, p, linear)
    _add_spring_bounds(terms, linear, anchor_stiffness, negative)
    return _is_outweighed(anchor_stiffness, negative)


@jit_kernel
def bound_by_elements(terms, linear, joined, curvature, anchor_stiffness, negative):
    """Return whether the bound shows that the Hessian, with elements, has no negative curvature.

    Args:
        terms: objective terms.
        linear: springs as `linearise_springs` writes them (m, 4).
        joined: elements, or None.
        curvature: second derivatives of the elements, one row of 6 each [N/m], or None.
        anchor_stiffness: stiffness of inertia and pins (n,) [N/m], infinite at fixed vertices.
        negative: scratch (n,).
    """
    _add_spring_bounds(terms, linear, anchor_stiffness, negative)
    _add_element_bounds(joined, curvature, negative)
    return _is_outweighed(anchor_stiffness, negative)


@jit_inner
def _add_spring_bounds(terms, linear, anchor_stiffness, negative):
    for v in range(len(negative)):
        negative[v] = 0.0
    for e in range(len(linear)):
        i, j, lateral = terms.edges[e, 0], terms.edges[e, 1], linear[e, 3]
        if lateral < 0.0 and i != j:
            negative[i] -= lateral if anchor_stiffness[j] == np.inf else 2.0 * lateral
            negative[j] -= lateral if anchor_stiffness[i] == np.inf else 2.0 * lateral


@jit_inner
def _is_outweighed(anchor_stiffness, negative):
    positive = True
    for v in range(len(negative)):
        positive &= negative[v] == 0.0 or negative[v] < anchor_stiffness[v]
    return positive


@jit_inner
def _add_element_bounds(joined, curvature, negative):
    if joined is None:
        return
    for e in range(len(curvature)):
        xx, xy, xz = curvature[e, 0], abs(curvature[e, 1]), abs(curvature[e, 2])
        yy, yz, zz = curvature[e, 3], abs(curvature[e, 4]), curvature[e, 5]
        least = min(xx - xy - xz, yy - xy - yz, zz - xz - yz)  # Gershgorin
        if least < 0.0 and not _is_semidefinite(curvature, e):
            first, end = joined.row_starts[e], joined.row_starts[e + 1]
            for a in range(first, end):
                negative[joined.vertices[a]] -= (end - first) * joined.coefficients[a] ** 2 * least


@jit_inner
def _is_semidefinite(curvature, e):
    """Return whether the second derivatives of an element have no negative eigenvalue beyond round-off."""
    xx, xy, xz = curvature[e, 0], curvature[e, 1], curvature[e, 2]
    yy, yz, zz = curvature[e, 3], curvature[e, 4], curvature[e, 5]
    tiny = CURVATURE_ROUNDOFF * (abs(xx) + abs(yy) + abs(zz))
    xx, yy, zz = xx + tiny, yy + tiny, zz + tiny
    minor = xx * yy - xy * xy
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return xx > 0.0 and minor > 0.0 and determinant > 0.0


@jit_kernel
def fill_preconditioner(terms, linear, form, joined, curvature, anchor_stiffness, scratch):
    """Write the inverse blocks and the absolute stiffness of the scratch.

    Args:
        terms: objective terms.
        linear: springs as `linearise_springs` writes them (m, 4).
        form: quadratic form, or None.
        joined: elements, or None.
        curvature: second derivatives of the elements, one row of 6 each [N/m], or None.
        anchor_stiffness: stiffness of inertia and pins (n,) [N/m], infinite at fixed vertices.
        scratch: output.
    """
    _fill_preconditioner(terms, linear, form, joined, curvature, anchor_stiffness, scratch)


@jit_inner
def _fill_preconditioner(terms, linear, form, joined, curvature, anchor_stiffness, scratch):
    blocks, size = scratch.inverse_blocks, scratch.absolute_stiffness
    for v in range(len(size)):
        size[v] = anchor_stiffness[v]
        _set_block(blocks, v, anchor_stiffness[v])
    for e in range(len(terms.stiffness)):
        i, j, k = terms.edges[e, 0], terms.edges[e, 1], terms.stiffness[e]
        if i == j:
            continue
        n0, n1, n2, lateral = linear[e, 0], linear[e, 1], linear[e, 2], linear[e, 3]
        along = 1.0 if lateral >= 0.0 else k / (k - lateral)  # the linearisation contains sqrt(k - lateral) n
        across = max(lateral, 0.0)
        for v in (i, j):
            size[v] += 2.0 * (k + abs(lateral))
            blocks[v, 0] += along * n0 * n0 + across
            blocks[v, 1] += along * n0 * n1
            blocks[v, 2] += along * n0 * n2
            blocks[v, 3] += along * n1 * n1 + across
            blocks[v, 4] += along * n1 * n2
            blocks[v, 5] += along * n2 * n2 + across
    _add_form(form, blocks, size)
    _add_elements(joined, curvature, blocks, size)
    for v in range(len(size)):
        if anchor_stiffness[v] == np.inf:
            _set_block(blocks, v, 0.0)
            size[v] = 0.0
        else:
            _invert_block(blocks, v)


@jit_inner
def _set_block(blocks, v, w):
    blocks[v, 0] = blocks[v, 3] = blocks[v, 5] = w
    blocks[v, 1] = blocks[v, 2] = blocks[v, 4] = 0.0


@jit_inner
def _add_to_block(blocks, v, w):
    blocks[v, 0] += w
    blocks[v, 3] += w
    blocks[v, 5] += w


@jit_inner
def _add_form(form, blocks, size):
    if form is None:
        return
    for v in range(len(form.vertex_weight)):
        size[v] += abs(form.vertex_weight[v])
        _add_to_block(blocks, v, form.vertex_weight[v])
    for k in range(len(form.pair_weight)):
        for v in form.pairs[k]:
            size[v] += 2.0 * abs(form.pair_weight[k])
            _add_to_block(blocks, v, form.pair_weight[k])


@jit_inner
def _add_elements(joined, curvature, blocks, size):
    if joined is None:
        return
    for e in range(len(curvature)):
        first, end = joined.row_starts[e], joined.row_starts[e + 1]
        total = 0.0
        for c in range(6):
            total += abs(curvature[e, c])
        for a in range(first, end):
            v, square = joined.vertices[a], joined.coefficients[a] ** 2
            size[v] += 2.0 * (end - first) * square * total
            for c in range(6):
                blocks[v, c] += square * curvature[e, c]


@jit_inner
def _invert_block(blocks, v):
    """Invert a packed symmetric block, with the first shift that makes it positive definite."""
    xx, xy, xz, yy, yz, zz = blocks[v, 0], blocks[v, 1], blocks[v, 2], blocks[v, 3], blocks[v, 4], blocks[v, 5]
    size = abs(xx) + abs(yy) + abs(zz) + abs(xy) + abs(xz) + abs(yz)
    shift = _BLOCK_SHIFT * size
    while shift <= 10.0 * size and size > 0.0:
        a, d, f = xx + shift, yy + shift, zz + shift
        c0, c1, c2 = d * f - yz * yz, yz * xz - xy * f, xy * yz - d * xz
        determinant = a * c0 + xy * c1 + xz * c2
        if a > 0.0 and a * d - xy * xy > 0.0 and determinant > 0.0:
            blocks[v, 0], blocks[v, 1], blocks[v, 2] = c0 / determinant, c1 / determinant, c2 / determinant
            blocks[v, 3] = (a * f - xz * xz) / determinant
            blocks[v, 4] = (xy * xz - a * yz) / determinant
            blocks[v, 5] = (a * d - xy * xy) / determinant
            return
        shift *= 10.0
    _set_block(blocks, v, 1.0)  # nothing acts on the vertex


@jit_inner
def _apply_block(blocks, v, x):
    x0, x1, x2 = x[v, 0], x[v, 1], x[v, 2]
    return (
        blocks[v, 0] * x0 + blocks[v, 1] * x1 + blocks[v, 2] * x2,
        blocks[v, 1] * x0 + blocks[v, 3] * x1 + blocks[v, 4] * x2,
        blocks[v, 2] * x0 + blocks[v, 4] * x1 + blocks[v, 5] * x2,
    )


@jit_kernel
def start_search(scratch):
    """Set the residual to b, the direction to 0, and return r'z."""
    return _start_search(scratch)


@jit_inner
def _start_search(scratch):
    for v in range(len(scratch.start)):
        for c in range(3):
            scratch.residual[v, c] = scratch.start[v, c]
            scratch.direction[v, c] = 0.0
    return _precondition_residual(scratch)


@jit_inner
def _precondition_residual(scratch):
    """Overwrite the product with z, and return r'z."""
    r, z, total = scratch.residual, scratch.product, 0.0
    for v in range(len(r)):
        z0, z1, z2 = _apply_block(scratch.inverse_blocks, v, r)
        z[v, 0], z[v, 1], z[v, 2] = z0, z1, z2
        total += r[v, 0] * z0 + r[v, 1] * z1 + r[v, 2] * z2
    return total


@jit_kernel
def update_search_direction(scratch, ratio):
    """Set the direction to z + ratio times the direction.

    Args:
        scratch: scratch of the search, whose product contains z.
        ratio: r'z over its previous value.
    """
    _update_direction(scratch, ratio)


@jit_inner
def _update_direction(scratch, ratio):
    p, z = scratch.direction, scratch.product
    for v in range(len(scratch.residual)):
        for c in range(3):
            p[v, c] = z[v, c] + ratio * p[v, c]


@jit_kernel
def measure_curvature(scratch):
    """Return the curvature along the direction, given its product with H; 0 within round-off."""
    return _measure_curvature(scratch)


@jit_inner
def _measure_curvature(scratch):
    p, q, curvature, size = scratch.direction, scratch.product, 0.0, 0.0
    for v in range(len(scratch.residual)):
        curvature += p[v, 0] * q[v, 0] + p[v, 1] * q[v, 1] + p[v, 2] * q[v, 2]
        size += scratch.absolute_stiffness[v] * (p[v, 0] ** 2 + p[v, 1] ** 2 + p[v, 2] ** 2)
    return curvature if abs(curvature) > CURVATURE_ROUNDOFF * size else 0.0


@jit_kernel
def update_residual(scratch, step_size):
    """Subtract the product times the step size from the residual, and return r'z.

    Args:
        scratch: scratch of the search; its product, H times the direction, is overwritten with z.
        step_size: r'z over the curvature.
    """
    return _update_residual(scratch, step_size)


@jit_inner
def _update_residual(scratch, step_size):
    for v in range(len(scratch.residual)):
        for c in range(3):
            scratch.residual[v, c] -= step_size * scratch.product[v, c]
    return _precondition_residual(scratch)


@jit_inner
def _compiled_update_direction(state, product, before):
    (form, joined, curvature, packets), scratch, _ = state
    _update_direction(scratch, product / before)
    multiply_packets(packets, scratch.direction, scratch.product)
    add_product(form, scratch.direction, scratch.product)
    add_products(joined, curvature, scratch.direction, scratch.product)
    return _measure_curvature(scratch)


@jit_inner
def _compiled_update_iterate(state, product, curvature):
    return _update_residual(state[1], product / curvature)


@jit_inner
def _is_convex(state, curvature):
    return curvature > 0.0


@jit_inner
def _is_exhausted(state, product):
    return not product > state[2]


_search_loop = compile_cg_loop(_compiled_update_direction, _compiled_update_iterate, _is_convex, _is_exhausted)


@jit_kernel
def search_compiled(terms, linear, form, joined, curvature, anchor_stiffness, packets, max_products, scratch):
    """Search for negative curvature of terms with an element-wise form.

    Args:
        terms, linear, form, joined, curvature, anchor_stiffness: those of `fill_preconditioner`.
        packets: packets of the springs; their linearised springs are overwritten.
        max_products: maximum number of products with the Hessian.
        scratch: scratch; its direction is the one found.

    Returns:
        The curvature x'Hx along the direction [J], 0 if none is negative.
    """
    _fill_preconditioner(terms, linear, form, joined, curvature, anchor_stiffness, scratch)
    fill_linear_springs(packets, linear)
    product = _start_search(scratch)
    hessian = form, joined, curvature, packets
    _, ended = _search_loop((hessian, scratch, EXHAUSTED_RATIO * product), product, max_products)
    return _measure_curvature(scratch) if ended == NEGATIVE_CURVATURE else 0.0
