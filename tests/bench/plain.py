"""Replace the vector functions of `springbench.solvers.simd` by plain Numba with the same arguments.

`tests.bench.vectors` compiles these functions and compares their time with that of the vector code. Kernels process a
packet of springs by plain code if the vector function rejects it, so that a function that rejects all packets replaces
the vector function.
"""

from __future__ import annotations

import numpy as np
from springbench.solvers.contact.geometry.distance import (
    edge_edge_distance_vector,
    load_point,
    point_triangle_distance_vector,
)
from springbench.solvers.simd.front_tiles import TILE_ROWS
from springbench.solvers.simd.spring_descent import SHORT_SPRING
from springbench.solvers.simd.spring_packets import LANES, RHS_STRIDE
from springbench.solvers.simd.spring_products import LINEAR_STRIDE


def reject_packet(packets, number, x, right, out):
    """Reject a packet: `springbench.solvers.kernels.spring_local_step.add_degenerate_packet` processes it."""
    return True


def reject_energy(packets, shares, number, x, right, out):
    """Reject a packet: the plain code of the objective and its gradient processes it."""
    return SHORT_SPRING


def compute_squared_norm(packets, number, x, measure):
    """Return the sum of k |v|^2 / 2 over the springs of a packet, and of each vertex's diagonal term."""
    own, neighbour, kinds, weights = (
        packets.row_offset,
        packets.neighbour_offset,
        packets.weight_offset,
        packets.weights,
    )
    total = 0.0
    for lane in range(LANES):
        i = own[LANES * number + lane]
        total += measure[LANES * number + lane] * (x[i] ** 2 + x[i + 1] ** 2 + x[i + 2] ** 2)
        for entry in range(packets.packet_start[number], packets.packet_start[number + 1]):
            j = neighbour[LANES * entry + lane]
            v0, v1, v2 = x[i] - x[j], x[i + 1] - x[j + 1], x[i + 2] - x[j + 2]
            total += 0.5 * weights[kinds[entry] + LANES + lane] * (v0 * v0 + v1 * v1 + v2 * v2)
    return total


def multiply_springs(packets, linear, diagonal, number, x, out):
    """Write the products of a packet's vertices with the Hessian of springs."""
    x, out = x.reshape(-1), out.reshape(-1)
    for lane in range(LANES):
        i, h = packets.row_offset[LANES * number + lane], diagonal[LANES * number + lane]
        s0, s1, s2 = h * x[i], h * x[i + 1], h * x[i + 2]
        for entry in range(packets.packet_start[number], packets.packet_start[number + 1]):
            j, at = packets.neighbour_offset[LANES * entry + lane], LINEAR_STRIDE * entry + lane
            v0, v1, v2 = x[i] - x[j], x[i + 1] - x[j + 1], x[i + 2] - x[j + 2]
            m0, m1, m2 = linear[at], linear[at + LANES], linear[at + 2 * LANES]
            stretch, lateral = m0 * v0 + m1 * v1 + m2 * v2, linear[at + 3 * LANES]
            s0, s1, s2 = s0 + lateral * v0, s1 + lateral * v1, s2 + lateral * v2
            s0, s1, s2 = s0 + stretch * m0, s1 + stretch * m1, s2 + stretch * m2
        out[i], out[i + 1], out[i + 2] = s0, s1, s2


def step_vertices(packets, number, x, right, majorant, near):
    """Update each vertex of a packet by a Newton step; degenerate springs are not detected."""
    own, neighbour, kind, weights = packets.row_offset, packets.neighbour_offset, packets.weight_offset, packets.weights
    for lane in range(LANES):
        i, at = own[LANES * number + lane], RHS_STRIDE * number + lane
        fixed = right[at + 3 * LANES]
        p0, p1, p2 = x[i], x[i + 1], x[i + 2]
        load0, load1, load2 = (
            right[at] - fixed * p0,
            right[at + LANES] - fixed * p1,
            right[at + 2 * LANES] - fixed * p2,
        )
        g0, g1, g2 = load0, load1, load2
        a, b, c, d, e, f = fixed, 0.0, 0.0, fixed, 0.0, fixed
        for entry in range(packets.packet_start[number], packets.packet_start[number + 1]):
            j, w = neighbour[LANES * entry + lane], kind[entry] + lane
            v0, v1, v2 = p0 - x[j], p1 - x[j + 1], p2 - x[j + 2]
            pull, k, root = weights[w], weights[w + LANES], 1.0 / np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            tension = pull * root - k
            lateral = 0.0 if tension > 0.0 and pull > 0.0 else -tension
            n0, n1, n2, axial = v0 * root, v1 * root, v2 * root, k - lateral
            g0, g1, g2 = g0 + tension * v0, g1 + tension * v1, g2 + tension * v2
            a, b, c = a + lateral + axial * n0 * n0, b + axial * n0 * n1, c + axial * n0 * n2
            d, e, f = d + lateral + axial * n1 * n1, e + axial * n1 * n2, f + lateral + axial * n2 * n2
        l1, l2 = b / a, c / a
        second, below = d - l1 * b, e - l2 * b
        l3 = below / second
        third = f - l2 * c - l3 * below
        y1 = g1 - l1 * g0
        s2 = (g2 - l2 * g0 - l3 * y1) / third
        s1 = y1 / second - l3 * s2
        s0 = g0 / a - l1 * s1 - l2 * s2
        least = 1e-14 * (a + d + f)
        rise = 0.5 * fixed * (s0 * s0 + s1 * s1 + s2 * s2) - s0 * load0 - s1 * load1 - s2 * load2
        for entry in range(packets.packet_start[number], packets.packet_start[number + 1]):
            j, w = neighbour[LANES * entry + lane], kind[entry] + lane
            v0, v1, v2 = p0 - x[j], p1 - x[j + 1], p2 - x[j + 2]
            m0, m1, m2 = v0 + s0, v1 + s1, v2 + s2
            both = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2) + np.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
            change = (v0 + m0) * s0 + (v1 + m1) * s1 + (v2 + m2) * s2
            rise += (0.5 * weights[w + LANES] - weights[w] / both) * change
        if not (a > least and second > least and third > least and rise <= 0.0):
            scale = 1.0 / majorant[LANES * number + lane]
            s0, s1, s2 = scale * g0, scale * g1, scale * g2
        near[3 * lane], near[3 * lane + 1], near[3 * lane + 2] = p0 + s0, p1 + s1, p2 + s2
    for lane in range(LANES):
        for axis in range(3):
            x[own[LANES * number + lane] + axis] = near[3 * lane + axis]
    return False


def dot(a, b, count):
    """Return the dot product of a and b."""
    total = 0.0
    for k in range(count):
        total += a[k] * b[k]
    return total


def dot_pair(s, w, g, count):
    """Return the dot products of s and g, and of w and g."""
    first, second = 0.0, 0.0
    for k in range(count):
        first += s[k] * g[k]
        second += w[k] * g[k]
    return first, second


def multiply_sparse_row(values, columns, begin, end, x):
    """Return the sum of values[e] x[columns[e]] over begin <= e < end."""
    s0 = s1 = s2 = zero = x[0, 0] * 0
    for e in range(begin, end):
        j, value = columns[e], values[e]
        s0, s1, s2 = s0 + value * x[j, 0], s1 + value * x[j, 1], s2 + value * x[j, 2]
    return s0, s1, s2, zero


def add_panel_product(panel, offset, index, at, count, x, x_row, y, y_row, numbers, quads):
    """Add W x of a panel to y, row by row."""
    width, zero = 4 * quads, y[0] * 0
    for tile in range(count // 4):
        for r in range(4):
            s0 = s1 = s2 = s3 = zero
            for j in range(width):
                w, row = panel[offset + 4 * tile * width + 4 * j + r], 4 * (x_row + j)
                s0, s1, s2 = s0 + w * x[row], s1 + w * x[row + 1], s2 + w * x[row + 2]
                if numbers == 4:
                    s3 += w * x[row + 3]
            row = 4 * (y_row + index[at + 4 * tile + r])
            y[row] += s0
            y[row + 1] += s1
            y[row + 2] += s2
            if numbers == 4:
                y[row + 3] += s3


def set_transposed_product(square, start, own, panel, offset, index, at, below, y, x_row, quads):
    """Set y to S y + W'y of a panel; the fourth numbers of the rows store one axis of S y at a time."""
    width, zero = 4 * quads, y[0] * 0
    for c in range(3):
        for j in range(width):
            total = zero
            for r in range(width if own > 0 else 0):
                total += square[start + 4 * (r // 4) * width + 4 * j + r % 4] * y[4 * (x_row + r) + c]
            y[4 * (x_row + j) + 3] = total
        for j in range(width):
            y[4 * (x_row + j) + c] = y[4 * (x_row + j) + 3]
    for j in range(width):
        s0 = s1 = s2 = y[4 * (x_row + j) + 3] = zero
        for tile in range(below // 4):
            for r in range(4):
                w, row = panel[offset + 4 * tile * width + 4 * j + r], 4 * index[at + 4 * tile + r]
                s0, s1, s2 = s0 + w * y[row], s1 + w * y[row + 1], s2 + w * y[row + 2]
        y[4 * (x_row + j)] += s0
        y[4 * (x_row + j) + 1] += s1
        y[4 * (x_row + j) + 2] += s2


def subtract_tile_product(L, at, top, stride, depth, C, to, step, strips, overwrite, columns):
    """Subtract the product of all columns to the left from a tile, or from zero."""
    for j in range(columns):
        if overwrite != 0:
            C[to + step * j : to + step * j + TILE_ROWS * strips] = 0.0
        for k in range(depth):
            factor = L[top + j + stride * k]
            for r in range(TILE_ROWS * strips):
                C[to + r + step * j] -= L[at + r + stride * k] * factor


def solve_tile_triangle(L, at, stride, triangle, strips, columns):
    """Divide a tile by its triangle."""
    for j in range(columns):
        for k in range(j):
            for r in range(at, at + TILE_ROWS * strips):
                L[r + stride * j] -= L[r + stride * k] * triangle[j, k]
        for r in range(at, at + TILE_ROWS * strips):
            L[r + stride * j] *= triangle[j, j]


def factorise_tile(L, at, stride, least, triangle, columns):
    """Compute the Cholesky factor of a tile's square block; return whether all pivots exceed their bounds."""
    for j in range(columns):
        for i in range(j, columns):
            entry = L[at + stride * j + i]
            for k in range(j):
                entry -= triangle[i, k] * triangle[j, k]
            if i == j:
                if not entry > least[j]:
                    return False
                triangle[j, j] = 1.0 / np.sqrt(entry)
            else:
                triangle[i, j] = entry * triangle[j, j]
    return True


def forward_solve_tile(L, at, stride, x, to, strips, columns):
    """Apply a tile in forward substitution."""
    for j in range(columns):
        for k in range(j):
            x[to + j] -= L[at + stride * k + j] * x[to + k]
        x[to + j] *= L[at + stride * j + j]
    for j in range(columns):
        for r in range(columns, columns + TILE_ROWS * strips):
            x[to + r] -= L[at + stride * j + r] * x[to + j]


def backward_solve_tile(L, at, stride, x, to, strips, columns):
    """Apply a tile in backward substitution."""
    for j in range(columns - 1, -1, -1):
        total = x[to + j]
        for r in range(columns, columns + TILE_ROWS * strips):
            total -= L[at + stride * j + r] * x[to + r]
        for k in range(columns - 1, j, -1):
            total -= L[at + stride * j + k] * x[to + k]
        x[to + j] = total * L[at + stride * j + j]


def add_vector(source, at, target, to, count):
    """Add source to target."""
    for r in range(count):
        target[to + r] += source[at + r]


def compute_packet_distances(vertices, x, first, last, edges, limit, tile):
    """Compute distances of eight candidate pairs (9, 8), and return the mask of those within the limit."""
    left = 0
    for lane in range(8):
        v = vertices[min(first + lane, last)]
        a, b, c, d = load_point(x, v[0]), load_point(x, v[1]), load_point(x, v[2]), load_point(x, v[3])
        if edges:
            c0, c1, c2, c3, z, area = edge_edge_distance_vector(a, b, c, d)
        else:
            c0, c1, c2, c3, z = point_triangle_distance_vector(a, b, c, d)
            area = 0.0
        squared = z[0] * z[0] + z[1] * z[1] + z[2] * z[2]
        for row, value in enumerate((c0, c1, c2, c3, z[0], z[1], z[2], squared, area)):
            tile[row, lane] = value
        left |= (1 << lane) * (squared < limit)
    return left
