"""Newton steps of single vertices with half-space contact, one vertex after another.

    k/2 min(0, n.x - d)^2 + F h(|u|),   u = (I - nn')(x - a)     a half-space (`half_space_potential`)

The block and gradient of a vertex are those of its springs, of active half-spaces and of friction. Half-spaces that
become active along the step are found by a few repetitions, each from the end of the last one. A step that increases
the energy is replaced by one with a larger block, finally one that majorises all terms. Two functions provide all other
energies of the vertices (`springbench.solvers.methods.vertex_block.incident_elements`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.potentials.friction_law import (
    friction_energy_change,
    friction_stiffness,
    project_tangentially,
    smoothed_length,
)
from springbench.solvers.jit.kernel_compilation import jit_closure, jit_inner
from springbench.solvers.kernels.edge_elements import add_edge_derivatives, edge_energy_change
from springbench.solvers.kernels.spring_law import unit_direction
from springbench.solvers.simd.spring_packets import LANES, RHS_STRIDE

_MAX_ACTIVE_SET_PASSES = 4
"""Maximum number of searches for the active half-spaces of a step with one block."""

EXACT_BLOCK, _FRICTION_MAJORANT, SPRING_MAJORANT, _FULL_MAJORANT = range(4)
"""The blocks: exact except for compressed springs; majorant of friction; also of springs; also of inactive contact."""

_PIVOT_ROUNDOFF = 1e-14
"""Pivots up to this fraction of the trace are round-off."""

_NUM_KEY_BITS, _INDEX_MULTIPLIER = 63, 0x9E3779B1
"""Number of half-spaces of a row that have a bit each in the key of a set, and the factor that hashes further ones."""


class HalfSpaces(NamedTuple):
    """Half-spaces by the rows of their vertices.

    Attributes:
        row_starts: first half-space of each row (rows + 1,).
        has_half_space: whether a packet has a vertex with a half-space (b,).
        normal, friction_anchor: n and a (k, 3).
        offset: d [m] (k,).
        stiffness: k [N/m] (k,).
        friction_limit: friction limit F [N] (k,).
        smoothing_length: smoothing length [m] (k,).
        is_two_sided: whether they act on both sides, as planes do.
    """

    row_starts: NDArray[np.int64]
    has_half_space: NDArray[np.bool_]
    normal: NDArray[np.float64]
    friction_anchor: NDArray[np.float64]
    offset: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    friction_limit: NDArray[np.float64]
    smoothing_length: NDArray[np.float64]
    is_two_sided: bool


@jit_inner
def _penetration_depth(s, gap):
    return gap if s.is_two_sided else min(0.0, gap)


@jit_inner
def _tangential_displacement(s, k, x):
    """Return u and |u| of a half-space at x."""
    u0, u1, u2 = project_tangentially(
        x[0] - s.friction_anchor[k, 0], x[1] - s.friction_anchor[k, 1], x[2] - s.friction_anchor[k, 2],
        s.normal[k, 0], s.normal[k, 1], s.normal[k, 2],
    )  # fmt: skip
    return u0, u1, u2, np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)


@jit_inner
def half_space_energy(s, p):
    """Return the half-spaces' energy [J].

    Args:
        s: half-spaces; None for none, whose energy is 0.
        p: flat positions [m], four numbers for each row, of which the last one is padding.
    """
    if s is None:
        return 0.0
    total = 0.0
    for i in range(len(s.row_starts) - 1):
        x = p[4 * i], p[4 * i + 1], p[4 * i + 2]
        for k in range(s.row_starts[i], s.row_starts[i + 1]):
            depth = _penetration_depth(
                s, s.normal[k, 0] * x[0] + s.normal[k, 1] * x[1] + s.normal[k, 2] * x[2] - s.offset[k]
            )
            total += 0.5 * s.stiffness[k] * depth * depth
            if s.friction_limit[k] > 0.0:
                total += s.friction_limit[k] * smoothed_length(
                    _tangential_displacement(s, k, x)[3], s.smoothing_length[k]
                )
    return total


@jit_inner
def _spring_gradient_and_block(packets, b, lane, p, x, anchor_stiffness, load):
    """Return the gradient and the block's upper triangle of a vertex's springs, inertia and pins."""
    g0, g1, g2 = -load[0], -load[1], -load[2]
    a00, a01, a02, a11, a12, a22 = anchor_stiffness, 0.0, 0.0, anchor_stiffness, 0.0, anchor_stiffness
    for entry in range(packets.packet_start[b], packets.packet_start[b + 1]):
        e, w = LANES * entry + lane, packets.weight_offset[entry] + lane
        j, k, pull = packets.neighbour_offset[e], packets.weights[w + LANES], packets.weights[w]
        if k == 0.0 and packets.edges is None:
            continue
        v0, v1, v2 = x[0] - p[j], x[1] - p[j + 1], x[2] - p[j + 2]
        n0, n1, n2, length = unit_direction(v0, v1, v2, packets.rest_direction, packets.spring_index[e])
        lateral = max(k - pull / length, min(k, 0.0)) if length > 0.0 else 0.0 if pull > 0.0 else k
        tension, axial = k * length - pull, k - lateral
        g0, g1, g2 = g0 + tension * n0, g1 + tension * n1, g2 + tension * n2
        a00, a01, a02 = a00 + axial * n0 * n0 + lateral, a01 + axial * n0 * n1, a02 + axial * n0 * n2
        a11, a12, a22 = a11 + axial * n1 * n1 + lateral, a12 + axial * n1 * n2, a22 + axial * n2 * n2 + lateral
        (g0, g1, g2), (a00, a01, a02, a11, a12, a22) = add_edge_derivatives(
            packets.edges, entry, lane, (v0, v1, v2), (n0, n1, n2), length,
            (g0, g1, g2), (a00, a01, a02, a11, a12, a22),
        )  # fmt: skip
    return (g0, g1, g2), (a00, a01, a02, a11, a12, a22)


@jit_inner
def _add_outer_product(block, weight, n0, n1, n2):
    a00, a01, a02, a11, a12, a22 = block
    return (
        a00 + weight * n0 * n0, a01 + weight * n0 * n1, a02 + weight * n0 * n2,
        a11 + weight * n1 * n1, a12 + weight * n1 * n2, a22 + weight * n2 * n2,
    )  # fmt: skip


@jit_inner
def insert_index(key, k):
    """Return the key of a set of half-spaces after the insertion of a new one.

    The set must not contain the inserted half-space. The keys of two sets of the first `_NUM_KEY_BITS` half-spaces of
    a row differ. Of larger ones they may be equal, but rarely are; the search for active half-spaces then ends a pass
    early.

    Args:
        key: key of the set, 0 if it is empty.
        k: index of the half-space in its row.
    """
    return key | (1 << k) if k < _NUM_KEY_BITS else key ^ (k * _INDEX_MULTIPLIER)


@jit_inner
def add_half_spaces(s, i, x, d, level, gradient, block):
    """Add the half-spaces of a row to its gradient and block.

    Half-spaces that are active at x or after a step d are included; all are if they are two-sided or if `level` is the
    full majorant. Friction is always included.

    Args:
        s: half-spaces.
        i: index of the row.
        x: position [m], three numbers.
        d: step [m], three numbers.
        level: kind of block, from `EXACT_BLOCK` to `_FULL_MAJORANT`.
        gradient: three numbers [N].
        block: upper triangle by rows, six numbers [N/m].

    Returns:
        The new gradient and block, and the key of the set of included half-spaces (`insert_index`).
    """
    key = 0
    for k in range(s.row_starts[i], s.row_starts[i + 1]):
        n0, n1, n2, weight = s.normal[k, 0], s.normal[k, 1], s.normal[k, 2], s.stiffness[k]
        gap = n0 * x[0] + n1 * x[1] + n2 * x[2] - s.offset[k]
        if s.is_two_sided or gap < 0.0 or level == _FULL_MAJORANT or gap + n0 * d[0] + n1 * d[1] + n2 * d[2] < 0.0:
            key = insert_index(key, k - s.row_starts[i])
            block = _add_outer_product(block, weight, n0, n1, n2)
            force = weight * (_penetration_depth(s, gap) if level == _FULL_MAJORANT else gap)
            gradient = gradient[0] + force * n0, gradient[1] + force * n1, gradient[2] + force * n2
        if s.friction_limit[k] > 0.0:
            u0, u1, u2, length = _tangential_displacement(s, k, x)
            weight = friction_stiffness(s.friction_limit[k], length, s.smoothing_length[k])
            gradient = gradient[0] + weight * u0, gradient[1] + weight * u1, gradient[2] + weight * u2
            a00, a01, a02, a11, a12, a22 = _add_outer_product(block, -weight, n0, n1, n2)
            block = a00 + weight, a01, a02, a11 + weight, a12, a22 + weight
            if level == EXACT_BLOCK and length > s.smoothing_length[k]:
                block = _add_outer_product(block, -weight, u0 / length, u1 / length, u2 / length)
    return gradient, block, key


@jit_inner
def solve_block(block, g):
    """Solve a block for the step -B^-1 g.

    Args:
        block: upper triangle of B by rows, six numbers [N/m].
        g: gradient [N], three numbers.

    Returns:
        The step [m], three numbers, and whether B is positive definite; the step is zero if it is not.
    """
    a, b, c, d, e, f = block
    least = _PIVOT_ROUNDOFF * (a + d + f)
    if not a > least:
        return (0.0, 0.0, 0.0), False
    l1, l2 = b / a, c / a
    second, below = d - l1 * b, e - l2 * b
    if not second > least:
        return (0.0, 0.0, 0.0), False
    l3 = below / second
    third = f - l2 * c - l3 * below
    if not third > least:
        return (0.0, 0.0, 0.0), False
    y1 = g[1] - l1 * g[0]
    x2 = -(g[2] - l2 * g[0] - l3 * y1) / third
    x1 = -y1 / second - l3 * x2
    return (-g[0] / a - l1 * x1 - l2 * x2, x1, x2), True


@jit_inner
def _energy_change(packets, b, lane, p, x, d, anchor_stiffness, load):
    """Return the change of a vertex's energy [J] by a step d, without cancellation.

    The energy is that of springs, inertia and pins.
    """
    total = 0.0
    for c in range(3):
        total += d[c] * (0.5 * anchor_stiffness * d[c] - load[c])
    for entry in range(packets.packet_start[b], packets.packet_start[b + 1]):
        j, w = packets.neighbour_offset[LANES * entry + lane], packets.weight_offset[entry] + lane
        stiffness, before, after, change = packets.weights[w + LANES], 0.0, 0.0, 0.0
        total += edge_energy_change(packets.edges, entry, lane, (x[0] - p[j], x[1] - p[j + 1], x[2] - p[j + 2]), d)
        if stiffness == 0.0:
            continue
        for c in range(3):
            v = x[c] - p[j + c]
            before += v * v
            after += (v + d[c]) * (v + d[c])
            change += d[c] * (2.0 * v + d[c])
        both = np.sqrt(before) + np.sqrt(after)
        if both > 0.0:
            total += change * (0.5 * stiffness - packets.weights[w] / both)
    return total


@jit_inner
def add_half_space_change(s, i, x, d, total):
    """Add the change of the half-spaces' energy by a step of a row.

    Args:
        s: half-spaces.
        i: index of the row.
        x: position [m], three numbers.
        d: step [m], three numbers.
        total: change of the other energies [J].

    Returns:
        Total change [J].
    """
    end = x[0] + d[0], x[1] + d[1], x[2] + d[2]
    for k in range(s.row_starts[i], s.row_starts[i + 1]):
        n0, n1, n2 = s.normal[k, 0], s.normal[k, 1], s.normal[k, 2]
        gap = n0 * x[0] + n1 * x[1] + n2 * x[2] - s.offset[k]
        depth, deep = _penetration_depth(s, gap), _penetration_depth(s, gap + n0 * d[0] + n1 * d[1] + n2 * d[2])
        total += 0.5 * s.stiffness[k] * (deep - depth) * (deep + depth)
        if s.friction_limit[k] > 0.0:
            u0, u1, u2, length = _tangential_displacement(s, k, x)
            w0, w1, w2, longer = _tangential_displacement(s, k, end)
            both = (w0 - u0) * (w0 + u0) + (w1 - u1) * (w1 + u1) + (w2 - u2) * (w2 + u2)
            total += friction_energy_change(s.friction_limit[k], length, longer, both, s.smoothing_length[k])
    return total


def build_block_step(energy_change: Any) -> Any:
    """Build a function that finds a step that does not increase a row's energy.

    The function tries increasingly large blocks; if none succeeds, the step is zero. A device compiles it separately.

    Args:
        energy_change: function (d, where) that returns the change by a step of the other energies of the row; `where`
            is passed to it unchanged.
    """

    @jit_closure
    def compute_step(s, i, x, majorant, first, gradient, block, where):
        """Return the step; begin with the block `first`; majorant, gradient and block exclude the half-spaces."""
        for level in range(first, _FULL_MAJORANT + 1):
            if level == SPRING_MAJORANT:
                block = majorant
            d, definite, before = (0.0, 0.0, 0.0), True, -1
            for _ in range(_MAX_ACTIVE_SET_PASSES):
                slope, whole, key = add_half_spaces(s, i, x, d, level, gradient, block)
                if key == before:
                    break
                before = key
                d, definite = solve_block(whole, slope)
            if definite and add_half_space_change(s, i, x, d, energy_change(d, where)) <= 0.0:
                return d
        return 0.0, 0.0, 0.0

    return compute_step


def build_vertex_move(add_gradient_block: Any, energy_change: Any) -> Any:
    """Build a function that moves the vertices of a packet to lower energies in turn.

    No two of these vertices are coupled.

    Args:
        add_gradient_block: function (others, i, p, gradient, block) that adds the other energies of row i.
        energy_change: function (others, i, p, d) that returns their change by a step d.
    """

    @jit_closure
    def compute_energy_change(d, where):
        packets, elements, b, lane, i, p, x, anchor_stiffness, load = where
        return _energy_change(packets, b, lane, p, x, d, anchor_stiffness, load) + energy_change(elements, i, p, d)

    compute_step = build_block_step(compute_energy_change)

    @jit_closure
    def move(packets, s, elements, b, unknowns, p, right, majorant):
        for lane in range(LANES):
            i = packets.row_offset[LANES * b + lane] // 4
            if i >= unknowns:
                continue
            at, most = RHS_STRIDE * b + lane, majorant[LANES * b + lane]
            h = right[at + 3 * LANES]
            x = p[4 * i], p[4 * i + 1], p[4 * i + 2]
            load = right[at] - h * x[0], right[at + LANES] - h * x[1], right[at + 2 * LANES] - h * x[2]
            gradient, block = _spring_gradient_and_block(packets, b, lane, p, x, h, load)
            gradient, block = add_gradient_block(elements, i, p, gradient, block)
            majorant_block, where = (most, 0.0, 0.0, most, 0.0, most), (packets, elements, b, lane, i, p, x, h, load)
            d = compute_step(s, i, x, majorant_block, EXACT_BLOCK, gradient, block, where)
            p[4 * i], p[4 * i + 1], p[4 * i + 2] = x[0] + d[0], x[1] + d[1], x[2] + d[2]

    return move
