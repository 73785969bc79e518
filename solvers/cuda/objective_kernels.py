"""Kernels of a step's objective: gradient and change in float64, Hessian products in `real`.

    grad_i g = h_i (p_i - c_i) - f_i + sum over its edges of t n,      t = k (l - r), or k (n.v - o) of a dashpot
    (H x)_i  = h_i x_i + sum over its edges of b + a n (n.b),  b = s (x_i - x_j),  s = t/l,  a = (k - s)
    g(q) - g(p): a sum of differences, as in `springbench.solvers.kernels.objective_kernels`

Each row gathers its own terms, in the order of its list, so no thread writes to another's row.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from springbench.solvers.cuda import device_sums
from springbench.solvers.cuda.cuda_target import cuda
from springbench.solvers.cuda.function_sharing import share_with_device
from springbench.solvers.kernels import spring_law

_unit_direction = share_with_device(spring_law.unit_direction)
_spring_energy_change = share_with_device(spring_law.spring_energy_change)


@cuda.jit(device=True)
def edge_direction_and_tension(edges, e, v0, v1, v2):
    """Return the direction, tension [N] and length [m] of an entry's edge.

    Args:
        edges: edges on the device.
        e: index of the entry.
        v0, v1, v2: vector from the edge's other end to the entry's own end [m].

    Returns:
        Three components of the unit direction, which points to the entry's own end, then tension and length.
    """
    k, rest = edges.entry_stiffness[e], edges.entry_rest_length[e]
    if rest == rest:  # a spring: the rest length of a dashpot is nan
        n0, n1, n2, length = _unit_direction(v0, v1, v2, edges.edge_direction, edges.edge_indices[e])
        return n0, n1, n2, k * (length - rest), length
    named, sign = edges.edge_indices[e], 1.0
    if named < 0:
        named, sign = ~named, -1.0
    n0, n1, n2 = (
        sign * edges.edge_direction[named, 0],
        sign * edges.edge_direction[named, 1],
        sign * edges.edge_direction[named, 2],
    )
    length = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    return n0, n1, n2, k * (n0 * v0 + n1 * v1 + n2 * v2 - edges.dashpot_offset[named]), length


@cuda.jit
def write_gradient(edges, step_data, p, out):
    """Write the gradient of the objective at the free rows.

    Args:
        edges: edges on the device.
        step_data: anchors and forces of the free rows.
        p: positions in rows (n, 3) [m].
        out: output (f, 3) [N].
    """
    i = cuda.grid(1)
    while i < out.shape[0]:
        x, y, z, h = p[i, 0], p[i, 1], p[i, 2], step_data.anchor_stiffness[i]
        g0 = h * (x - step_data.anchor_positions[i, 0]) - step_data.external_force[i, 0]
        g1 = h * (y - step_data.anchor_positions[i, 1]) - step_data.external_force[i, 1]
        g2 = h * (z - step_data.anchor_positions[i, 2]) - step_data.external_force[i, 2]
        e, end = edges.warp_starts[i >> 5] + (i & 31), edges.warp_starts[(i >> 5) + 1]
        while e < end:
            j = edges.neighbour_rows[e]
            if j == i:
                break
            n0, n1, n2, tension, _ = edge_direction_and_tension(edges, e, x - p[j, 0], y - p[j, 1], z - p[j, 2])
            g0 += tension * n0
            g1 += tension * n1
            g2 += tension * n2
            e += 32
        out[i, 0], out[i, 1], out[i, 2] = g0, g1, g2
        i += cuda.gridsize(1)


@cuda.jit
def sum_objective_change(edges, step_data, p, q, sum_slot, partials):
    """Do the first stage of the sum g(q) - g(p) [J].

    Args:
        edges: edges on the device.
        step_data: anchors and forces of the free rows.
        p, q: positions in rows (n, 3) [m], before and after.
        sum_slot: row of the partial sums.
        partials: output, partial sums (k, MAX_BLOCKS) [J].
    """
    total = 0.0
    i = cuda.grid(1)
    while i < step_data.anchor_stiffness.shape[0]:
        for c in range(3):
            middle = 0.5 * (p[i, c] + q[i, c])
            pull = (
                step_data.anchor_stiffness[i] * (middle - step_data.anchor_positions[i, c])
                - step_data.external_force[i, c]
            )
            total += (q[i, c] - p[i, c]) * pull
        i += cuda.gridsize(1)
    e = cuda.grid(1)
    while e < edges.ends.shape[0]:
        i, j, k, rest = edges.ends[e, 0], edges.ends[e, 1], edges.edge_stiffness[e], edges.edge_rest_length[e]
        if rest == rest:
            total += _spring_energy_change(k, rest, i, j, p, q)
        else:
            closing, closer = -edges.dashpot_offset[e], 0.0
            for c in range(3):
                closing += edges.edge_direction[e, c] * (p[i, c] - p[j, c])
                closer += edges.edge_direction[e, c] * ((q[i, c] - p[i, c]) - (q[j, c] - p[j, c]))
            total += k * closer * (closing + 0.5 * closer)
        e += cuda.gridsize(1)
    device_sums.store_partial_sum(total, sum_slot, partials)


class HessianKernels(NamedTuple):
    """Hessian kernels for one precision."""

    linearise_hessian: Any
    multiply_hessian: Any


@cache
def build_hessian_kernels(real: type[np.float32] | type[np.float64]) -> HessianKernels:
    """Build the kernels that compute in `real`."""

    transverse_stiffness = share_with_device(spring_law.transverse_stiffness)

    @cuda.jit
    def linearise(edges, free, p, linear):
        """Write sqrt(a) n and s of each entry of the first `free` rows to linear (4, entries)."""
        i = cuda.grid(1)
        while i < free:
            x, y, z = p[i, 0], p[i, 1], p[i, 2]
            e, end = edges.warp_starts[i >> 5] + (i & 31), edges.warp_starts[(i >> 5) + 1]
            while e < end:
                j = edges.neighbour_rows[e]
                if j == i:
                    break
                n0, n1, n2, tension, length = edge_direction_and_tension(
                    edges, e, x - p[j, 0], y - p[j, 1], z - p[j, 2]
                )
                k, rest = edges.entry_stiffness[e], edges.entry_rest_length[e]
                # The rest length of a dashpot is nan.
                lateral = transverse_stiffness(k, rest, tension, length) if rest == rest else 0.0
                root = math.sqrt(k - lateral)
                linear[0, e], linear[1, e], linear[2, e] = real(root * n0), real(root * n1), real(root * n2)
                linear[3, e] = real(lateral)
                e += 32
            i += cuda.gridsize(1)

    @cuda.jit
    def multiply(edges, hold, linear, x, out, which, partials, now):
        """Write H x (f, 3) to `out` and store the first stage of x'H x.

        Do nothing if now[0] is not 0.
        """
        if now[0] != 0.0:
            return
        total, rows = 0.0, x.shape[0]
        i = cuda.grid(1)
        while i < rows:
            x0, x1, x2, h = x[i, 0], x[i, 1], x[i, 2], real(hold[i])
            y0, y1, y2 = h * x0, h * x1, h * x2
            e, end = edges.warp_starts[i >> 5] + (i & 31), edges.warp_starts[(i >> 5) + 1]
            while e < end:
                j = edges.neighbour_rows[e]
                if j == i:
                    break
                s0, s1, s2 = x0, x1, x2
                if j < rows:
                    s0, s1, s2 = x0 - x[j, 0], x1 - x[j, 1], x2 - x[j, 2]
                r0, r1, r2, lateral = linear[0, e], linear[1, e], linear[2, e], linear[3, e]
                stretch = r0 * s0 + r1 * s1 + r2 * s2
                y0 += lateral * s0 + stretch * r0
                y1 += lateral * s1 + stretch * r1
                y2 += lateral * s2 + stretch * r2
                e += 32
            out[i, 0], out[i, 1], out[i, 2] = y0, y1, y2
            total += np.float64(x0) * np.float64(y0) + np.float64(x1) * np.float64(y1) + np.float64(x2) * np.float64(y2)
            i += cuda.gridsize(1)
        device_sums.store_partial_sum(total, which, partials)

    return HessianKernels(linearise, multiply)
