"""Compiled sweeps of vertex block descent with offset geometric contact.

    B_i d_i = -g_i,    x_i <- c_i + min(1, b_i/|x_i + d_i - c_i|) (x_i + d_i - c_i)

g, B: gradient and block of the springs, elements and contacts of a vertex, at the current positions of all others; c:
positions at the last detection of contacts, b: displacement bound of the vertex. A contact at a distance d between
points of its features, with coefficients k_i in the distance vector d n, adds

    -k_i f(d) n + k_i w u,   k_i^2 (f'(d) nn' + w (I - nn')),   w = mu f/max(s, |u|)

f: activation force (`offset_force`); u: tangential displacement since the start of the step; s: smoothing length
(`contact.potentials.friction_law`). f and n are those of the current positions, so that friction lags
by no step; their derivatives are left out, as in the paper.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.geometry.distance import (
    dot3,
    edge_edge_distance_vector,
    point_triangle_distance_vector,
)
from springbench.solvers.contact.half_space.half_space_steps import solve_block
from springbench.solvers.contact.potentials.friction_law import friction_stiffness, project_tangentially
from springbench.solvers.jit.kernel_compilation import jit_closure, jit_inner, jit_kernel
from springbench.solvers.methods.vertex_block.incident_elements import ElementKind, VertexFunctions
from springbench.solvers.methods.vertex_block.vbd_packets import vbd_newton_step, vbd_vertex_model
from springbench.solvers.methods.vertex_block.vbd_sweeps import write_degenerate_descent
from springbench.solvers.simd.spring_packets import LANES


class OffsetContacts(NamedTuple):
    """Contacts by the rows of their vertices, and displacement bounds.

    Attributes:
        row_starts: first entry of each row (rows + 1,).
        contact_index, vertex_slot: contact of each entry, and the row's place among its four vertices.
        has_contact: whether a packet has a row with a contact (b,).
        row_offsets: offsets of the four rows of each contact (k, 4).
        is_edge_pair: (k,); the others are points and triangles, which may have repeated vertices.
        min_distance, radius: distance at which a contact closes, and range beyond it in which it acts [m], (k,).
        stiffness: (k,) [N/m].
        friction: friction coefficient mu (k,).
        smoothing_length: (k,) [m].
        centre: positions at the detection, in rows of four [m].
        bound: displacement bound of each row [m].
        step_start: positions at the start of the step, in rows of four [m].
    """

    row_starts: NDArray[np.int64]
    contact_index: NDArray[np.int64]
    vertex_slot: NDArray[np.int64]
    has_contact: NDArray[np.bool_]
    row_offsets: NDArray[np.int64]
    is_edge_pair: NDArray[np.bool_]
    min_distance: NDArray[np.float64]
    radius: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    friction: NDArray[np.float64]
    smoothing_length: NDArray[np.float64]
    centre: NDArray[np.float64]
    bound: NDArray[np.float64]
    step_start: NDArray[np.float64]


@jit_inner
def offset_force(d, radius):
    """Return -g'(d) [m] and g''(d), per stiffness [N/m], of the two-stage activation.

    It is quadratic at first contact, and logarithmic near zero:

        g(d) = (r - d)^2/2                          for r/2 <= d < r,        0 beyond r
               (r/2)^2 (1/2 - ln(2 d/r))            for 0 < d < r/2

    Both parts meet with equal values, slopes and curvatures, which determines the factor and the point r/2. Source:
    Chen et al. 2025, "Offset geometric contact", ACM TOG 44(4); ipctk has the same function as `TwoStageBarrier`.

    Args:
        d: distance [m], above 0.
        radius: contact radius r [m].
    """
    if d >= radius:
        return 0.0, 0.0
    if 2.0 * d >= radius:
        return radius - d, 1.0
    factor = 0.25 * radius * radius
    return factor / d, factor / (d * d)


@jit_inner
def _load_row(p, i):
    return p[i], p[i + 1], p[i + 2]


@jit_inner
def _combine_rows(p, rows, c0, c1, c2, c3, axis):
    return c0 * p[rows[0] + axis] + c1 * p[rows[1] + axis] + c2 * p[rows[2] + axis] + c3 * p[rows[3] + axis]


@jit_inner
def add_offset_contacts(contacts, i, p, gradient, block):
    """Add the contacts of row i at positions p to its gradient and block.

    Args:
        contacts: contacts by the rows of their vertices.
        i: index of a free row.
        p: positions in rows of four [m], those of obstacles included.
        gradient: gradient of the row's vertex, three numbers [N].
        block: upper triangle of its block, row by row, six numbers [N/m].

    Returns:
        Gradient and block with the contacts.
    """
    g0, g1, g2 = gradient
    xx, xy, xz, yy, yz, zz = block
    for entry in range(contacts.row_starts[i], contacts.row_starts[i + 1]):
        k, slot = contacts.contact_index[entry], contacts.vertex_slot[entry]
        rows = contacts.row_offsets[k]
        x0, x1, x2, x3 = _load_row(p, rows[0]), _load_row(p, rows[1]), _load_row(p, rows[2]), _load_row(p, rows[3])
        if contacts.is_edge_pair[k]:
            c0, c1, c2, c3, z, _ = edge_edge_distance_vector(x0, x1, x2, x3)
        else:
            c0, c1, c2, c3, z = point_triangle_distance_vector(x0, x1, x2, x3)
        d = np.sqrt(dot3(z, z))
        gap = d - contacts.min_distance[k]
        if not 0.0 < gap < contacts.radius[k]:
            continue
        c = c0 if slot == 0 else c1 if slot == 1 else c2 if slot == 2 else c3
        force, curvature = offset_force(gap, contacts.radius[k])
        force, curvature, c2nd = contacts.stiffness[k] * force, contacts.stiffness[k] * curvature, c * c
        n0, n1, n2, w = z[0] / d, z[1] / d, z[2] / d, 0.0
        g0, g1, g2 = g0 - c * force * n0, g1 - c * force * n1, g2 - c * force * n2
        if contacts.friction[k] > 0.0:
            start = contacts.step_start
            u0, u1, u2 = project_tangentially(
                z[0] - _combine_rows(start, rows, c0, c1, c2, c3, 0),
                z[1] - _combine_rows(start, rows, c0, c1, c2, c3, 1),
                z[2] - _combine_rows(start, rows, c0, c1, c2, c3, 2),
                n0, n1, n2,
            )  # fmt: skip
            length = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
            w = friction_stiffness(contacts.friction[k] * force, length, contacts.smoothing_length[k])
            g0, g1, g2 = g0 + c * w * u0, g1 + c * w * u1, g2 + c * w * u2
        along, w = c2nd * (curvature - w), c2nd * w
        xx, xy, xz = xx + along * n0 * n0 + w, xy + along * n0 * n1, xz + along * n0 * n2
        yy, yz, zz = yy + along * n1 * n1 + w, yz + along * n1 * n2, zz + along * n2 * n2 + w
    return (g0, g1, g2), (xx, xy, xz, yy, yz, zz)


@jit_inner
def truncate_row(contacts, i, p):
    """Move row i of p into the ball around its position at the detection.

    Args:
        contacts: positions at the detection and displacement bounds of the rows.
        i: index of a free row.
        p: positions in rows of four [m], updated.

    Returns:
        Whether the position was outside the ball, or not a number.
    """
    at = 4 * i
    a, b, c = p[at] - contacts.centre[at], p[at + 1] - contacts.centre[at + 1], p[at + 2] - contacts.centre[at + 2]
    length = np.sqrt(a * a + b * b + c * c)
    if length <= contacts.bound[i]:
        return False
    share = contacts.bound[i] / length if length < np.inf else 0.0
    if share > 0.0:
        p[at], p[at + 1], p[at + 2] = (
            contacts.centre[at] + share * a,
            contacts.centre[at + 1] + share * b,
            contacts.centre[at + 2] + share * c,
        )
    else:
        p[at], p[at + 1], p[at + 2] = contacts.centre[at], contacts.centre[at + 1], contacts.centre[at + 2]
    return True


@jit_kernel
def truncate_displacements(contacts, num_free, p):
    """Move the free rows of p into their balls, and return how many were outside.

    Args:
        contacts: positions at the detection and displacement bounds of the rows.
        num_free: number of free rows, which come first.
        p: positions in rows of four [m], updated.
    """
    count = 0
    for i in range(num_free):
        count += truncate_row(contacts, i, p)
    return count


@cache
def build_offset_sweeps(*kinds: ElementKind) -> Any:
    """Build the kernel that sweeps over all vertices, with elements of these kinds."""
    _, add_elements, _ = VertexFunctions.from_kinds(list(kinds))
    has_elements = len(kinds) > 0

    @jit_closure
    def move_packet(blocks, elements, contacts, right, b, p, work):
        """Move the vertices of a packet by Newton steps, or by those of a majorant."""
        packets, sums = blocks.spring_packets, work.packet_sums
        short = vbd_vertex_model(packets, b, p, right, work.spring_scratch, sums)
        if short:
            write_degenerate_descent(packets, b, p, right, work.descent_scratch)
        for lane in range(LANES):
            at = packets.row_offset[LANES * b + lane]
            i = at // 4
            if i >= blocks.num_free:
                continue
            most = blocks.majorant[LANES * b + lane]
            if short:
                gradient = -work.descent_scratch[at], -work.descent_scratch[at + 1], -work.descent_scratch[at + 2]
                block = most, 0.0, 0.0, most, 0.0, most
            else:
                gradient = -sums[lane], -sums[LANES + lane], -sums[2 * LANES + lane]
                block = (
                    sums[3 * LANES + lane], sums[4 * LANES + lane], sums[5 * LANES + lane],
                    sums[6 * LANES + lane], sums[7 * LANES + lane], sums[8 * LANES + lane],
                )  # fmt: skip
            gradient, block = add_elements(elements, i, p, gradient, block)
            before = block[0] + block[3] + block[5]
            gradient, block = add_offset_contacts(contacts, i, p, gradient, block)
            d, definite = solve_block(block, gradient)
            if not definite:
                most += block[0] + block[3] + block[5] - before
                d = -gradient[0] / most, -gradient[1] / most, -gradient[2] / most
            p[at], p[at + 1], p[at + 2] = p[at] + d[0], p[at + 1] + d[1], p[at + 2] + d[2]

    @jit_kernel
    def run_sweeps(blocks, elements, contacts, right, p, work, iterations, max_truncated):
        """Sweep over all vertices until bounds restrict more than some of them.

        Args:
            blocks: packets of the vertices.
            elements: other element energies, or None.
            contacts: contacts and displacement bounds.
            right: constant right-hand side [N] by packets, with anchor stiffnesses [N/m].
            p: positions in rows of four [m], updated.
            work: scratch memory.
            iterations: maximum number of sweeps.
            max_truncated: number of truncated vertices that does not end the sweeps.

        Returns:
            Number of sweeps, and number of vertices that the last one truncated.
        """
        packets, truncated = blocks.spring_packets, 0
        for count in range(iterations):
            truncated = 0
            for b in range(len(packets.packet_start) - 1):
                if (
                    has_elements
                    or contacts.has_contact[b]
                    or vbd_newton_step(packets, b, p, right, blocks.majorant, work.spring_scratch)
                ):
                    move_packet(blocks, elements, contacts, right, b, p, work)
                for lane in range(LANES):
                    i = packets.row_offset[LANES * b + lane] // 4
                    if i < blocks.num_free:
                        truncated += truncate_row(contacts, i, p)
            if truncated > max_truncated:
                return count + 1, truncated
        return iterations, truncated

    return run_sweeps
